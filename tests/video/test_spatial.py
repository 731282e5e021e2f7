import os
import struct
from fractions import Fraction
from math import sqrt
from types import SimpleNamespace

import av
import numpy as np
import pytest
from av.sidedata.sidedata import Type
from spatial_examples import (
    SPATIAL,
    SPATIAL_FRAMES,
    psnr_db,
    spatial_boxes,
    spatial_pairs,
    swap_views,
    units,
    with_boxes,
)
from video_examples import example_pairs, packets, write_video

from stereoweave.errors import StereoweaveError
from stereoweave.video import tracks
from stereoweave.video.reader import open_video
from stereoweave.video.spatial import is_spatial, read_stereo3d
from stereoweave.video.tracks import open_track

BEFORE = "damaged: replaced by the frame before it"
AFTER = "damaged: replaced by the frame after it"
SPOILT = "decoded from a damaged frame before it"
# Measured for the example: 38 dB against its own source, 23 against the source's next frame, 14 against the
# other eye.
SAME_DB = 35.0


def edited(tmp_path, content):
    path = tmp_path / "spatial.mp4"
    path.write_bytes(content)
    return path


def without(layer, ranks, *, content=None):
    """Return the example with the slices of a layer turned into NAL units of a reserved type."""
    changed, bodies = (
        bytearray(content or SPATIAL.read_bytes()),
        [body for _, body in packets(SPATIAL, "video")],
    )
    for rank in ranks:
        first = changed.find(bodies[rank])
        for start, _, kind, its_layer in units(bodies[rank]):
            if kind < 32 and its_layer == layer:
                changed[first + start] = changed[first + start] & 0x81 | 41 << 1
    return bytes(changed)


def problems(path):
    return {index: frame.problem for index, frame in enumerate(open_video([path]).frames()) if frame.problem}


def refusal(*paths, **options):
    with pytest.raises(StereoweaveError) as caught:
        list(open_video(paths, **options).frames())
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_both_views_of_a_spatial_video_are_read_with_exact_times():
    video = open_video([SPATIAL])
    frames = list(video.frames())
    assert (video.size_px, video.frame_count, video.rate, video.sound) == ((320, 192), 50, 25, SPATIAL)
    assert video.frame_packing is None
    assert [frame.time for frame in frames] == [Fraction(index, 25) for index in range(SPATIAL_FRAMES)]
    assert not any(frame.problem for frame in frames)
    for frame, (left, right) in zip(frames, spatial_pairs(), strict=True):
        assert psnr_db(frame.left, left) > SAME_DB
        assert psnr_db(frame.right, right) > SAME_DB


def test_a_spatial_video_without_time_stamps_is_timed_by_its_rate(tmp_path):
    stream = b"".join(
        b"\0\0\0\1" + body[start:end]
        for _, body in packets(SPATIAL, "video")
        for start, end, *_ in units(body)
    )
    path = tmp_path / "spatial.hevc"
    path.write_bytes(stream)
    frames = list(open_video([path]).frames())
    assert [frame.time for frame in frames] == [Fraction(index, 25) for index in range(SPATIAL_FRAMES)]
    assert all(
        psnr_db(frame.right, pair[1]) > SAME_DB for frame, pair in zip(frames, spatial_pairs(), strict=True)
    )


def test_the_camera_comes_from_field_of_view_and_baseline():
    video = open_video([SPATIAL])
    # 320 / (2 tan 30 degrees) = 160 * sqrt(3)
    assert video.camera.focal_px == pytest.approx(160 * sqrt(3))
    assert (video.camera.baseline_m, video.camera.doffs_px) == (0.0635, 0)
    assert (video.camera.cx_px, video.camera.cy_px) == (159.5, 95.5)
    assert [str(note) for note in video.notes] == [
        "spatial video (MV-HEVC), left view first: field of view 60 degrees, baseline 63.5 mm, "
        "disparity adjustment 1.5 % of the width, not applied"
    ]


@pytest.mark.parametrize(
    ("boxes", "said"),
    [
        (b"", ""),
        (spatial_boxes(baseline_um=63_500, degrees=0), ": baseline 63.5 mm"),
        (spatial_boxes(baseline_um=0, degrees=60), ": field of view 60 degrees"),
        (spatial_boxes(baseline_um=63_500, degrees=180), ": field of view 180 degrees, baseline 63.5 mm"),
    ],
    ids=["nothing", "no angle", "no baseline", "half a sphere"],
)
def test_without_a_known_perspective_there_is_no_camera(tmp_path, boxes, said):
    video = open_video([edited(tmp_path, with_boxes(SPATIAL.read_bytes(), boxes))])
    assert video.camera is None
    assert len(list(video.frames())) == SPATIAL_FRAMES
    assert [str(note) for note in video.notes] == [f"spatial video (MV-HEVC), left view first{said}"]


