import re
import sys
from fractions import Fraction
from itertools import pairwise

import av
import numpy as np
import pytest
from opened_videos import assert_eyes, refusal
from video_examples import (
    FRAME_MS,
    damage,
    example_pairs,
    flat_pairs,
    packed,
    packets,
    truncate,
    write_side_by_side,
    write_video,
)

from stereoweave.errors import StereoweaveError
from stereoweave.io.images import write_image
from stereoweave.pictures.pair_layouts import PAIR_LAYOUTS, detect_layout, measure_resemblance
from stereoweave.video import tracks
from stereoweave.video.picture_track import list_picture_files
from stereoweave.video.reader import open_video
from stereoweave.video.tracks import open_track

BEFORE = "damaged: replaced by the frame before it"
SPOILT = "decoded from a damaged frame before it"


def assert_same(frames, others):
    for frame, other in zip(frames, others, strict=True):
        np.testing.assert_array_equal(frame.left, other.left)
        np.testing.assert_array_equal(frame.right, other.right)
        assert frame[2:] == other[2:]


def problems(video):
    return {index: frame.problem for index, frame in enumerate(video.frames()) if frame.problem}


def write_pictures(folder, pattern, images):
    for index, image in enumerate(images, start=8):
        write_image(folder / pattern.format(index), image)


@pytest.mark.parametrize("format", PAIR_LAYOUTS)
def test_each_frame_packing_gives_both_eyes_at_full_size(tmp_path, format):
    pairs = flat_pairs(3, height=72)
    path = write_side_by_side(tmp_path / "video.mkv", pairs, layout=format, codec="ffv1")
    video = open_video([path], format)
    assert video.size_px == (64, 72)
    assert (video.frame_count, video.rate, video.sound) == (3, 25, None)
    assert_eyes(video.frames(), pairs)


@pytest.mark.parametrize("format", ["side_by_side", "side_by_side_half", "top_bottom", "top_bottom_half"])
def test_an_undeclared_frame_packing_is_detected(tmp_path, format):
    pairs = example_pairs(5)
    path = write_side_by_side(tmp_path / "video.mkv", pairs, layout=format, codec="ffv1")
    lost_in_half = 3.0 if format.endswith("half") else 0.0
    assert_eyes(open_video([path]).frames(), pairs, lost_in_half)


@pytest.mark.parametrize(
    ("name", "width", "height", "format"),
    [
        ("video_RL.mkv", 1280, 480, "crossed"),
        ("video_RL.mkv", 640, 480, "crossed_half"),
        ("my-video.sbs.mkv", 1280, 480, "side_by_side"),
        ("my-video.sbs.mkv", 640, 480, "side_by_side_half"),
        ("video [half-SBS].mkv", 1280, 480, "side_by_side_half"),
        ("video_full_SBS.mkv", 640, 480, "side_by_side"),
        ("video_TB.mkv", 640, 960, "top_bottom"),
        ("video_TB.mkv", 640, 480, "top_bottom_half"),
        ("video.HOU.mkv", 640, 960, "top_bottom_half"),
        ("sbs/video_TB.mkv", 640, 960, "top_bottom"),
    ],
)
def test_the_file_name_decides_if_the_images_do_not(name, width, height, format):
    assert detect_layout(name, [np.full((height, width, 3), 90, np.uint8)]) == format


def test_a_misleading_file_name_is_ignored(tmp_path):
    path = write_video(tmp_path / "video_LR.mkv", [left for left, _ in example_pairs(3)])
    assert "do not resemble each other" in refusal(path)


def test_the_frame_packing_that_the_container_declares_is_used(tmp_path):
    pairs = flat_pairs(3)
    for mode, format in (("right_left", "crossed"), ("left_right", "side_by_side"), ("top_bottom",) * 2):
        path = tmp_path / f"{mode}.mkv"
        write_side_by_side(path, pairs, layout=format, stereo_mode=mode, codec="ffv1")
        assert_eyes(open_video([path]).frames(), pairs)


