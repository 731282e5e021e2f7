"""Conversion of videos with the command: frames, times, sound, and resuming after an interruption."""

import os
import re
import signal
import subprocess
import sys
import time
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from conversions import frames_of, interrupt, run, times_of, write_slow_video
from other_processes import halted
from rich.console import Console
from spatial_examples import SPATIAL, spatial_pairs
from video_examples import (
    TEXTURED,
    damage,
    example_pairs,
    packed,
    packets,
    write_side_by_side,
    write_video,
)

from stereoweave.cli.root import main
from stereoweave.errors import StereoweaveError
from stereoweave.io.colormap import colour_disparity
from stereoweave.io.images import read_image, write_image
from stereoweave.learn.data.collage import paint_collage
from stereoweave.matching.backend import Backend
from stereoweave.matching.edge_vote.vote import sharpen_edges
from stereoweave.matching.matcher import Matcher
from stereoweave.rendering.layouts import LAYOUTS, LayoutOptions, squeeze
from stereoweave.rendering.renderer import Renderer
from stereoweave.stereo import StereoCamera, StereoPair
from stereoweave.video.convert import convert_video
from stereoweave.video.frame_groups import FrameGrouper
from stereoweave.video.job import VideoJob
from stereoweave.video.reader import StereoFrame, open_video

pytestmark = pytest.mark.usefixtures("default_interrupts")


def rgb_of(video: Path) -> list[np.ndarray]:
    return [frame.left for frame in open_video([video, video]).frames()]


def estimate_of(frame: StereoFrame):
    return Matcher("small", threads=1).estimate(frame.left, frame.right)


def sharp_disparity_of(frame: StereoFrame):
    """Return the disparity of a frame, sharpened before and after the filter, which has nothing to add."""
    once = sharpen_edges(frame.left, estimate_of(frame), 1)
    return sharpen_edges(frame.left, once, 1).disparity_px


def test_a_conversion_keeps_uneven_frame_times_and_the_sound(tmp_path, capsys):
    times_ms = [0, 40, 90, 130, 170, 300, 330, 370]
    video = write_side_by_side(
        tmp_path / "in.mp4", example_pairs(8), times_ms=times_ms, sound=True, codec="libx264"
    )
    assert run(video, tmp_path / "out.mp4", "--position", "0.5", "--threads", "2") == 0
    assert capsys.readouterr().out == f"{tmp_path / 'out.mp4'}: 8 frames\n"
    assert times_of(tmp_path / "out.mp4") == [Fraction(ms, 1000) for ms in times_ms]
    assert packets(tmp_path / "out.mp4", "audio") == packets(video, "audio")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.mp4", "out.mp4"]


@pytest.mark.parametrize("known", [1, 0])
def test_sound_of_an_unknown_codec_is_left_out_with_a_note(tmp_path, capsys, known):
    """iPhones write a second track of spatial sound, whose codec FFmpeg does not know."""
    source = write_side_by_side(tmp_path / "source.mp4", example_pairs(3), sound=True, codec="libx264")
    video = tmp_path / "in.mov"
    with av.open(str(source)) as given, av.open(str(video), "w") as made:
        tracks = [*given.streams.video, *(given.streams.audio[0],) * (known + 1)]
        copies = [made.add_stream_from_template(track) for track in tracks]
        for packet in given.demux():
            for copy, track in zip(copies, tracks, strict=True):
                if packet.size and packet.stream_index == track.index:
                    packet.stream = copy
                    made.mux(packet)
    content = video.read_bytes()
    last = content.rindex(b"stsd")
    video.write_bytes(content[:last] + content[last:].replace(b"mp4a", b"apac").replace(b"esds", b"dapa"))
    out = tmp_path / "out.mov"
    assert run(video, out, "--format", "side_by_side", "--position", "0.5") == 0
    told = " ".join(capsys.readouterr().err.split())
    assert "1 sound track left out, of a codec that FFmpeg does not know" in told
    with av.open(str(out)) as made:
        assert len(made.streams.audio) == known
    if known:
        assert packets(out, "audio") == packets(source, "audio")


def aspect_of(video: Path) -> Fraction | None:
    with av.open(str(video)) as container:
        return container.streams.video[0].sample_aspect_ratio