def test_a_turned_spatial_video_has_no_camera(tmp_path):
    content = bytearray(SPATIAL.read_bytes())
    # The matrix of the first track header: 1 0 0 0 1 0 0 0 1 becomes 0 1 0 -1 0 0 0 0 1, a quarter turn.
    start = content.index(b"tkhd") + 44
    assert content[start : start + 4] == b"\0\1\0\0"
    content[start : start + 20] = struct.pack(">5i", 0, 1 << 16, 0, -1 << 16, 0)
    video = open_video([edited(tmp_path, bytes(content))])
    assert video.size_px == (192, 320)
    assert video.camera is None


def assert_swapped(path):
    video = open_video([path])
    assert "right view first" in str(video.notes[0])
    frame, (left, right) = next(video.frames()), spatial_pairs()[0]
    assert psnr_db(frame.left, right) > SAME_DB
    assert psnr_db(frame.right, left) > SAME_DB


def test_the_stream_says_which_view_is_the_left_one(tmp_path):
    assert_swapped(edited(tmp_path, swap_views(SPATIAL.read_bytes())))


def test_the_container_says_which_view_is_the_left_one_if_the_stream_does_not(tmp_path):
    # Its message about the views becomes one of an unknown type.
    mute = SPATIAL.read_bytes().replace(b"\x4e\x01\xb0", b"\x4e\x01\xb1")
    assert "left view first" in str(open_video([edited(tmp_path, mute)]).notes[0])
    assert_swapped(
        edited(tmp_path, with_boxes(mute, spatial_boxes(baseline_um=63_500, degrees=60, eyes=3 + 8)))
    )


def test_an_excerpt_has_the_frames_of_the_whole_spatial_video():
    video = open_video([SPATIAL])
    frames = list(video.frames())
    for first in (1, 9, 10, 23, 49):
        part = list(video.excerpt(first / 25, 0.2).frames())
        assert len(part) == min(5, SPATIAL_FRAMES - first)
        for frame, expected in zip(part, frames[first:], strict=False):
            np.testing.assert_array_equal(frame.left, expected.left)
            np.testing.assert_array_equal(frame.right, expected.right)
            assert frame.problem is None


def test_decoding_for_an_excerpt_begins_at_the_key_frame_before_it():
    track = open_track(SPATIAL, None)
    assert [next(track.frames(0, first)).number for first in (0, 9, 10, 19, 49)] == [0, 0, 10, 10, 40]


@pytest.mark.parametrize("layer", [0, 1])
def test_a_lost_view_is_bridged_and_frames_decoded_from_it_are_marked(tmp_path, layer):
    # In file order, the fourteenth packet is shown as frame 11; the next key frame is 20.
    path = edited(tmp_path, without(layer, [13]))
    assert problems(path) == {11: BEFORE} | dict.fromkeys(range(12, 20), SPOILT)
    frames = list(open_video([path]).frames())
    np.testing.assert_array_equal(frames[11].left, frames[10].left)
    np.testing.assert_array_equal(frames[11].right, frames[10].right)
    assert [frame.time for frame in frames] == [Fraction(index, 25) for index in range(SPATIAL_FRAMES)]


def test_a_second_view_that_is_missing_in_a_part_is_a_problem_of_that_part(tmp_path):
    assert problems(edited(tmp_path, without(1, range(10, 20)))) == dict.fromkeys(range(10, 20), BEFORE)
    assert problems(edited(tmp_path, without(1, range(10)))) == dict.fromkeys(range(10), AFTER)


def test_a_spatial_video_without_its_second_view_is_refused(tmp_path):
    said = refusal(edited(tmp_path, without(1, range(SPATIAL_FRAMES))))
    assert "found no frame with a second view" in said


def test_a_long_spatial_video_without_its_second_view_is_refused_without_decoding_all_of_it(
    tmp_path, monkeypatch
):
    alone = edited(tmp_path, without(1, range(SPATIAL_FRAMES)))
    stream = b"".join(
        b"\0\0\0\1" + body[start:end] for _, body in packets(alone, "video") for start, end, *_ in units(body)
    )
    path = tmp_path / "long.hevc"
    path.write_bytes(8 * stream)
    decode, decoded = tracks.decode, []

    def count_decoded(*file):
        for frame in decode(*file):
            decoded.append(frame.pts)
            yield frame

    monkeypatch.setattr(tracks, "decode", count_decoded)
    assert "found no frame with a second view" in refusal(path)
    assert len(decoded) < 8 * SPATIAL_FRAMES


def test_damaged_boxes_about_the_cameras_are_reported(tmp_path):
    boxes = spatial_boxes(baseline_um=63_500, degrees=60)
    assert "expected a video" in refusal(edited(tmp_path, with_boxes(SPATIAL.read_bytes(), boxes[:-30])))


def test_a_truncated_spatial_video_is_refused_with_the_reason(tmp_path):
    whole = SPATIAL.read_bytes()
    for share in (0.1, 0.5, 0.9):
        path = edited(tmp_path, whole[: int(share * len(whole))])
        assert "its index is lost" in refusal(path)