def test_the_frame_packing_that_h264_frames_declare_is_used(tmp_path):
    pairs = flat_pairs(3)
    path = tmp_path / "video.mp4"
    options = {"x264-params": "frame-packing=3"}
    write_side_by_side(path, pairs, codec="libx264", options=options)
    assert_eyes(open_video([path]).frames(), pairs, tolerance=1.5)


def test_an_unsupported_declared_frame_packing_is_named(tmp_path):
    options = {"x264-params": "frame-packing=3"}
    path = write_side_by_side(tmp_path / "video.mp4", flat_pairs(2), codec="libx264", options=options)
    # The message's kind and length; identifier 0, no cancelling, side by side; then a bit for quincunx.
    found = re.compile(rb"(\x2d.\x81)\x81", re.DOTALL)
    changed, count = found.subn(lambda match: match[1] + b"\xc1", path.read_bytes())
    assert count
    path.write_bytes(changed)
    assert "video.mp4: " in refusal(path)
    declared = "declares side_by_side_quincunx; if that is wrong, choose its layout, such as side_by_side"
    assert declared in refusal(path)
    assert open_video([path], "side_by_side").frame_count == 2


def test_a_video_that_is_not_3d_is_refused_with_a_remedy(tmp_path):
    path = write_video(tmp_path / "video.mkv", [left for left, _ in example_pairs(5)])
    message = refusal(path)
    assert message.startswith(f"{path}: expected a 3-D video")
    assert "(format)" in message
    assert "two files" in message
    assert open_video([path], "side_by_side_half").size_px == (160, 96)


def test_a_plain_video_is_refused_as_too_plain(tmp_path):
    path = write_side_by_side(tmp_path / "video.mkv", flat_pairs(2))
    assert "too plain" in refusal(path)


def test_only_two_views_of_one_scene_resemble_each_other():
    ((left, right),) = example_pairs(1, width=320, height=240)
    assert measure_resemblance(left, left) == pytest.approx(1, abs=0.001)
    assert measure_resemblance(left, right) > 0.6
    assert measure_resemblance(left, left[::-1].copy()) < 0.3
    assert measure_resemblance(left, left * 0) < 0.1
    assert np.isnan(measure_resemblance(left * 0, left))


@pytest.mark.parametrize(
    ("format", "size_px", "line"),
    [
        ("side_by_side", (80, 97), "column is dropped, because the width, 161 px, is odd"),
        ("side_by_side_half", (160, 97), "column is dropped, because the width, 161 px, is odd"),
        ("top_bottom", (161, 48), "row is dropped, because the height, 97 px, is odd"),
    ],
)
def test_of_an_odd_size_the_last_line_is_dropped_and_told(tmp_path, format, size_px, line):
    noise = np.random.default_rng(0).integers(0, 256, (97, 161, 3), dtype=np.uint8)
    video = open_video([write_video(tmp_path / "video.mkv", [noise], codec="libx264rgb")], format)
    assert video.size_px == size_px
    assert [str(note) for note in video.notes] == [f"the last {line}"]
    (frame,) = video.frames()
    assert frame.left.shape == frame.right.shape == (size_px[1], size_px[0], 3)


def test_a_frame_too_small_for_two_views_is_refused(tmp_path):
    path = write_video(tmp_path / "video.mkv", [np.zeros((96, 61, 3), np.uint8)], codec="ffv1")
    assert refusal(path, format="crossed").startswith(
        f"{path}: expected a width of at least 64 pixels for two views, found 61x96"
    )


def test_frame_times_are_relative_to_the_first_frame(tmp_path):
    times_ms = [2000, 2040, 2107, 2140, 2900]
    for name in ("video.mkv", "video.mp4"):
        path = write_side_by_side(
            tmp_path / name, flat_pairs(5), times_ms=times_ms, layout="top_bottom", codec="libx264"
        )
        video = open_video([path], "top_bottom")
        times = [frame.time for frame in video.frames()]
        assert times == [Fraction(time_ms - 2000, 1000) for time_ms in times_ms]
        assert all((time / video.time_base).denominator == 1 for time in times)
        assert video.rate == Fraction(4000, 900)


