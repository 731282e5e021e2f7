"""`stereoweave video --screen`: whole conversions, resuming, layouts, odd films, and mistakes."""

import re
from pathlib import Path

import numpy as np
import pytest
from conversions import frames_of, interrupt, run, write_slow_video
from faulty_video_examples import box_at_the_left_border, shot_of
from video_examples import TEXTURED, example_pairs, flat_pairs, truncate, write_side_by_side

from stereoweave.errors import StereoweaveError
from stereoweave.matching.estimate import match
from stereoweave.matching.matcher import Matcher
from stereoweave.rendering.comfort import measure_depth
from stereoweave.stereo import StereoPair
from stereoweave.video.reader import open_video
from stereoweave.video.writer import Recorder

pytestmark = pytest.mark.usefixtures("default_interrupts")


def cut_video(path: Path) -> Path:
    """Write a video with a cut in its second part."""
    pairs = example_pairs(7) + [(left[::-1], right[::-1]) for left, right in example_pairs(10)[7:]]
    return write_slow_video(path, pairs)


def eyes_of(video: Path) -> list:
    return list(open_video([video], "side_by_side").frames())


def test_the_depth_of_the_output_is_within_the_budget(tmp_path, capsys):
    video = write_side_by_side(tmp_path / "in.mp4", shot_of(TEXTURED, 3), codec="libx264")
    assert run(video, tmp_path / "out.mp4", "--layout", "side_by_side", "--screen", "television") == 0
    line = capsys.readouterr().out.splitlines()[1]
    assert line.startswith("television: strength ")
    assert line.endswith("px, depth -1.0 % to +2.0 % of the width")
    for frame in eyes_of(tmp_path / "out_LRF_Full_SBS.mp4"):
        # 1 % and 2 % of 320 px, as found in the pictures after compression.
        pair = StereoPair(left=frame.left, right=frame.right)
        found = measure_depth(match(Matcher("small", threads=1), pair))
        assert found.near_px == pytest.approx(3.2, abs=0.8)
        assert found.far_px == pytest.approx(-6.4, abs=0.8)


def test_a_box_at_the_border_gets_a_floating_window(tmp_path):
    video = write_side_by_side(tmp_path / "in.mp4", box_at_the_left_border(2), codec="libx264")
    # The wall stays on the screen, and the box is 12 px in front, less than 4 % of 320 px.
    words = ("--layout", "side_by_side", "--screen", "light_field", "--convergence", "0")
    assert run(video, tmp_path / "out.mp4", *words) == 0
    for frame in eyes_of(tmp_path / "out_LRF_Full_SBS.mp4"):
        black = frame.left.max((0, 2)) < 40
        assert black[:10].all()
        assert not black[15:].any()
        assert not (frame.right.max((0, 2)) < 40).any()


@pytest.mark.parametrize("layout", ["side_by_side", "top_bottom_half"])
def test_an_interrupted_conversion_for_a_screen_resumes_with_the_same_frames(
    tmp_path, monkeypatch, capsys, layout
):
    words = ("--layout", layout, "--screen", "phone")
    video = cut_video(tmp_path / "in.mp4")
    assert run(video, tmp_path / "whole.mp4", *words) == 0
    with monkeypatch.context() as patch:
        interrupt(patch)
        assert run(video, tmp_path / "broken.mp4", *words) == 130
    before = capsys.readouterr().out.splitlines()
    assert run(video, tmp_path / "broken.mp4", *words) == 0
    [whole], [broken] = tmp_path.glob("whole*"), tmp_path.glob("broken*")
    np.testing.assert_array_equal(frames_of(broken), frames_of(whole))
    # The line at the end counts the frames before the interruption, too.
    assert capsys.readouterr().out.splitlines()[1] == before[1]


def test_a_conversion_that_stopped_before_the_parts_were_joined_still_reports_the_screen(
    tmp_path, monkeypatch, capsys
):
    def fail(*_):
        raise StereoweaveError("no space")

    video = write_side_by_side(tmp_path / "in.mp4", example_pairs(1), codec="libx264")
    words = "--layout", "side_by_side", "--screen", "phone"
    with monkeypatch.context() as patch:
        patch.setattr(Recorder, "join", fail)
        assert run(video, tmp_path / "out.mp4", *words) == 2
    assert run(video, tmp_path / "out.mp4", *words) == 0
    assert capsys.readouterr().out.splitlines()[1].startswith("phone: strength ")