def remuxed(tmp_path, name):
    path = tmp_path / name
    with av.open(str(SPATIAL)) as old, av.open(str(path), "w") as new:
        stream = new.add_stream_from_template(old.streams.video[0])
        for packet in old.demux(video=0):
            if packet.size:
                packet.stream = stream
                new.mux(packet)
    return path


def test_a_cut_off_spatial_video_is_read_to_its_end_and_reported(tmp_path):
    path = remuxed(tmp_path, "spatial.mkv")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    video = open_video([path])
    frames = list(video.frames())
    assert 15 < len(frames) < 35
    assert "breaks off after this frame" in frames[-1].problem
    assert psnr_db(frames[10].right, spatial_pairs()[10][1]) > SAME_DB


@pytest.mark.parametrize("name", ["spatial.mkv", "spatial.mov", "spatial.ts"])
def test_spatial_videos_in_other_containers_are_read(tmp_path, name):
    frames = list(open_video([remuxed(tmp_path, name)]).frames())
    assert [frame.time for frame in frames] == [Fraction(index, 25) for index in range(SPATIAL_FRAMES)]
    for frame, pair in zip(frames, spatial_pairs(), strict=True):
        assert min(psnr_db(frame.left, pair[0]), psnr_db(frame.right, pair[1])) > SAME_DB


@pytest.mark.parametrize("seed", range(10))
def test_a_spatial_video_with_random_damage_is_read_or_refused_in_one_line(tmp_path, seed):
    rng = np.random.default_rng(seed)
    content = bytearray(SPATIAL.read_bytes())
    for _ in range(1 + 3 * seed):
        start = int(rng.integers(len(content)))
        content[start : start + 8] = rng.bytes(8)[: len(content) - start]
    path = edited(tmp_path, bytes(content))
    try:
        video = open_video([path])
    except StereoweaveError as error:
        assert "\n" not in str(error)
        return
    assert len(list(video.frames())) == video.frame_count


def test_a_frame_packing_and_a_second_file_are_refused_for_a_spatial_video(tmp_path):
    assert "found crossed; leave it out (format)" in refusal(SPATIAL, format="crossed")
    plain = write_video(tmp_path / "plain.mkv", [left for left, _ in example_pairs(3)])
    assert "a spatial video (MV-HEVC) with both views; give it alone" in refusal(SPATIAL, plain)
    assert "give it alone" in refusal(plain, SPATIAL)


def test_reading_closes_the_file(tmp_path):
    def count_open():
        return len(os.listdir("/proc/self/fd"))  # noqa: PTH208 - a plain count

    before = count_open()
    list(open_video([SPATIAL]).frames())
    assert count_open() == before


class UnnamedFrame:
    """Frame with a kind of side data that PyAV cannot name."""

    @property
    def side_data(self):
        raise ValueError("34 is not a valid Type")


def test_side_data_that_nothing_can_name_says_nothing(monkeypatch):
    monkeypatch.setattr("stereoweave.video.spatial._filtered", lambda frame, *steps: [frame])
    assert read_stereo3d(UnnamedFrame()) is None


def test_declared_stereo_of_another_length_is_read_as_far_as_it_is_known():
    numbers = np.array([8, 1, 0, 0, 63_500, 15, 1000, 60, 1, 7], np.int32).tobytes()
    said = read_stereo3d(SimpleNamespace(side_data={Type.STEREO3D: numbers}))
    assert (said.is_inverted, said.baseline_m, said.field_of_view_deg) == (True, 0.0635, 60)
    assert read_stereo3d(SimpleNamespace(side_data={Type.STEREO3D: numbers[:20]})) is None


@pytest.mark.parametrize(("baseline_um", "baseline_m"), [(10**9, 1000.0), (10**9 + 1, 0.0), (-5, 0.0)])
def test_an_implausible_baseline_is_unknown(baseline_um, baseline_m):
    numbers = np.array([8, 0, 0, 0, baseline_um, 0, 1, 60, 1], np.int32).tobytes()
    assert read_stereo3d(SimpleNamespace(side_data={Type.STEREO3D: numbers})).baseline_m == baseline_m


def test_a_frame_that_filters_refuse_is_not_spatial():
    frame = av.VideoFrame(0, 0, "yuv420p")
    frame.time_base = Fraction(1, 25)
    assert not is_spatial(frame)


@pytest.mark.testdata
def test_a_video_of_apples_encoder_is_read(testdata):
    video = open_video([testdata / "consumer" / "stereo_spatial.mp4"])
    frames = list(video.frames())
    assert (video.size_px, video.frame_count, video.rate) == ((160, 120), 10, 30)
    assert [frame.time for frame in frames] == [Fraction(index, 30) for index in range(10)]
    # Its field of view is 63.4 degrees, of which the half has the tangent 0.6176, and its baseline 19.24 mm.
    assert video.camera.focal_px == pytest.approx(80 / 0.61761, rel=1e-4)
    assert video.camera.baseline_m == 0.01924
    assert "left view first" in str(video.notes[0])
    assert not any(frame.problem for frame in frames)
    assert all(np.abs(frame.left.astype(int) - frame.right).mean() > 5 for frame in frames)