def test_a_damaged_frame_is_bridged_and_frames_decoded_from_it_are_marked(tmp_path):
    path = write_side_by_side(tmp_path / "video.mkv", example_pairs(30))
    whole = list(open_video([path]).frames())
    assert not any(frame.problem for frame in whole)
    video = open_video([damage(path, 14)])
    frames = list(video.frames())
    # By default, every twelfth frame of MPEG-4 is a key frame.
    assert problems(video) == {14: BEFORE} | dict.fromkeys(range(15, 24), SPOILT)
    assert_eyes([frames[14]], [whole[13][:2]])
    assert [frame.time for frame in frames] == [frame.time for frame in whole]
    assert_same(frames[:14] + frames[24:], whole[:14] + whole[24:])
    assert video.frame_count == len(packets(path, "video")) == 30


@pytest.mark.parametrize("codec", ["libx264", "mpeg4", "mjpeg"])
def test_a_run_from_the_middle_gives_the_frames_of_a_full_run(tmp_path, codec):
    options = {} if codec == "mjpeg" else {"g": "8"}
    path = damage(
        write_side_by_side(tmp_path / "video.mkv", example_pairs(20), codec=codec, options=options), 8, 11, 12
    )
    video = open_video([path], "side_by_side")
    frames = list(video.frames())
    assert len(frames) == 20
    assert any(frame.problem == BEFORE for frame in frames)
    for start in (1, 8, 9, 11, 12, 13, 17, 19):
        assert_same(video.frames(start), frames[start:])
    assert list(video.frames(20)) == []


def test_only_damaged_frames_are_replaced_if_all_are_key_frames(tmp_path):
    path = write_side_by_side(tmp_path / "video.mkv", example_pairs(8), codec="mjpeg")
    assert problems(open_video([damage(path, 3, 4)])) == {3: BEFORE, 4: BEFORE}


def test_a_damaged_first_frame_is_replaced_by_the_next_one(tmp_path):
    path = damage(write_side_by_side(tmp_path / "video.mkv", example_pairs(5), codec="mjpeg"), 0)
    video = open_video([path])
    frames = list(video.frames())
    assert frames[0].problem == "damaged: replaced by the frame after it"
    assert_eyes([frames[0]], [frames[1][:2]])
    assert_same(video.frames(1), frames[1:])


def test_a_truncated_video_is_read_to_its_end_and_reported(tmp_path):
    path = truncate(write_side_by_side(tmp_path / "video.mkv", example_pairs(30), codec="ffv1"), 0.5)
    video = open_video([path])
    assert 10 < video.frame_count < 20
    [(last, problem)] = problems(video).items()
    assert last == video.frame_count - 1
    assert problem == f"{path} breaks off after this frame (its declared duration is 1.2 s)"


def test_a_truncated_mp4_is_refused_with_the_reason(tmp_path):
    path = truncate(write_side_by_side(tmp_path / "video.mp4", example_pairs(10)), 0.6)
    assert "its index is lost" in refusal(path)


def test_only_a_file_that_begins_as_an_mp4_is_reported_as_cut_off(tmp_path):
    (tmp_path / "text.mp4").write_text("no video\n" * 100)
    (tmp_path / "empty.mp4").touch()
    assert "index" not in refusal(tmp_path / "text.mp4")
    assert refusal(tmp_path / "empty.mp4").endswith("empty.mp4: expected a video, found an empty file")


def test_a_path_without_a_video_is_refused_in_one_line(tmp_path):
    (tmp_path / "text.mkv").write_text("no video\n" * 100)
    (tmp_path / "empty").mkdir()
    for name in ("text.mkv", "missing.mp4", "empty", "frames_*.png"):
        message = refusal(tmp_path / name)
        assert message.startswith(f"{tmp_path / name}: expected")
    assert "index" not in refusal(tmp_path / "missing.mp4")