@pytest.mark.parametrize(
    ("layout", "stated", "rotation", "expected"),
    [
        ("side_by_side", Fraction(4, 3), 0, Fraction(4, 3)),
        ("top_bottom", Fraction(4, 3), 90, Fraction(3, 4)),  # of the upright picture
        ("side_by_side_half", Fraction(4, 3), 0, Fraction(4, 3)),
        ("side_by_side", Fraction(1, 2), 0, None),  # 1/2 is that of both views in the shape of one
        ("top_bottom", Fraction(2), 0, None),
        ("side_by_side_half", Fraction(2), 0, None),  # 2 is that of the squeezed views
        ("top_bottom_half", Fraction(1, 2), 0, None),
        ("side_by_side", None, 0, None),
    ],
)
def test_an_output_has_the_pixel_aspect_of_the_views(tmp_path, layout, stated, rotation, expected):
    frames = [packed(*pair, layout) for pair in example_pairs(1)]
    frames = [np.rot90(frame, -rotation // 90) for frame in frames]
    video = write_video(tmp_path / "in.mp4", frames, codec="libx264", rotation=rotation, pixel_aspect=stated)
    words = ["--format", layout, "--layout", "side_by_side_half", "--no-rectify"]
    assert run(video, tmp_path / "out_half_LR.mp4", *words) == 0
    assert aspect_of(tmp_path / "out_half_LR.mp4") == expected


def test_a_layout_too_large_for_h264_is_refused_before_anything_is_matched(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(Matcher, "estimate", None)
    wide = [np.zeros((32, 8194, 3), np.uint8)]
    eyes = [write_video(tmp_path / f"{eye}.mkv", wide, codec="ffv1") for eye in (0, 1)]
    words = ["video", *map(str, eyes), "-o", str(tmp_path / "out.mp4"), "--layout"]
    assert main([*words, "side_by_side"]) == 2
    told = "expected output frames of at most 16384 px per side for H.264, found 16388x32 px"
    assert f"{told}; write HEVC, in 10 bits (--bits, --depth10)" in capsys.readouterr().err


def test_a_pixel_aspect_that_matroska_loses_is_noted(tmp_path, capsys):
    video = write_side_by_side(
        tmp_path / "in.mp4", example_pairs(1), codec="libx264", pixel_aspect=Fraction(4, 3)
    )
    assert run(video, tmp_path / "view.mkv", "--position", "0") == 0
    assert aspect_of(tmp_path / "view.mkv") == Fraction(4, 3)
    told = "pixels 1.33 times as wide as high, which FFmpeg cannot write beside a frame packing"
    assert told not in capsys.readouterr().err
    assert run(video, tmp_path / "out_half_LR.mkv", "--layout", "side_by_side_half") == 0
    assert f"{told} in .mkv; write .mp4 instead" in capsys.readouterr().err


def test_pictures_named_by_patterns_with_numbers_are_converted(tmp_path):
    for number, pair in enumerate(example_pairs(2)):
        for side, picture in zip(("left", "right"), pair, strict=True):
            write_image(tmp_path / side / f"{number:03}.png", picture)
    sources = [str(tmp_path / side / "%03d.png") for side in ("left", "right")]
    assert main(["video", *sources, "-o", str(tmp_path / "out.mp4"), "--position", "0"]) == 0
    assert len(frames_of(tmp_path / "out.mp4")) == 2


def test_depth_in_16_bits_is_disparity_times_256(tmp_path):
    video = write_side_by_side(tmp_path / "in.mp4", example_pairs(2), codec="libx264")
    assert run(video, tmp_path / "out.mkv", "--depth16") == 0
    first = next(open_video([video]).frames())
    with av.open(str(tmp_path / "out.mkv")) as container:
        assert (
            container.metadata["COMMENT"] == "16-bit grey: disparity of the left view in pixels = value / 256"
        )
        grey = next(container.decode(video=0)).to_ndarray()
    # The first frame has no predecessor, so the temporal filter leaves it unchanged.
    np.testing.assert_array_equal(grey, np.rint(256 * sharp_disparity_of(first)))


def test_a_spatial_video_is_converted_with_its_times_sound_and_metres(tmp_path, capsys):
    assert run(SPATIAL, tmp_path / "out.mkv", "--depth16", "--threads", "2") == 0
    said = capsys.readouterr()
    assert said.out == f"{tmp_path / 'out.mkv'}: 50 frames\n"
    assert "spatial video (MV-HEVC), left view first: field of view 60 degrees" in said.err
    assert times_of(tmp_path / "out.mkv") == [Fraction(index, 25) for index in range(50)]
    assert [body for _, body in packets(tmp_path / "out.mkv", "audio")] == [
        body for _, body in packets(SPATIAL, "audio")
    ]
    with av.open(str(tmp_path / "out.mkv")) as container:
        comment = container.metadata["COMMENT"]
        grey = next(container.decode(video=0)).to_ndarray()
    # 160 * sqrt(3) px * 0.0635 m * 256 = 4504.99
    assert comment.endswith("in pixels = value / 256; depth in metres = 4504.99 / value")
    left, right = spatial_pairs()[0]
    expected_px = Matcher("small", threads=1).estimate(left, right).disparity_px
    assert np.median(np.abs(grey / 256 - expected_px)) < 0.2


def test_the_colours_of_a_spatial_video_are_explained_in_metres(tmp_path):
    assert run(SPATIAL, tmp_path / "out.mp4", "--depth", "--preview", "0.2s") == 0
    with av.open(str(tmp_path / "out_preview.mp4")) as container:
        comment = container.metadata["comment"]
    low_px, low_m, high_px, high_m = (float(word) for word in re.findall(r"(\d[\d.]*) (?:px|m)\b", comment))
    constant = 160 * 3**0.5 * 0.0635
    assert [low_m, high_m] == pytest.approx([constant / low_px, constant / high_px], rel=0.01)
    assert re.sub(r"\d[\d.]*", "N", comment) == (
        "disparity of the left view: N px (N m) is blue, N px (N m) is red"
    )


def test_steps_that_overlap_give_the_same_frames(tmp_path):
    video = write_side_by_side(tmp_path / "in.mp4", example_pairs(9), codec="libx264")
    for threads in ("1", "2"):
        assert run(video, tmp_path / f"{threads}.mkv", "--depth16", "--threads", threads) == 0
    # With two threads, too, the network has one.
    one, two = (frames_of(tmp_path / f"{threads}.mkv") for threads in ("1", "2"))
    assert len(one) == 9
    np.testing.assert_array_equal(one, two)


def test_an_error_of_a_step_in_a_thread_ends_the_conversion(tmp_path, monkeypatch, capsys):
    video = write_side_by_side(tmp_path / "in.mp4", example_pairs(6), codec="libx264")

    def fail(*_):
        raise StereoweaveError("expected a network that works, found none")

    monkeypatch.setattr("stereoweave.video.frame_converter.match", fail)
    assert run(video, tmp_path / "out.mp4", "--depth", "--threads", "2") == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == "stereoweave: expected a network that works, found none"
    assert [path.name for path in tmp_path.iterdir()] == ["in.mp4"]


def test_depth_colours_mean_the_same_throughout_a_video(tmp_path, capsys):
    near = example_pairs(1)[0]
    far = (255 - near[0][::-1],) * 2
    video = write_side_by_side(tmp_path / "in.mp4", [near, near, far, far], codec="libx264")
    assert run(video, tmp_path / "out.mp4", "--depth", "--format", "side_by_side") == 0
    assert capsys.readouterr().out.endswith("4 frames, 1 cut\n")
    with av.open(str(tmp_path / "out.mp4")) as container:
        comment = container.metadata["comment"]
    low_px, high_px = (float(word) for word in comment.replace(" px", "").split() if word[0].isdigit())
    frames = list(open_video([video], "side_by_side").frames())
    shown = rgb_of(tmp_path / "out.mp4")
    for index in (0, 2):  # the first frame, and the first one after the cut
        expected = colour_disparity(estimate_of(frames[index]).disparity_px, (low_px, high_px))
        assert np.abs(shown[index].astype(int) - expected).mean() < 6


@pytest.mark.parametrize("name", ["side_by_side", "anaglyph_dubois"])
def test_a_layout_equals_that_of_a_still_and_marks_the_file_name(tmp_path, name):
    video = write_side_by_side(tmp_path / "in.mp4", example_pairs(2), codec="libx264")
    assert run(video, tmp_path / "out.mp4", "--layout", name, "--strength", "1.5", "--convergence", "12") == 0
    first = next(open_video([video]).frames())
    pair = StereoPair(left=first.left, right=first.right)
    renderer = Renderer(pair, estimate_of(first), strength=1.5, convergence_px=12.0)
    still = LAYOUTS[name].compose(renderer, LayoutOptions())
    made = tmp_path / f"out{LAYOUTS[name].mark}.mp4"
    assert np.abs(rgb_of(made)[0].astype(int) - still).mean() < 6
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["in.mp4", made.name])


@pytest.mark.parametrize(
    "words",
    [["--layout", "side_by_side"], ["--layout", "top_bottom_half"], ["--position", "1"]],
    ids=lambda words: words[1],
)
def test_pictures_of_both_cameras_are_joined_without_matching(tmp_path, monkeypatch, capsys, words):
    def refuse(*given):
        raise StereoweaveError("matched")

    monkeypatch.setattr("stereoweave.video.frame_converter.match", refuse)
    upside_down = [(left[::-1], right[::-1]) for left, right in example_pairs(4)]
    video = write_side_by_side(tmp_path / "in.mp4", [*example_pairs(5), *upside_down])
    assert run(video, tmp_path / "out.mp4", "--no-rectify", *words) == 0
    assert "9 frames, 1 cut" in capsys.readouterr().out
    assert run(video, tmp_path / "stretched.mp4", "--no-rectify", *words, "--strength", "1.5") == 2
    assert "matched" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "axis"), [("side_by_side_half", 1), ("top_bottom_half", 0)])
