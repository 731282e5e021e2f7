from fractions import Fraction
from itertools import chain

import av
import numpy as np
import pytest
from matroska_examples import block, matroska, video_track
from opened_videos import assert_eyes, refusal_by_name
from video_examples import damage, example_pairs, flat_pairs, truncate, write_video

from stereoweave.errors import StereoweaveError
from stereoweave.io.images import write_image
from stereoweave.video.packings import FRAME_PACKINGS, find_swapped_packing
from stereoweave.video.reader import open_video

SEI = {"options": {"x264-params": "frame-packing=5", "g": "1"}, "codec": "libx264"}


def in_turn(pairs):
    return list(chain.from_iterable(pairs))


def test_left_and_right_frames_in_turn_are_pairs_at_half_the_rate(tmp_path):
    pairs = flat_pairs(4)
    path = write_video(tmp_path / "a.mkv", in_turn(pairs), codec="ffv1", sound=True)
    video = open_video([path], "frame_sequential")
    assert (video.frame_packing, video.size_px, video.frame_count) == ("frame_sequential", (64, 48), 4)
    assert (video.rate, video.sound) == (Fraction(25, 2), path)
    assert video.notes == ()
    frames = assert_eyes(video.frames(), pairs)
    assert [frame.time for frame in frames] == [Fraction(2 * number, 25) for number in range(4)]
    assert [frame.problem for frame in frames] == [None] * 4


def test_a_pair_has_the_time_of_its_first_frame(tmp_path):
    path = write_video(
        tmp_path / "a.mkv", in_turn(flat_pairs(3)), codec="ffv1", times_ms=[0, 10, 100, 130, 170, 171]
    )
    times = [frame.time for frame in open_video([path], "frame_sequential").frames()]
    assert times == [0, Fraction(1, 10), Fraction(17, 100)]


def test_the_right_frame_may_come_first(tmp_path):
    pairs = flat_pairs(2)
    path = write_video(tmp_path / "a.mkv", in_turn(pair[::-1] for pair in pairs), codec="ffv1")
    assert_eyes(open_video([path], "frame_sequential_right_first").frames(), pairs)


def test_h264_frames_say_that_they_are_in_turn(tmp_path):
    pairs = flat_pairs(3)
    video = open_video([write_video(tmp_path / "a.mp4", in_turn(pairs), **SEI)])
    assert_eyes(video.frames(), pairs, tolerance=1.5)
    assert [str(note) for note in video.notes] == [
        "frame_sequential, as the file declares; override it if it is wrong (format)"
    ]


def test_h264_frames_say_which_view_the_first_one_is(tmp_path):
    """A file that was cut begins with a right frame."""
    pairs = flat_pairs(4)
    whole, cut = write_video(tmp_path / "whole.mp4", in_turn(pairs), **SEI), tmp_path / "cut.mkv"
    with av.open(str(whole)) as source, av.open(str(cut), "w") as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for number, packet in enumerate(source.demux(video=0)):
            if number > 0 and packet.dts is not None:
                packet.stream = stream
                target.mux(packet)
    video = open_video([cut])
    assert video.frame_packing == "frame_sequential_right_first"
    assert "the last frame is dropped, because no second view follows it" in map(str, video.notes)
    frames = list(video.frames())
    assert len(frames) == 3
    for frame, later, earlier in zip(frames, pairs[1:], pairs, strict=False):
        assert abs(frame.left.mean() - later[0].mean()) < 2
        assert abs(frame.right.mean() - earlier[1].mean()) < 2


@pytest.mark.parametrize(("mode", "order"), [(13, 1), (14, -1)])
def test_matroska_laces_both_views_in_one_block(tmp_path, mode, order):
    pairs = example_pairs(4)
    blocks = [block(1, 80 * number, *pair[::order]) for number, pair in enumerate(pairs)]
    path = tmp_path / "a.mkv"
    path.write_bytes(matroska([video_track(1, (160, 96), stereo_mode=mode)], blocks))
    frames = assert_eyes(open_video([path]).frames(), pairs, tolerance=2)
    assert [frame.time for frame in frames] == [Fraction(2 * number, 25) for number in range(4)]


def test_pictures_in_turn_are_pairs(tmp_path):
    pairs = flat_pairs(2)
    for number, image in enumerate(in_turn(pairs)):
        write_image(tmp_path / f"{number:02}.png", image)
    video = open_video([tmp_path], "frame_sequential", rate=Fraction(50))
    assert video.rate == 25
    assert_eyes(video.frames(), pairs)


def test_numbered_pictures_may_have_superscripts_in_their_names(tmp_path):
    pairs = flat_pairs(2)
    for number, image in enumerate(in_turn(pairs), 8):
        write_image(tmp_path / f"²{number}.png", image)
    assert_eyes(open_video([tmp_path], "frame_sequential").frames(), pairs)


def test_reading_from_the_middle_and_excerpts_yield_the_same_pairs(tmp_path):
    path = write_video(tmp_path / "a.mp4", in_turn(example_pairs(12)), codec="libx264", options={"g": "7"})
    video = open_video([path], "frame_sequential")
    whole = list(video.frames())
    for found, taken in zip(video.frames(5), whole[5:], strict=True):
        np.testing.assert_array_equal(found.right, taken.right)
        assert found.time == taken.time
    part = video.excerpt(0.4, 0.4)
    assert part.frame_count == 5
    for found, taken in zip(part.frames(), whole[5:10], strict=True):
        np.testing.assert_array_equal(found.left, taken.left)
        assert found.time == taken.time - Fraction(2, 5)