@pytest.mark.parametrize(
    ("name", "beginning"),
    [
        ("a.m3u8", "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n"),
        ("a.ffconcat", "ffconcat version 1.0\nfile "),
    ],
)
def test_a_playlist_does_not_read_the_files_that_it_names(tmp_path, name, beginning):
    secret = write_side_by_side(tmp_path / "secret.mp4", flat_pairs(3), codec="libx264")
    playlist = tmp_path / "other" / name
    playlist.parent.mkdir()
    for place in (secret.name, str(secret)):
        playlist.write_text(f"{beginning}{place}\n")
        assert refusal(playlist) == (
            f"{playlist}: expected a video, found a playlist, which names other files; give the video itself"
        )


def test_frames_without_time_stamps_are_timed_by_the_frame_rate(tmp_path):
    pairs = example_pairs(9)
    for name, options in (("video.avi", {"bf": "2"}), ("video.m4v", {}), ("video.h264", {})):
        codec = "libx264" if name.endswith("h264") else "mpeg4"
        video = open_video([write_side_by_side(tmp_path / name, pairs, codec=codec, options=options)])
        frames = list(video.frames())
        assert_eyes(frames, pairs, tolerance=3.0)
        assert [frame.time for frame in frames] == [Fraction(index, 25) for index in range(9)]


MOVED = "its timestamp was missing or a duplicate, so it is shown slightly later"


def restamped(path, stamps_ms):
    """Write a video with these time stamps, which may repeat, and return its path."""
    source = write_side_by_side(path.with_name("source.mkv"), example_pairs(len(stamps_ms)), codec="mjpeg")
    with av.open(str(source)) as old, av.open(str(path), "w") as new:
        stream = new.add_stream_from_template(old.streams.video[0], opaque=True)
        for packet, stamp_ms in zip(
            (packet for packet in old.demux(video=0) if packet.size), stamps_ms, strict=True
        ):
            packet.stream, packet.time_base = stream, Fraction(1, 1000)
            packet.pts = packet.dts = stamp_ms
            new.mux(packet)
    return path


def test_a_repeated_time_stamp_delays_only_its_own_frame(tmp_path):
    video = open_video([restamped(tmp_path / "video.mkv", [0, 70, 70, 90, 240])])
    times_ms = [1000 * frame.time for frame in video.frames()]
    assert times_ms == [0, 70, 80, 90, 240]  # halfway to 90
    assert problems(video) == {2: MOVED}
    assert_eyes(video.frames(), example_pairs(5), tolerance=6.0)
    assert_same(video.frames(2), list(video.frames())[2:])


@pytest.mark.parametrize(("key_every", "spoilt"), [("1", []), ("5", [4])])
def test_a_frame_lost_without_time_stamps_is_the_one_that_is_bridged(tmp_path, key_every, spoilt):
    options = {"bf": "0", "g": key_every}
    path = write_side_by_side(tmp_path / "a.h264", example_pairs(9), codec="libx264", options=options)
    whole = list(open_video([path]).frames())
    with av.open(str(path)) as container:
        bodies = [bytes(packet) for packet in container.demux(video=0)]
    # The parameter sets and the first byte of the slice are kept, so that the packet still counts as a frame.
    sliced = bodies[3].rindex(b"\0\0\1") + 4
    spoiled = bodies[3][:sliced] + b"\xff" * (len(bodies[3]) - sliced)
    path.write_bytes(path.read_bytes().replace(bodies[3], spoiled))
    video = open_video([path])
    assert problems(video) == {3: BEFORE} | dict.fromkeys(spoilt, SPOILT)
    assert_same(list(video.frames())[5:], whole[5:])


def test_a_folder_of_pictures_is_a_video_in_numerical_order(tmp_path):
    pairs = example_pairs(5)  # numbers 8 to 12: in alphabetical order, 10 would come first
    write_pictures(tmp_path / "frames", "f{}.png", [packed(*pair) for pair in pairs])
    (tmp_path / "frames" / "notes.txt").write_text("no picture")
    for path in (tmp_path / "frames", tmp_path / "frames" / "f*.png"):
        video = open_video([path], rate=Fraction(30_000, 1001))
        assert video.rate == Fraction(30_000, 1001)
        assert_eyes(video.frames(), pairs)
        assert [frame.time for frame in video.frames(3)] == [Fraction(3003, 30_000), Fraction(4004, 30_000)]