def test_parts_for_another_screen_are_not_resumed(tmp_path, monkeypatch, capsys):
    video = cut_video(tmp_path / "in.mp4")
    with monkeypatch.context() as patch:
        interrupt(patch)
        assert run(video, tmp_path / "out.mp4", "--layout", "side_by_side", "--screen", "phone") == 130
    capsys.readouterr()
    assert run(video, tmp_path / "out.mp4", "--layout", "side_by_side", "--screen", "headset") == 2
    assert "found parts made with another --screen" in capsys.readouterr().err


def test_half_width_gives_the_values_of_the_full_width(tmp_path, capsys):
    video = write_side_by_side(tmp_path / "in.mp4", shot_of(TEXTURED, 2), codec="libx264")
    values = []
    for layout in ("side_by_side", "side_by_side_half"):
        assert run(video, tmp_path / "out.mp4", "--layout", layout, "--screen", "television") == 0
        line = capsys.readouterr().out.splitlines()[1]
        found = re.search(r"strength ([\d.]+)(?: to [\d.]+)?, convergence (-?[\d.]+) px", line)
        values.append([float(number) for number in found.groups()])
    strength, convergence_px = values[0][0], values[0][1]
    assert values[1][0] == pytest.approx(strength, abs=0.06)
    assert values[1][1] == pytest.approx(convergence_px, abs=1.5)


@pytest.mark.parametrize("layout", ["quilt", "contact_sheet"])
def test_layouts_of_many_views_are_fitted_without_windows(tmp_path, capsys, layout):
    video = write_side_by_side(tmp_path / "in.mp4", example_pairs(1), codec="libx264")
    assert run(video, tmp_path / "out.mp4", "--layout", layout, "--screen", "light_field") == 0
    assert capsys.readouterr().out.splitlines()[1].startswith("light_field: strength")


def one_eye_black(pairs: list, side: int) -> list:
    return [
        tuple(np.zeros_like(eye) if index == side else eye for index, eye in enumerate(pair))
        for pair in pairs
    ]


ODD = {
    "one frame": lambda: example_pairs(1),
    "two frames": lambda: example_pairs(2),
    "left eye black": lambda: one_eye_black(example_pairs(3), 0),
    "right eye black": lambda: one_eye_black(example_pairs(3), 1),
    "black": lambda: [(np.zeros((96, 160, 3), np.uint8),) * 2] * 3,
    "one colour": lambda: flat_pairs(3),
    "the same view twice": lambda: [(left, left) for left, _ in example_pairs(3)],
    "swapped": lambda: [pair[::-1] for pair in example_pairs(3)],
    "a cut at each frame": lambda: [example_pairs(1)[0], flat_pairs(1, width=160, height=96)[0]] * 3,
}


@pytest.mark.parametrize("name", ODD)
def test_an_odd_film_is_converted_or_refused_in_one_line(name, tmp_path, capsys):
    video = write_side_by_side(tmp_path / "in.mp4", ODD[name](), codec="libx264")
    words = ("--layout", "side_by_side", "--screen", "phone", "--format", "side_by_side")
    assert run(video, tmp_path / "out.mp4", *words) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].startswith("phone: ")
    assert "nan" not in lines[1]
    assert "inf" not in lines[1]


def test_a_cut_file_is_converted_as_far_as_it_goes(tmp_path, capsys):
    whole = write_side_by_side(tmp_path / "in.mkv", example_pairs(20), codec="libx264", options={"g": "4"})
    video = truncate(whole, 0.6)
    assert run(video, tmp_path / "out.mp4", "--layout", "side_by_side", "--screen", "phone") == 0
    assert "phone: strength" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (
            "--depth --screen phone",
            "--screen: expected only with a layout of several views, found",
        ),
        ("--position 0.5 --screen phone", "found with position"),
        ("--layout rgbd --screen phone", "found with rgbd"),
        (
            "--layout side_by_side --screen cinema",
            "--screen: expected one of phone, television",
        ),
        ("--layout quilt --screen phone --strength 9", "strength: expected views from -1 to 2"),
        ("--layout side_by_side --screen phone --convergence nan", "--convergence: expected a finite number"),
    ],
)
def test_a_mistake_is_one_line(words, expected, tmp_path, capsys):
    assert run(tmp_path / "missing.mp4", tmp_path / "out.mp4", *words.split()) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert expected in line
