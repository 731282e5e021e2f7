from fractions import Fraction

import av
import numpy as np
import pytest
from matroska_examples import block, matroska, stereo_track, video_track
from opened_videos import assert_eyes, refusal_by_name
from video_examples import FRAME_MS, damage, example_pairs, flat_pairs, truncate, write_streams, write_video

from stereoweave.errors import FormatError
from stereoweave.video.reader import open_video


def split(pairs):
    return [left for left, _ in pairs], [right for _, right in pairs]


@pytest.mark.parametrize("name", ["DSCF0001.AVI", "a.mkv", "a.mov"])
def test_two_like_streams_are_a_pair_with_the_left_one_first(tmp_path, name):
    pairs = example_pairs(5)
    path = write_streams(tmp_path / name, *split(pairs), sound=name.endswith("AVI"))
    video = open_video([path])
    assert video.frame_packing == "two_streams"
    assert (video.name, video.size_px, video.frame_count) == (str(path), (160, 96), 5)
    assert (video.sound is not None) == name.endswith("AVI")
    assert [str(note) for note in video.notes] == [
        "two video streams of the same size and rate, the left one first; override it if it is wrong (format)"
    ]
    frames = assert_eyes(video.frames(), pairs, tolerance=7)
    assert [frame.time for frame in frames] == [Fraction(number, 25) for number in range(5)]


def test_the_right_stream_may_come_first(tmp_path):
    pairs = example_pairs(3)
    path = write_streams(tmp_path / "a.avi", *split(pairs)[::-1])
    video = open_video([path], "two_streams_right_first")
    assert_eyes(video.frames(), pairs, tolerance=7)
    assert [str(note) for note in video.notes] == [
        "two video streams of the same size and rate, right one first, as given"
    ]


def test_matroska_names_the_views_whatever_their_order(tmp_path):
    pairs = example_pairs(3)
    blocks = [
        block(track, FRAME_MS * number, pair[2 - track])  # track 1 is the right view
        for number, pair in enumerate(pairs)
        for track in (1, 2)
    ]
    tracks = [video_track(1, (160, 96)), video_track(2, (160, 96)), stereo_track(3, [(1, 1), (2, 0)])]
    path = tmp_path / "a.mkv"
    path.write_bytes(matroska(tracks, blocks))
    video = open_video([path])
    assert "in the order of their names" in str(video.notes[0])
    assert_eyes(video.frames(), pairs, tolerance=7)
    assert_eyes(
        open_video([path], "two_streams_right_first").frames(), [pair[::-1] for pair in pairs], tolerance=7
    )


def test_two_streams_of_different_scenes_are_no_pair(tmp_path):
    """As of a file with two channels, or two angles of a stage: the first stream is read alone."""
    left, right = split(example_pairs(3))
    path = write_streams(tmp_path / "a.mkv", left, [np.flip(image, (0, 1)).copy() for image in right])
    assert "halves that do not resemble each other" in refusal_by_name(path)
    assert open_video([path], "two_streams").frame_packing == "two_streams"
    assert open_video([path], "side_by_side").frame_packing == "side_by_side"


def test_streams_too_plain_to_tell_are_a_pair(tmp_path):
    pairs = flat_pairs(2)
    path = write_streams(tmp_path / "a.avi", *split(pairs))
    assert_eyes(open_video([path]).frames(), pairs, tolerance=7)


def test_a_packed_stream_beside_its_cover_is_read_as_before(tmp_path):
    pairs = example_pairs(3)
    path = tmp_path / "a.mp4"
    packed = [np.hstack(pair) for pair in pairs]
    with av.open(str(path), "w") as container:
        streams = [container.add_stream(codec, rate=25) for codec in ("mpeg4", "mjpeg")]
        for stream, pixels in zip(streams, ("yuv420p", "yuvj444p"), strict=True):
            stream.height, stream.width, stream.pix_fmt = 96, 320, pixels
        streams[1].disposition = av.stream.Disposition.attached_pic
        for number, image in enumerate(packed):
            for stream in streams[: 2 if number == 0 else 1]:
                frame = av.VideoFrame.from_ndarray(image, "rgb24")
                frame.pts, frame.time_base = number, Fraction(1, 25)
                container.mux(stream.encode(frame))
        for stream in streams:
            container.mux(stream.encode())
    assert open_video([path]).frame_packing == "side_by_side"


# Damaged and odd files