def test_a_layout_of_half_size_equals_the_full_one_halved(tmp_path, name, axis):
    video = write_side_by_side(tmp_path / "in.mp4", example_pairs(2), codec="libx264")
    full = name.removesuffix("_half")
    for layout in (full, name):
        words = ["--layout", layout, "--strength", "1.5", "--convergence", "12"]
        assert run(video, tmp_path / f"{layout}.mp4", *words) == 0
    whole, half = (
        rgb_of(next(tmp_path.glob(f"{layout}{LAYOUTS[layout].mark}.mp4")))[0] for layout in (full, name)
    )
    eyes = [squeeze(eye, axis) for eye in np.split(whole, 2, axis)]
    assert half.shape == np.concatenate(eyes, axis).shape
    assert np.abs(half.astype(int) - np.concatenate(eyes, axis)).mean() < 3


def test_overlaid_views_converge_at_the_median_disparity_of_the_video(tmp_path):
    video = write_side_by_side(tmp_path / "in.mp4", example_pairs(3), codec="libx264")
    for name, words in {"auto": (), "none": ("--convergence", "0")}.items():
        assert run(video, tmp_path / f"{name}.mp4", "--layout", "anaglyph_grey", *words) == 0
    # Without convergence, the red and the green view are offset by the disparity.
    apart = {name: _red_from_green(rgb_of(tmp_path / f"{name}.mp4")[1]) for name in ("auto", "none")}
    assert apart["auto"] < apart["none"] / 2