def test_two_patterns_are_the_two_eyes(tmp_path):
    pairs = example_pairs(3)
    write_pictures(tmp_path, "left_{}.png", [left for left, _ in pairs])
    write_pictures(tmp_path, "right_{}.png", [right for _, right in pairs])
    video = open_video([tmp_path / "left_*.png", tmp_path / "right_*.png"])
    assert (video.size_px, video.rate, video.sound) == ((160, 96), 25, None)
    assert_eyes(video.frames(), pairs)


def test_a_damaged_picture_is_bridged(tmp_path):
    write_pictures(tmp_path, "f{}.png", [packed(*pair) for pair in example_pairs(6)])
    for number in (8, 11, 12):
        truncate(tmp_path / f"f{number}.png", 0.5)
    video = open_video([tmp_path])
    after = "damaged: replaced by the frame after it"
    assert problems(video) == {0: after, 3: BEFORE, 4: BEFORE}
    for start in range(7):
        assert_same(video.frames(start), list(video.frames())[start:])


def test_two_videos_are_the_two_eyes_with_the_sound_of_the_one_that_has_it(tmp_path):
    pairs = example_pairs(4)
    left = write_video(tmp_path / "left.mkv", [left for left, _ in pairs], codec="ffv1")
    right = write_video(tmp_path / "right.mkv", [right for _, right in pairs], codec="ffv1", sound=True)
    video = open_video([left, right])
    assert video.sound == right
    assert_eyes(video.frames(), pairs)


def test_two_videos_end_with_the_shorter_one_and_the_rest_is_reported(tmp_path):
    pairs = example_pairs(6)
    left = write_video(tmp_path / "left.mkv", [left for left, _ in pairs])
    right = write_video(tmp_path / "right.mkv", [right for _, right in pairs[:4]])
    video = open_video([left, right])
    assert video.frame_count == 4
    assert problems(video) == {3: f"{left} has 2 more frames than the other video"}


def test_frames_of_two_videos_that_are_apart_are_reported(tmp_path):
    """The left video lacks frame 2, the right one frame 5, so frames 2 to 4 are 40 ms apart."""
    paths = []
    for eye, name, gone in ((0, "left.mkv", 2), (1, "right.mkv", 5)):
        kept = [index for index in range(8) if index != gone]
        frames = [pair[eye] for pair in example_pairs(8)]
        times_ms = [FRAME_MS * index for index in kept]
        paths.append(write_video(tmp_path / name, [frames[index] for index in kept], times_ms=times_ms))
    apart = "the left and the right frame are 40 ms apart"
    assert problems(open_video(paths)) == dict.fromkeys((2, 3, 4), apart)


def test_a_gap_in_one_of_two_numbered_series_is_noted(tmp_path):
    pairs = example_pairs(6)
    write_pictures(tmp_path, "left_{}.png", [left for left, _ in pairs])
    write_pictures(tmp_path, "right_{}.png", [right for _, right in pairs])
    patterns = [tmp_path / "left_*.png", tmp_path / "right_*.png"]
    assert open_video(patterns).notes == ()
    (tmp_path / "left_9.png").unlink()
    (tmp_path / "right_10.png").unlink()
    assert [str(note) for note in open_video(patterns).notes] == [
        "left_10.png is paired with right_9.png: a picture seems to be missing in one of the sequences; add "
        "the missing picture, or remove its counterpart"
    ]