@pytest.mark.parametrize("name", FRAME_PACKINGS)
def test_each_frame_packing_has_one_with_the_eyes_swapped_unless_it_has_no_name(name):
    other = find_swapped_packing(name)
    assert other != name
    assert find_swapped_packing(other) == name
    assert find_swapped_packing(None) is None


@pytest.mark.parametrize("missing", [(6,), (7,), (6, 8), (7, 9), (4, 6, 7, 9)])
def test_pictures_are_read_from_the_middle_as_from_the_start(tmp_path, missing):
    pairs = flat_pairs(6)
    for number, image in enumerate(in_turn(pairs)):
        write_image(tmp_path / f"{number:02}.png", image)
    for number in missing:
        (tmp_path / f"{number:02}.png").write_bytes(b"damaged")
    video = open_video([tmp_path], "frame_sequential")
    whole = list(video.frames())
    for start in range(6):
        frames = list(video.frames(start))
        assert len(frames) == 6 - start
        for found, taken in zip(frames, whole[start:], strict=True):
            np.testing.assert_array_equal(found.left, taken.left)
            np.testing.assert_array_equal(found.right, taken.right)
            assert found.problem == taken.problem


# Damaged and odd files


@pytest.mark.parametrize("count", [1, 3])
def test_an_odd_frame_has_no_partner(tmp_path, count):
    path = write_video(tmp_path / "a.mkv", in_turn(flat_pairs(2))[:count], codec="ffv1")
    if count == 1:
        assert "expected left and right frames in turn, found a video of one frame" in refusal_by_name(
            path, "frame_sequential"
        )
    else:
        video = open_video([path], "frame_sequential")
        assert video.frame_count == 1
        assert [str(note) for note in video.notes] == [
            "the last frame is dropped, because no second view follows it"
        ]


@pytest.mark.parametrize("frame", [2, 3])
def test_a_damaged_frame_of_either_eye_is_bridged_by_the_pair_before(tmp_path, frame):
    pairs = example_pairs(4)
    path = write_video(tmp_path / "a.avi", in_turn(pairs), codec="mjpeg")
    frames = list(open_video([damage(path, frame, length=400)], "frame_sequential").frames())
    assert [found.problem for found in frames] == [
        *(None, "damaged: replaced by the frame before it", None, None)
    ]
    np.testing.assert_array_equal(frames[1].left, frames[0].left)
    np.testing.assert_array_equal(frames[1].right, frames[0].right)
    assert np.abs(frames[2].right.astype(int) - pairs[2][1]).mean() < 7  # the eyes stay where they are


def test_a_file_that_is_cut_off_is_read_up_to_there(tmp_path):
    path = truncate(write_video(tmp_path / "a.avi", in_turn(example_pairs(8)), codec="mjpeg"), 0.7)
    frames = list(open_video([path], "frame_sequential").frames())
    assert 1 <= len(frames) < 8
    assert frames[0].problem is None
    assert frames[-1].problem


def test_laced_blocks_that_are_cut_short_are_no_traceback(tmp_path):
    blocks = [block(1, 80 * number, *pair) for number, pair in enumerate(example_pairs(3))]
    content = matroska([video_track(1, (160, 96), stereo_mode=13)], blocks)
    path = tmp_path / "a.mkv"
    for end in (len(content) - 3000, len(content) // 2, 400, 100):
        path.write_bytes(content[:end])
        try:
            assert len(list(open_video([path]).frames())) <= 3
        except StereoweaveError as error:
            assert "\n" not in str(error)


def test_a_frame_sequence_declared_of_a_single_view_is_one_frame(tmp_path):
    path = tmp_path / "a.mkv"
    path.write_bytes(
        matroska([video_track(1, (160, 96), stereo_mode=13)], [block(1, 0, example_pairs(1)[0][0])])
    )
    assert "found a video of one frame" in refusal_by_name(path)


def test_a_film_without_any_whole_pair_is_refused(tmp_path):
    path = write_video(tmp_path / "a.avi", in_turn(example_pairs(3)), codec="mjpeg")
    for frame in (1, 3, 5):
        damage(path, frame, length=400)
    told = refusal_by_name(path, "frame_sequential")
    assert "found no left frame that can be decoded together with its right frame" in told
    assert "copy the video again" in told


def test_pictures_without_any_whole_pair_are_refused(tmp_path):
    for number, image in enumerate(in_turn(flat_pairs(3))):
        write_image(tmp_path / f"{number:02}.png", image)
        if number % 2 == 0:
            (tmp_path / f"{number:02}.png").write_bytes(b"damaged")
    assert "found no left frame that can be decoded together with its right frame" in refusal_by_name(
        tmp_path, "frame_sequential"
    )


def test_an_excerpt_without_any_whole_pair_shows_the_pair_before_it(tmp_path):
    path = write_video(tmp_path / "a.avi", in_turn(example_pairs(5)), codec="mjpeg")
    for frame in (5, 7, 9):
        damage(path, frame, length=400)
    video = open_video([path], "frame_sequential")
    whole, part = list(video.frames()), list(video.excerpt(0.2, 1).frames())
    assert (len(whole), len(part)) == (5, 2)
    for found, taken in zip(part, whole[3:], strict=True):
        np.testing.assert_array_equal(found.left, taken.left)