def test_a_stream_that_ends_early_ends_the_video_with_a_note(tmp_path):
    left, right = split(example_pairs(5))
    video = open_video([write_streams(tmp_path / "a.mkv", left, right[:3])], "two_streams")
    assert video.frame_count == 3
    assert [frame.problem for frame in video.frames()][-1].endswith("has 2 more frames than the other video")


def test_a_damaged_frame_of_one_eye_is_bridged_and_names_its_stream(tmp_path):
    path = damage(write_streams(tmp_path / "a.avi", *split(example_pairs(4))), 1, length=400)
    problems = [frame.problem for frame in open_video([path], "two_streams").frames()]
    assert problems[0] is None
    assert problems[1] == f"{path}, stream 0: damaged: replaced by the frame before it"


def test_a_file_that_is_cut_off_is_read_up_to_there(tmp_path):
    path = truncate(write_streams(tmp_path / "a.avi", *split(example_pairs(10))), 0.6)
    frames = list(open_video([path], "two_streams").frames())
    assert 1 <= len(frames) < 10
    assert frames[0].problem is None
    assert frames[-1].problem


@pytest.mark.parametrize(
    ("right", "found"),
    [
        (lambda images: [image[:48, :80] for image in images], "found 2: 160x96, 80x48"),
        (lambda images: [image[:48] for image in images], "found 2: 160x96, 160x48"),
    ],
)
def test_streams_of_two_sizes_are_refused_if_named(tmp_path, right, found):
    left, other = split(example_pairs(2))
    path = write_streams(tmp_path / "a.avi", left, right([image.copy() for image in other]))
    assert found in refusal_by_name(path, "two_streams")


def test_streams_of_two_rates_are_refused_if_named(tmp_path):
    path = write_streams(tmp_path / "a.mkv", *split(example_pairs(4)), rates=[25, 50])
    assert "expected two video streams of the same size and rate, found 2" in refusal_by_name(
        path, "two_streams"
    )


def test_one_stream_and_three_are_refused_if_named(tmp_path):
    left, right = split(example_pairs(2))
    one = write_video(tmp_path / "one.mkv", left)
    assert "found 1: 160x96; choose another frame packing (format)" in refusal_by_name(one, "two_streams")
    three = write_streams(tmp_path / "three.mkv", left, right, left)
    assert "found 3: 160x96, 160x96, 160x96" in refusal_by_name(three, "two_streams")
    assert "halves that do not resemble each other" in refusal_by_name(three)


def test_a_stream_without_a_frame_is_named(tmp_path):
    pairs = example_pairs(2)
    tracks = [video_track(1, (160, 96)), video_track(2, (160, 96)), stereo_track(3, [(1, 0), (2, 1)])]
    path = tmp_path / "a.mkv"
    path.write_bytes(matroska(tracks, [block(1, 0, pairs[0][0]), block(1, FRAME_MS, pairs[1][0])]))
    assert "a.mkv, stream 1: expected a video, found a file without a decodable frame" in refusal_by_name(
        path
    )


@pytest.mark.parametrize("planes", [[(1, 0), (2, 0)], [(1, 1), (2, 1)], [(1, 0)], [(7, 0), (8, 1)], []])
def test_planes_that_contradict_each_other_are_ignored(tmp_path, planes):
    pairs = example_pairs(2)
    blocks = [block(1 + eye, FRAME_MS * at, pair[eye]) for at, pair in enumerate(pairs) for eye in (0, 1)]
    path = tmp_path / "a.mkv"
    tracks = [video_track(1, (160, 96)), video_track(2, (160, 96)), stereo_track(3, planes)]
    path.write_bytes(matroska(tracks, blocks))
    video = open_video([path])
    assert "the left one first" in str(video.notes[0])
    assert_eyes(video.frames(), pairs, tolerance=7)


@pytest.mark.parametrize("size_px", [(0, 0), (65_000, 65_000), (2**31, 2**31)])
def test_a_false_size_is_no_traceback(tmp_path, size_px):
    pairs = example_pairs(2)
    blocks = [block(1 + eye, FRAME_MS * at, pair[eye]) for at, pair in enumerate(pairs) for eye in (0, 1)]
    path = tmp_path / "a.mkv"
    path.write_bytes(matroska([video_track(1, size_px), video_track(2, size_px)], blocks))
    try:
        assert len(list(open_video([path], "two_streams").frames())) == 2
    except FormatError as error:
        assert "\n" not in str(error)


def test_an_empty_file_is_refused(tmp_path):
    (tmp_path / "a.avi").write_bytes(b"")
    assert "found an empty file" in refusal_by_name(tmp_path / "a.avi")
    assert "found an empty file" in refusal_by_name(tmp_path / "a.avi", "two_streams")