@pytest.mark.parametrize(
    ("lefts", "rights"),
    [((0, 3, 5, 12), (1, 3, 6, 12)), ((1, 2, 3, 4), (101, 102, 103, 104)), ((1, 3, 5, 7), (2, 4, 6, 9))],
)
def test_series_with_other_numbers_are_paired_without_a_note(tmp_path, lefts, rights):
    """Times, another beginning, and pictures of a series that were deleted afterwards."""
    for eye, numbers in (("left", lefts), ("right", rights)):
        for number, picture in zip(numbers, example_pairs(4), strict=True):
            write_image(tmp_path / f"{eye}_{number}.png", picture[eye == "right"])
    found = open_video([tmp_path / "left_*.png", tmp_path / "right_*.png"])
    assert found.frame_count == 4
    assert (found.notes == ()) == (rights[-1] != 9)


def test_a_damaged_frame_is_reported_with_the_name_of_its_video(tmp_path):
    pairs = example_pairs(6)
    left = write_video(tmp_path / "left.mkv", [left for left, _ in pairs], codec="mjpeg")
    right = write_video(tmp_path / "right.mkv", [right for _, right in pairs], codec="mjpeg")
    damage(right, 2)
    assert problems(open_video([left, right])) == {2: f"{right}: {BEFORE}"}


def test_mismatched_videos_are_refused(tmp_path):
    lefts = [left for left, _ in example_pairs(8)]
    left = write_video(tmp_path / "left.mkv", lefts)
    low = write_video(tmp_path / "low.mkv", [image[:64] for image in lefts])
    slow = write_video(tmp_path / "slow.mkv", lefts, times_ms=[50 * index for index in range(8)])
    assert "160x96" in refusal(left, low)
    assert "160x64" in refusal(left, low)
    assert "the same frame rate" in refusal(left, slow)
    assert "0.350 s" in refusal(left, slow)


@pytest.mark.parametrize(("colorspace", "color_range"), [(1, 1), (1, 2), (5, 1), (5, 2), (2, 0)])
def test_colours_are_decoded_as_they_were_encoded(tmp_path, colorspace, color_range):
    pairs = flat_pairs(2)
    path = write_side_by_side(
        tmp_path / "video.mkv", pairs, codec="libx264", colorspace=colorspace, color_range=color_range
    )
    for frame, expected in zip(open_video([path], "side_by_side").frames(), pairs, strict=True):
        for eye, image in zip(frame[:2], expected, strict=True):
            # Where the eyes meet, their colours mix, because the video has one sample for four pixels.
            np.testing.assert_allclose(eye[8:-8, 8:-8], image[8:-8, 8:-8], atol=2)


def test_untagged_colours_of_a_large_video_count_as_bt709(tmp_path):
    # As in players, green of BT.601 (Y 145, Cb 54, Cr 34) becomes paler if it is decoded as BT.709:
    # 1.164 * 129 - 0.213 * -74 - 0.533 * -94 = 216 instead of 255.
    green = np.zeros((64, 1280, 3), np.uint8)
    green[..., 1] = 255
    untagged = write_video(tmp_path / "video.mkv", [green], codec="libx264")
    [frame] = open_video([untagged], "side_by_side").frames()
    assert frame.left[..., 1].mean() == pytest.approx(216, abs=2)


def test_colours_are_not_darkened_by_the_conversion_from_fewer_samples(tmp_path):
    pairs = example_pairs(2)
    path = write_side_by_side(tmp_path / "video.mkv", pairs, codec="libx264", options={"crf": "1"})
    frame = next(open_video([path]).frames())
    # The fast conversion of FFmpeg loses 1.1 to 1.5 levels here.
    assert np.abs((frame.left.astype(float) - pairs[0][0]).mean(axis=(0, 1))).max() < 0.5


def test_a_rotated_video_is_turned_upright(tmp_path):
    pairs = flat_pairs(2)
    lying = [np.ascontiguousarray(np.rot90(packed(*pair), k=-1)) for pair in pairs]
    path = write_video(tmp_path / "video.mp4", lying, codec="libx264", rotation=90)
    video = open_video([path], "side_by_side")
    assert video.size_px == (64, 48)
    assert_eyes(video.frames(), pairs, tolerance=1.5)


def test_a_name_with_brackets_is_a_file_if_that_file_exists(tmp_path):
    path = write_side_by_side(tmp_path / "video [3D].mkv", example_pairs(2))
    assert open_video([path]).frame_count == 2