def converged_pairs(moved_px: list[int]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return a window of the example pair for each shift, by which its disparities are lower."""
    left, right = (read_image(TEXTURED / f"{eye}.png") for eye in ("left", "right"))
    rows = slice(200, 296)
    return [(left[rows, 180:436], right[rows, 180 - by_px : 436 - by_px]) for by_px in moved_px]


def test_disparities_behind_the_screen_are_found_late_in_a_video(tmp_path, capsys):
    # Disparities are 11 to 21 px without the shift. The last two frames begin after more than a minute.
    pairs = converged_pairs([22] * 6 + [62] * 2)
    times_ms = range(0, 8 * 12_000, 12_000)
    video = write_side_by_side(tmp_path / "in.mp4", pairs, times_ms=times_ms, codec="libx264")
    words = ["--format", "side_by_side"]
    assert run(video, tmp_path / "depth.mkv", "--depth", *words) == 0
    with av.open(str(tmp_path / "depth.mkv")) as container:
        comment = container.metadata["COMMENT"]
    low_px, high_px = (
        float(word) for word in comment.replace(" px", "").split() if word.lstrip("-")[0].isdigit()
    )
    assert -62 + 10 < low_px < -62 + 16
    assert -22 + 16 < high_px < -22 + 22
    # A point with disparity d is at x - d / 2 in the middle view: the shift moves it 31 columns to the right.
    assert run(video, tmp_path / "view.mp4", "--position", "0.5", *words) == 0
    still = write_side_by_side(tmp_path / "still.mp4", converged_pairs([0]), codec="libx264")
    assert run(still, tmp_path / "unmoved.mp4", "--position", "0.5", *words) == 0
    moved, unmoved = (rgb_of(tmp_path / name)[-1].astype(int) for name in ("view.mp4", "unmoved.mp4"))
    assert np.abs(moved[:, 71:] - unmoved[:, 40:-31]).mean() < 6


def test_depth_in_16_bits_warns_of_disparities_outside_its_range(tmp_path, capsys):
    video = write_side_by_side(tmp_path / "in.mp4", converged_pairs([40, 40]), codec="libx264")
    assert run(video, tmp_path / "out.mkv", "--depth16", "--format", "side_by_side") == 0
    [line] = [line for line in capsys.readouterr().err.splitlines() if "16-bit" in line]
    assert line.startswith("16-bit grey covers 0 to 255.99 px; this video's disparities range from -2")
    assert line.endswith("are clipped; show all of them in colours (--depth)")


def test_frames_that_could_not_be_rectified_ask_for_a_calibration(tmp_path, capsys):
    left, right = (read_image(TEXTURED / f"{eye}.png") for eye in ("left", "right"))
    size = right.shape[1::-1]
    larger = cv2.warpAffine(right, cv2.getRotationMatrix2D((size[0] / 2, size[1] / 2), 0, 1.12), size)
    video = write_side_by_side(tmp_path / "in.mp4", [(left, larger)] * 2, codec="libx264")
    assert run(video, tmp_path / "out.mp4", "--depth", "--format", "side_by_side") == 0
    told = capsys.readouterr().err
    assert "larger than the left one; give a calibration (--calib)" in told


def _red_from_green(anaglyph: np.ndarray) -> float:
    return np.abs(anaglyph[..., 0].astype(int) - anaglyph[..., 1]).mean()


@pytest.mark.parametrize(
    ("settings", "names"),
    [
        ({"depth": True}, ["rehearse_carrying", "rehearse_voting"]),
        (
            {"position": 0.5},
            ["rehearse_carrying", "rehearse_voting", "rehearse_drawing", "rehearse_filling"],
        ),
        (
            {"position": 0.5, "bits": 10},
            ["rehearse_carrying", "rehearse_voting", "rehearse_fine_drawing"],
        ),
        ({"layout": "side_by_side"}, []),
    ],
    ids=["depth", "view", "view in 10 bits", "frames joined without matching"],
)
def test_the_kernels_of_a_conversion_are_compiled_ahead(tmp_path, monkeypatch, settings, names):
    asked = []

    def stop(*rehearsals):
        asked.extend(rehearse.__name__ for rehearse in rehearsals)
        raise StereoweaveError("enough")

    monkeypatch.setattr("stereoweave.video.convert.compile_ahead", stop)
    film = write_side_by_side(tmp_path / "in.mp4", example_pairs(1), codec="libx264")
    with pytest.raises(StereoweaveError, match="enough"):
        convert_video(open_video([film]), [film], tmp_path / "out.mp4", VideoJob(**settings), Console())
    assert asked == names


def test_cuts_are_forgotten_where_views_are_joined_without_matching(tmp_path, monkeypatch):
    cuts = []
    asked = FrameGrouper.began_shot
    monkeypatch.setattr(FrameGrouper, "began_shot", lambda *given: cuts.append(asked(*given)) or cuts[-1])
    noise = np.random.default_rng(0).uniform(0, 255, (2, 96, 128, 3))
    one, other = (np.clip(4 * cv2.GaussianBlur(shot, (0, 0), 1.5) - 384, 0, 255) for shot in noise)
    pairs = [(shot.astype(np.uint8),) * 2 for shot in (one, one, one, other, other)]
    video = write_side_by_side(tmp_path / "in.mp4", pairs, codec="libx264")
    assert run(video, tmp_path / "out.mp4", "--layout", "crossed", "--format", "side_by_side") == 0
    assert cuts == [False, False, False, True, False]


@pytest.mark.parametrize(
    "words",
    [
        ("--position", "0.4"),
        ("--position", "0.4", "--bits", "10"),
        ("--layout", "rgbd"),
        ("--depth", "--threads", "2"),
    ],
)
def test_an_interrupted_conversion_resumes_with_the_same_frames(tmp_path, monkeypatch, capsys, words):
    video = write_slow_video(tmp_path / "in.mp4", example_pairs(13))
    assert run(video, tmp_path / "whole.mp4", *words) == 0
    with monkeypatch.context() as patch:
        interrupt(patch)
        assert run(video, tmp_path / "broken.mp4", *words) == 130
    [folder] = tmp_path.glob("broken*.parts")
    [line] = [line for line in capsys.readouterr().err.splitlines() if line.startswith("stereoweave")]
    assert line.endswith(f": stopped; finished parts are in {folder}; rerun the same command to resume")
    assert sorted(path.name for path in folder.iterdir()) == [
        "000001.nut",
        "settings.json",
        "state-000001.npz",
    ]
    assert run(video, tmp_path / "broken.mp4", *words) == 0
    [whole], [broken] = tmp_path.glob("whole*"), tmp_path.glob("broken*")
    np.testing.assert_array_equal(frames_of(broken), frames_of(whole))
    assert times_of(broken) == times_of(video)


def test_a_resumed_conversion_reports_where_it_goes_on(tmp_path, monkeypatch, capsys):
    video = write_slow_video(tmp_path / "in.mp4", example_pairs(10))
    with monkeypatch.context() as patch:
        interrupt(patch)
        assert run(video, tmp_path / "out.mp4", "--depth") == 130
    capsys.readouterr()
    assert run(video, tmp_path / "out.mp4", "--depth") == 0
    # The first part has five frames of 0.8 s.
    assert capsys.readouterr().err.splitlines()[0] == "out.mp4: resuming at 0:00:04"


def test_a_preview_is_the_middle_of_a_video(tmp_path, capsys):
    video = write_side_by_side(
        tmp_path / "in.mp4", example_pairs(10), times_ms=range(0, 10_000, 1000), codec="libx264", sound=True
    )
    (tmp_path / "out.mkv").write_bytes(b"an evening's work")
    assert run(video, tmp_path / "out.mkv", "--depth16", "--preview", "3s") == 0
    assert (tmp_path / "out.mkv").read_bytes() == b"an evening's work"
    told = capsys.readouterr().out.splitlines()
    assert told[0] == f"{tmp_path / 'out_preview.mkv'}: 3 frames"
    assert told[1].startswith("the whole video takes about ")
    # The three seconds begin at 3.5 s, and their first frame is the one at 4 s.
    with av.open(str(tmp_path / "out_preview.mkv")) as container:
        assert not container.streams.audio
        grey = next(container.decode(video=0)).to_ndarray()
    fifth = list(open_video([video]).frames())[4]
    np.testing.assert_array_equal(grey, np.rint(256 * sharp_disparity_of(fifth)))


def test_an_output_in_use_is_refused_until_its_process_is_killed(tmp_path, capsys):
    video, out = write_slow_video(tmp_path / "in.mp4", example_pairs(13)), tmp_path / "out.mp4"
    program = "import sys; from stereoweave.cli.root import main; sys.exit(main())"
    words = ["video", video, "-o", out, "--depth", "--threads", "1"]
    first = subprocess.Popen([sys.executable, "-c", program, *words], stderr=subprocess.DEVNULL)
    while not any(tmp_path.glob("*.parts/*.nut")) and first.poll() is None:
        time.sleep(0.002)
    (tmp_path / "link").symlink_to(tmp_path)
    with halted(first):
        assert run(video, tmp_path / "link" / "out.mp4", "--depth") == 2
        first.kill()
    assert capsys.readouterr().err == (
        f"stereoweave: {tmp_path / 'link' / 'out.mp4'}: expected an output to which no other "
        "command is writing, found one that is in use; wait for the other command to finish, or choose "
        "another output\n"
    )
    assert first.wait() == -signal.SIGKILL
    assert run(video, out, "--depth") == 0
    assert len(frames_of(out)) == 13
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.mp4", "link", "out.mp4"]


def test_parts_made_with_other_settings_are_not_resumed(tmp_path, monkeypatch, capsys):
    video = write_slow_video(tmp_path / "in.mp4", example_pairs(10))
    with monkeypatch.context() as patch:
        interrupt(patch)
        assert run(video, tmp_path / "out.mp4", "--position", "0.4", "--convergence", "3") == 130
    capsys.readouterr()
    assert run(video, tmp_path / "out.mp4", "--position", "0.6") == 2
    folder = tmp_path / "out.mp4.parts"
    assert capsys.readouterr().err == (
        f"stereoweave: {folder}: expected parts made with the current settings, found parts made with "
        "--position 0.4, with --convergence 3.0; remove this folder, or rerun with the same settings\n"
    )


def test_a_full_disk_is_reported_in_one_line_that_says_how_to_resume(tmp_path):
    video = write_slow_video(tmp_path / "in.mp4", example_pairs(135))
    assert run(video, tmp_path / "whole.mkv", "--depth16") == 0
    # There is room for each part and for the state after it (0.9 MB), but not for the joined video.
    room_bytes = int(0.8 * (tmp_path / "whole.mkv").stat().st_size)
    words = ["video", str(video), "-o", str(tmp_path / "out.mkv"), "--depth16"]
    program = (
        "import resource, sys; from stereoweave.cli.root import main; "
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({room_bytes}, {room_bytes})); sys.exit(main({words}))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    folder = tmp_path / "out.mkv.parts"
    assert done.stderr.splitlines()[-1] == (
        f"stereoweave: {tmp_path / 'out.mkv'}: expected a writable file, found file too large; "
        f"finished parts are in {folder}; rerun the same command to resume"
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.mp4", "out.mkv.parts", "whole.mkv"]
    assert len(list(folder.glob("*.nut"))) == 27
    assert run(video, tmp_path / "out.mkv", "--depth16") == 0
    np.testing.assert_array_equal(frames_of(tmp_path / "out.mkv"), frames_of(tmp_path / "whole.mkv"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.mp4", "out.mkv", "whole.mkv"]


def test_a_damaged_frame_is_reported_with_its_time_and_does_not_end_the_video(tmp_path, capsys):
    video = damage(write_side_by_side(tmp_path / "in.mkv", example_pairs(12), codec="mjpeg"), 5)
    assert run(video, tmp_path / "out.mkv", "--position", "0.5") == 0
    told = capsys.readouterr().out.splitlines()
    assert told[0].endswith("12 frames")
    assert told[1] == "problems in 1 of 12 frames: 0:00:00.200 damaged: replaced by the frame before it"
    assert times_of(tmp_path / "out.mkv") == times_of(video)


@pytest.mark.parametrize(
    ("out", "words", "told"),
    [
        ("out.mp4", [], "found none; choose one (--depth, --depth10, --depth16, --position, --layout)"),
        (
            "out.mp4",
            ["--depth", "--position", "0"],
            "expected one kind of output, found depth and position; ",
        ),
        ("out.mp4", ["--layout", "wiggle"], "--layout: expected one of side_by_side, "),
        ("out.mp4", ["--position", "2.5"], "--position: expected -1 to 2"),
        ("out.mp4", ["--position", "1", "--strength", "4"], "position 1 at strength 4"),
        ("out.gif", ["--depth"], "expected the file extension .mp4 or .mkv or .mov, found .gif"),
        ("out.mp4", ["--depth16"], "expected the file extension .mkv for 16-bit depth, found .mp4"),
        ("in.mp4", ["--depth"], "in.mp4: expected a new file, found one of the inputs"),
        ("out.mp4", ["--depth", "--model", "huge"], "unknown model 'huge'"),
        ("out.mp4", ["--depth", "--format", "diagonal"], "--format: expected one of side_by_side"),
        ("out.mp4", ["--position", "0", "--convergence", "nan"], "--convergence: expected a finite number"),
        (
            "out.mp4",
            ["--layout", "side_by_side_half", "--convergence", "999"],
            "(the picture's width), got 999",
        ),
        ("out.mp4", ["--layout", "quilt", "--convergence", "-inf"], "expected a finite number, found -inf"),
        ("out.mp4", ["--position", "0.5", "--strength", "inf"], "--strength: expected a finite number"),
        ("out.mp4", ["--depth", "--convergence", "3"], "--convergence: expected a view or a layout of views"),
        ("out.mkv", ["--depth16", "--strength", "2"], "as output, found depth16"),
        ("out.mp4", ["--layout", "rgbd", "--convergence", "0"], "as output, found layout rgbd"),
        ("out.mp4", ["--depth", "--rate", "24"], "which has a rate of its own; leave the rate out (--rate)"),
        ("out.mp4", ["--depth", "--rate", "1/0"], "--rate: expected frames per second"),
        ("out.mp4", ["--depth", "--rate", "-5"], "--rate: expected frames per second"),
        ("out.mp4", ["--depth", "--rate", "1e300"], "at most 1000, such as 24 or 30000/1001, found '1e300'"),
        ("out.mp4", ["--depth", "--rate", ""], "found an empty one; is a variable unset?"),
        ("out.mp4", ["--depth", "--preview", "soon"], "--preview: expected seconds above 0, such as 5s, "),
        ("out.mp4", ["--depth", "--preview", "0s"], "--preview: expected seconds above 0, such as 5s, "),
    ],
)
def test_an_impossible_output_is_refused_in_one_line_before_any_work(tmp_path, capsys, out, words, told):
    video = write_side_by_side(tmp_path / "in.mp4", example_pairs(2), codec="libx264")
    before = video.read_bytes()
    assert run(video, tmp_path / out, *words) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert told in line
    assert [path.name for path in tmp_path.iterdir()] == ["in.mp4"]
    assert video.read_bytes() == before


@pytest.mark.parametrize("command", ["video -o out.mp4 --depth", "live --no-browser"])
def test_the_old_name_of_format_is_accepted_with_a_warning(capsys, command):
    assert main([*command.split(), "none.mp4", "--arrangement", "diagonal"]) == 2
    told = capsys.readouterr().err
    assert told.startswith(
        "stereoweave: warning: --arrangement is deprecated; use --format\nstereoweave: --format: expected "
    )
    assert "diagonal" in told
    assert main([*command.split(), "none.mp4", "--arrangement", "crossed", "--format", "crossed"]) == 2
    assert capsys.readouterr().err == (
        "stereoweave: --arrangement: expected only --format, which replaces --arrangement, found both\n"
    )
    assert main([command.split()[0], "--help"]) == 0
    assert "--arrangement" not in capsys.readouterr().out


def test_a_file_that_is_not_a_3d_video_is_refused_in_one_line(tmp_path, capsys):
    wide = [np.hstack([left, np.flip(left)]) for left, _ in example_pairs(2)]
    flat = write_video(tmp_path / "flat.mp4", wide, codec="libx264")
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(flat.read_bytes()[:400])
    for video, told in ((flat, "expected a 3-D video"), (broken, "expected a video")):
        assert run(video, tmp_path / "out.mp4", "--depth") == 2
        [line] = capsys.readouterr().err.splitlines()
        assert told in line
    assert sorted(path.name for path in tmp_path.iterdir()) == ["broken.mp4", "flat.mp4"]


def test_swapped_views_are_noted_with_the_frame_packing_that_corrects_them(tmp_path, capsys):
    pairs = example_pairs(2, width=320, height=192)
    crossed = write_side_by_side(tmp_path / "in.mp4", pairs, layout="crossed", codec="libx264")
    assert run(crossed, tmp_path / "a.mp4", "--depth", "--format", "side_by_side", "--no-rectify") == 0
    told = capsys.readouterr().err
    assert told.count("swapped; choose crossed (--format)") == 1
    assert run(crossed, tmp_path / "b.mp4", "--depth", "--format", "crossed") == 0
    assert "swapped" not in capsys.readouterr().err


def test_defects_are_found_beyond_the_first_minute(tmp_path, capsys):
    # At 6 frames per minute. Of the three checked frames, 1, 4 and 7, the last two are swapped.
    pairs = example_pairs(8, width=320, height=192)
    pairs = [pair if index < 3 else pair[::-1] for index, pair in enumerate(pairs)]
    times_ms = range(0, 8 * 10_000, 10_000)
    video = write_side_by_side(tmp_path / "in.mp4", pairs, times_ms=times_ms, codec="libx264")
    words = ["--position", "0", "--format", "side_by_side", "--no-rectify"]
    assert run(video, tmp_path / "out.mp4", *words) == 0
    assert capsys.readouterr().err.count("in most of the video: left and right are swapped; choose") == 1


def test_swapped_videos_are_noted_without_a_frame_packing(tmp_path, capsys):
    pairs = example_pairs(2, width=320, height=192)
    left, right = (write_video(tmp_path / f"{eye}.mp4", [pair[eye] for pair in pairs]) for eye in (0, 1))
    words = ["video", str(right), str(left), "-o", str(tmp_path / "out.mp4"), "--position", "0"]
    assert main([*words, "--no-rectify"]) == 0
    told = capsys.readouterr().err
    assert "swapped" in told
    assert "--format" not in told


def test_shots_out_of_line_are_rectified_and_swapped_videos_swapped_back(tmp_path, capsys):
    """The right views of the second shot are 5 px lower; the result must be that of the sound video."""
    first, second = (
        [(cut(pair.left), cut(pair.right))] * 3
        for pair in (paint_collage(77, 0, index, 240, 320) for index in (2, 6))
    )
    lowered = [(left, np.roll(right, 5, axis=0)) for left, right in second]
    sound = write_side_by_side(tmp_path / "sound.mkv", first + second, codec="libx264")
    odd = [(right, left) for left, right in first + lowered]
    mixed = write_side_by_side(tmp_path / "mixed.mkv", odd, codec="libx264")
    for video in (sound, mixed):
        out = tmp_path / f"{video.stem}_depth.mkv"
        assert run(video, out, "--depth16", "--format", "side_by_side") == 0
    told = capsys.readouterr().err
    assert "left and right were swapped" in told
    expected, found = (frames_of(tmp_path / f"{name}_depth.mkv") for name in ("sound", "mixed"))
    for index in (0, 5):
        off_px = (found[index].astype(float) - expected[index])[20:-20, 20:-20] / 256
        assert np.median(np.abs(off_px - np.median(off_px))) < 0.5


@pytest.mark.parametrize(("kind", "value"), [("depth16", " = value / 256"), ("depth", " px is red")])
def test_a_rectified_shot_leaves_the_whole_video_without_metres(tmp_path, kind, value):
    """The right views of the first shot are 5 px lower; the second shot is sound."""
    lowered, sound = (paint_collage(77, 0, index, 240, 320) for index in (2, 6))
    pairs = [(cut(lowered.left), cut(np.roll(lowered.right, 5, axis=0)))] * 3
    pairs += [(cut(sound.left), cut(sound.right))] * 3
    source = write_side_by_side(tmp_path / "in.mkv", pairs, codec="libx264")
    comments = []
    for rectify in (True, False):
        video = open_video([source], "side_by_side")
        video.camera = StereoCamera(focal_px=300, baseline_m=0.1, cx_px=159.5, cy_px=95.5)
        job = VideoJob(**{kind: True}, rectify=rectify, backend=Backend(threads=1))
        out = tmp_path / f"{rectify}.mkv"
        convert_video(video, [source], out, job, Console(quiet=True))
        with av.open(str(out)) as container:
            comments.append(container.metadata["COMMENT"])
    assert comments[0].endswith(f"{value}; no depth in metres, because frames were rectified")
    assert " m)" not in comments[0]
    assert "depth in metres = 7680 / value" in comments[1] or "m) is red" in comments[1]  # 300 * 0.1 * 256


def cut(image):
    return np.ascontiguousarray(image[:192])


def write_pictures(folder: Path, count: int) -> Path:
    for index, (left, right) in enumerate(example_pairs(count)):
        write_image(folder / f"{index:03}.png", np.hstack([left, right]))
    return folder


def test_a_series_of_pictures_has_the_rate_that_is_given(tmp_path, capsys):
    folder = write_pictures(tmp_path / "frames", 3)
    assert run(folder, tmp_path / "out.mp4", "--position", "0.5", "--rate", "30000/1001") == 0
    assert times_of(tmp_path / "out.mp4") == [index * Fraction(1001, 30_000) for index in range(3)]


@pytest.mark.parametrize("pattern", ["", "*.png"])
def test_a_series_with_a_changed_picture_is_not_resumed(tmp_path, monkeypatch, capsys, pattern):
    folder = write_pictures(tmp_path / "frames", 10)
    out = (folder / pattern).with_name("out.mp4")
    words = ["--position", "0.5", "--rate", "0.5"]
    with monkeypatch.context() as patch:
        interrupt(patch)
        assert run(folder / pattern, out, *words) == 130
    status = (folder / "006.png").stat()
    os.utime(folder / "006.png", ns=(status.st_atime_ns, status.st_mtime_ns + 1_000_000))
    capsys.readouterr()
    assert run(folder / pattern, out, *words) == 2
    assert "found parts made with another video;" in capsys.readouterr().err


def test_a_conversion_with_another_frame_packing_is_not_resumed(tmp_path, monkeypatch, capsys):
    video = write_slow_video(tmp_path / "in.mp4", example_pairs(10))
    with monkeypatch.context() as patch:
        interrupt(patch)
        assert run(video, tmp_path / "out.mp4", "--position", "0.5") == 130
    capsys.readouterr()
    assert run(video, tmp_path / "out.mp4", "--position", "0.5", "--format", "crossed") == 2
    assert "found parts made with --format side_by_side;" in capsys.readouterr().err


def test_an_interrupt_while_the_video_is_opened_is_reported_in_one_line(tmp_path, monkeypatch, capsys):
    video = write_side_by_side(tmp_path / "in.mp4", example_pairs(2), codec="libx264")
    monkeypatch.setattr("stereoweave.video.reader.StereoVideo", lambda *_: signal.raise_signal(signal.SIGINT))
    assert run(video, tmp_path / "out.mp4", "--depth") == 130
    assert capsys.readouterr().err == "stereoweave: stopped\n"


def test_a_video_of_one_frame_is_converted_to_one_frame(tmp_path, capsys):
    video = write_side_by_side(tmp_path / "in.mp4", example_pairs(1), codec="libx264")
    assert run(video, tmp_path / "out.mp4", "--position", "0.5") == 0
    assert capsys.readouterr().out == f"{tmp_path / 'out.mp4'}: 1 frame\n"


def test_each_converted_frame_is_shown_to_who_asks(tmp_path):
    pairs = example_pairs(5)
    source = write_side_by_side(tmp_path / "in.mp4", pairs)
    seen = []
    job = VideoJob(layout="side_by_side_half", backend=Backend(threads=1), on_converted=seen.append)
    video = open_video([source], "side_by_side")
    convert_video(video, [source], tmp_path / "out.mp4", job, Console(quiet=True))
    assert [frame.time for frame, *_ in seen] == [Fraction(number, 25) for number in range(5)]
    for converted, (left, _), written in zip(seen, pairs, rgb_of(tmp_path / "out.mp4"), strict=True):
        assert np.abs(converted.frame.left - left.astype(float)).mean() < 3
        assert converted.pair.left.shape == (96, 80, 3)
        assert converted.estimate.disparity_px.shape == (96, 80)
        assert np.abs(converted.picture - written.astype(float)).mean() < 4