@pytest.mark.parametrize(
    ("pattern", "numbers"), [("f_%03d.png", [7, 8, 1000]), ("f_%d.png", [2, 7, 8, 1000]), ("g_%03d.png", [])]
)
def test_a_pattern_with_a_number_names_pictures_in_numerical_order(tmp_path, pattern, numbers):
    for name in ("f_2", "f_007", "f_008", "f_1000", "f_x", "gf_009"):
        write_image(tmp_path / f"{name}.png", np.full((32, 32, 3), 50, np.uint8))
    files = list_picture_files(tmp_path / pattern)
    assert [int(file.stem[2:]) for file in files] == numbers


def test_without_pyav_the_extra_is_named_and_pictures_still_work(tmp_path, monkeypatch):
    path = write_side_by_side(tmp_path / "video.mkv", flat_pairs(1))
    write_pictures(tmp_path / "frames", "{}.png", [packed(*pair) for pair in flat_pairs(2)])
    monkeypatch.setitem(sys.modules, "av", None)
    assert "stereoweave[video]" in refusal(path)
    assert_eyes(open_video([tmp_path / "frames"], "side_by_side").frames(), flat_pairs(2))


def test_invalid_arguments_are_refused(tmp_path):
    path = write_side_by_side(tmp_path / "video.mkv", flat_pairs(1))
    assert "'sideways'" in refusal(path, format="sideways")
    assert "found 3" in refusal(path, path, path)
    assert "found 0" in refusal()
    assert "without a frame packing" in refusal(path, path, format="top_bottom")


def test_frames_can_be_read_twice_at_the_same_time(tmp_path):
    path = write_side_by_side(tmp_path / "video.mkv", flat_pairs(4))
    video = open_video([path], "side_by_side")
    first, second = video.frames(), video.frames()
    assert_same([next(first), next(first)], [next(second), next(second)])
    assert all(b.time - a.time == Fraction(FRAME_MS, 1000) for a, b in pairwise(video.frames()))


def test_an_excerpt_of_uneven_frames_begins_and_ends_by_their_times(tmp_path):
    """One second of 30 frames a second is followed by one of 10."""
    times_ms = [*(1000 * index // 30 for index in range(30)), *range(1000, 2000, 100)]
    path = write_side_by_side(tmp_path / "video.mkv", flat_pairs(40, width=32), times_ms=times_ms)
    video = open_video([path], "side_by_side")
    assert float(video.length_s) == pytest.approx(1.95, abs=0.01)  # the last frame lasts as long as the mean
    assert video.excerpt(1.1, 0.3).excerpted == "31+3"
    assert video.excerpt(0.5, 0.1).excerpted == "15+3"
    assert video.excerpt(0.9, 0.3).excerpted == "27+5"


def test_an_excerpt_is_a_silent_video_of_its_own(tmp_path):
    path = write_side_by_side(tmp_path / "video.mkv", flat_pairs(10), sound=True)
    part = open_video([path], "side_by_side").excerpt(0.11, 0.2)  # frames 3 to 7 of 25 a second
    frames = list(part.frames())
    assert part.frame_count == len(frames) == 5
    assert part.sound is None
    assert_eyes(frames, flat_pairs(10)[3:8], tolerance=2)  # the next frame differs by 2.7
    assert [frame.time for frame in frames] == [Fraction(FRAME_MS * index, 1000) for index in range(5)]
    assert [frame.problem for frame in frames] == 5 * [None]
    assert_same(list(part.frames(2)), frames[2:])


@pytest.mark.parametrize(
    ("name", "codec", "options"),
    [
        ("video.mkv", "libx264", {"g": "8", "bf": "2"}),
        ("video.mp4", "libx264", {"g": "8", "bf": "2", "x264-params": "open-gop=1:keyint=8:min-keyint=8"}),
        ("video.avi", "mpeg4", {"g": "8"}),
        ("video.ts", "libx264", {"g": "8", "bf": "2"}),
        ("video.mkv", "mjpeg", {}),
    ],
)
def test_an_excerpt_has_the_frames_of_the_whole_video(tmp_path, name, codec, options):
    path = write_side_by_side(tmp_path / name, example_pairs(30), codec=codec, options=options)
    video = open_video([path], "side_by_side")
    frames = list(video.frames())
    for first in (1, 15, 16, 17, 29):
        part = video.excerpt(first / 25, 0.2)
        found = list(part.frames())
        assert len(found) == min(5, 30 - first)
        for frame, expected in zip(found, frames[first:], strict=False):
            assert_eyes([frame], [expected[:2]])
            assert frame.problem is None


def test_decoding_for_an_excerpt_begins_at_the_key_frame_before_it(tmp_path):
    path = write_side_by_side(tmp_path / "video.mkv", example_pairs(30), codec="libx264", options={"g": "8"})
    track = open_track(path, None)
    assert [next(track.frames(0, first)).number for first in (0, 7, 8, 20, 29)] == [0, 0, 8, 16, 24]


def test_an_excerpt_after_a_key_frame_without_a_time_stamp_has_the_frames_of_the_whole_video(
    tmp_path, monkeypatch
):
    path = write_side_by_side(tmp_path / "video.mkv", example_pairs(12), codec="mpeg4", options={"g": "4"})
    decode, stamps_of = tracks.decode, tracks.read_stamps
    missing = 8 * FRAME_MS

    def decode_without_stamp(*file):
        for frame in decode(*file):
            frame.pts = None if frame.pts == missing else frame.pts
            yield frame

    def stamps_without_one(*file):
        stamps, *rest = stamps_of(*file)
        return [None if stamp == missing else stamp for stamp in stamps], *rest

    monkeypatch.setattr(tracks, "decode", decode_without_stamp)
    monkeypatch.setattr(tracks, "read_stamps", stamps_without_one)
    video = open_video([path], "side_by_side")
    whole = list(video.frames())
    part = list(video.excerpt(0.36, 0.12).frames())  # frames 9 to 11 of 25 a second
    assert_same(part, [frame._replace(time=frame.time - whole[9].time) for frame in whole[9:]])
    assert [frame.problem for frame in part] == [None, None, None]


def test_an_excerpt_begins_at_the_frame_of_a_time_that_no_float_has(tmp_path):
    video = open_video([write_side_by_side(tmp_path / "video.mkv", flat_pairs(56))], "side_by_side")
    assert 2.2 * 25 > 55
    assert video.excerpt(2.2, 0.04).excerpted == "55+1"
    assert video.excerpt(0, 1e-8).frame_count == 1


def test_an_excerpt_ends_with_its_video(tmp_path):
    path = write_side_by_side(tmp_path / "video.mkv", flat_pairs(10))
    video = open_video([path], "side_by_side")
    assert [video.excerpt(start_s, 5).frame_count for start_s in (0, 0.36)] == [10, 1]
    with pytest.raises(StereoweaveError, match=r"expected a start within the video of 0:00:00.400, found 0"):
        video.excerpt(0.4, 5)


def test_each_frame_that_is_read_is_counted(tmp_path):
    path = write_side_by_side(tmp_path / "video.mkv", flat_pairs(6))
    video, read = open_video([path], "side_by_side"), []
    video.on_frame = read.append
    list(video.frames())
    list(video.excerpt(0.08, 0.08).frames())
    assert read == [0, 1, 2, 3, 4, 5, 0, 1]


def test_interleaved_rows_that_the_container_declares_are_read(tmp_path):
    pairs = flat_pairs(2, height=72)
    for mode, format in (
        ("row_interleaved_lr", "row_interleaved"),
        ("col_interleaved_rl", "column_interleaved_right_first"),
        ("checkerboard_rl", "checkerboard_right_first"),
    ):
        path = tmp_path / f"{mode}.mkv"
        write_side_by_side(path, pairs, layout=format, stereo_mode=mode, codec="ffv1")
        video = open_video([path])
        assert video.frame_packing == format
        assert_eyes(video.frames(), pairs)
