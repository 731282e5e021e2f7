import struct

import av
import numpy as np
import pytest
from av.sidedata.sidedata import Type
from spatial_examples import SPATIAL, SPATIAL_FRAMES, box
from video_examples import packets, write_video

from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.video import mp4_marks
from stereoweave.video.mp4_marks import VideoMarks, make_boxes, mark_index, write_marks
from stereoweave.video.reader import open_video

SIDE_BY_SIDE = VideoMarks(packing="side_by_side")
# The box `eyes` of a spatial video that Apple's encoder wrote, 19.24 mm, but for its disparity adjustment.
EYES = bytes.fromhex(
    "0000003a65796573 0000000d73747269 0000000003 0000000d6865726f 0000000001"
    "0000001863616d73 00000010626c696e 00000000 00004b28"
)
HFOV = bytes.fromhex("0000000c68666f76 0000f7a8")


@pytest.fixture
def film(tmp_path):
    """Write a small video."""

    def write(name="film.mp4", *, sound=False):
        path = tmp_path / name
        frames = [np.full((48, 64, 3), 40 * index, np.uint8) for index in range(5)]
        write_video(path, frames, sound=sound, codec="mpeg4")
        return path

    return write


def side_data(path, kind):
    """Return the numbers of side data as FFmpeg hands them out with the first frame."""
    with av.open(str(path)) as container:
        data = next(container.decode(video=0)).side_data.get(kind)
        return None if data is None else np.frombuffer(bytes(data), np.int32).tolist()


def top_level(content):
    places, start = [], 0
    while start < len(content):
        size, kind = struct.unpack_from(">I4s", content, start)
        places.append((kind, start, start + size))
        start += size
    return places


def cut_out(content, kind):
    [(start, end)] = [(start, end) for found, start, end in top_level(content) if found == kind]
    return content[start:end]


def found(boxes, kind):
    """Return the content of the one box of this type, wherever it is."""
    assert boxes.count(kind) == 1
    at = boxes.index(kind)
    return boxes[at + 4 : at - 4 + int.from_bytes(boxes[at - 4 : at])]


def test_cameras_are_marked_as_apples_encoder_marks_them():
    marks = VideoMarks(packing="side_by_side", field_of_view_deg=63.4, baseline_m=0.01924)
    google, apple = make_boxes(marks)
    assert apple == box(b"vexu", EYES + box(b"pack", box(b"pkin", b"\0\0\0\0side"))) + HFOV
    assert google == bytes.fromhex("0000000d73743364 00000000 02")


def test_half_a_sphere_leaves_out_a_quarter_of_the_width_on_each_side():
    google, apple = make_boxes(VideoMarks(packing="top_bottom", projection="half_equirectangular"))
    assert found(google, b"st3d") == b"\0\0\0\0\1"
    assert found(google, b"equi") == struct.pack(">5I", 0, 0, 0, 1 << 30, 1 << 30)
    assert found(google, b"prhd") == bytes(16)
    assert found(apple, b"prji") == b"\0\0\0\0hequ"
    assert found(apple, b"pkin") == b"\0\0\0\0over"
    assert found(apple, b"hfov") == struct.pack(">I", 180_000)


def test_a_part_of_half_a_sphere_is_no_half_sphere():
    google, apple = make_boxes(
        VideoMarks(
            projection="half_equirectangular", field_of_view_deg=90.0, vertical_field_of_view_deg=135.0
        )
    )
    # (1 - 135 / 180) / 2 = 1 / 8 above and below; (1 - 90 / 360) / 2 = 3 / 8 at the sides.
    assert found(google, b"equi") == struct.pack(">5I", 0, 1 << 29, 1 << 29, 3 << 29, 3 << 29)
    assert b"prji" not in apple


@pytest.mark.parametrize(
    ("packing", "mode"), [("side_by_side", b"\0\0\0\0\4"), ("top_bottom", None)], ids=["beside", "above"]
)
def test_a_right_view_that_comes_first_is_marked(packing, mode):
    google, apple = make_boxes(VideoMarks(packing=packing, right_first=True))
    assert found(apple, b"stri") == b"\0\0\0\0\x0b"  # left, right, reversed
    assert (found(google, b"st3d") if google else None) == mode


@pytest.mark.parametrize("name", ["film.mp4", "film.mov"])
def test_ffmpeg_reads_the_marks_and_the_same_packets(film, name):
    path = film(name, sound=True)
    pictures, sound = packets(path, "video"), packets(path, "audio")
    marks = VideoMarks(packing="side_by_side", field_of_view_deg=63.4, baseline_m=0.0635)
    write_marks(path, marks)
    # AVStereo3D: side by side, not inverted, both views, the left one is the primary eye, micrometres, then
    # two fractions.
    assert side_data(path, Type.STEREO3D) == [1, 0, 0, 1, 63500, 0, 1, 63400, 1000]
    assert (packets(path, "video"), packets(path, "audio")) == (pictures, sound)
    assert len(pictures) == 5 and sound


def test_marks_are_replaced_by_later_ones(film):
    path, once = film(), film("once.mp4")
    write_marks(path, VideoMarks(packing="top_bottom", projection="equirectangular", baseline_m=0.1))
    assert side_data(path, Type.SPHERICAL)[0] == 0
    write_marks(path, SIDE_BY_SIDE)
    write_marks(once, SIDE_BY_SIDE)
    assert path.read_bytes() == once.read_bytes()


def test_ffmpeg_reads_a_vr180_film(film):
    path = film()
    write_marks(path, VideoMarks(packing="side_by_side", projection="half_equirectangular"))
    # AV_SPHERICAL_HALF_EQUIRECTANGULAR
    assert side_data(path, Type.SPHERICAL)[0] == 3


def test_the_marks_of_apples_encoder_are_replaced(tmp_path):
    path = tmp_path / "spatial.mp4"
    path.write_bytes(SPATIAL.read_bytes())
    write_marks(path, VideoMarks(packing="side_by_side", field_of_view_deg=90.0, baseline_m=0.05))
    assert open_video([path]).camera.focal_px == pytest.approx(160)
    assert len(list(open_video([path]).frames())) == SPATIAL_FRAMES


def test_sizes_of_64_bits_and_a_last_box_without_size_are_read(film):
    path = film()
    content = path.read_bytes()
    start = next(start for kind, start, _ in top_level(content) if kind == b"moov")
    expected = mark_index(content[start:], SIDE_BY_SIDE)
    long = struct.pack(">I4sQ", 1, b"moov", len(content) - start + 8) + content[start + 8 :]
    open_end = bytes(4) + content[start + 4 :]
    for index in (long, open_end):
        path.write_bytes(content[:start] + index)
        write_marks(path, SIDE_BY_SIDE)
        assert path.read_bytes() == content[:start] + expected


def refusal(path, content):
    path.write_bytes(content)
    with pytest.raises(FormatError) as caught:
        write_marks(path, SIDE_BY_SIDE)
    assert path.read_bytes() == content
    assert "\n" not in str(caught.value)
    return str(caught.value).removeprefix(f"{path}: ")


def without(index, kind):
    return index.replace(kind, b"free")


DAMAGED = {
    "an empty file": (lambda old: b"", "expected one index (moov), found none"),
    "five bytes": (lambda old: old[:5], "expected whole boxes"),
    "cut in the media data": (lambda old: old[:100], "expected whole boxes, found b'mdat'"),
    "cut in the index": (lambda old: old[:-20], "expected whole boxes, found b'moov'"),
    "no index": (lambda old: without(old, b"moov"), "expected one index (moov), found none"),
    "two indices": (lambda old: old + cut_out(old, b"moov"), "expected one index (moov), found 2"),
    "an index in front": (
        lambda old: cut_out(old, b"ftyp") + cut_out(old, b"moov") + cut_out(old, b"mdat"),
        "expected the index (moov) at the end, found it before other boxes",
    ),
    "fragments": (
        lambda old: box(b"moof", bytes(8)) + old,
        "expected a file with one index, found fragments",
    ),
    "two video tracks": (
        lambda old: doubled(old, b"trak"),
        "expected an index with one video track, found 2",
    ),
    "no video track": (
        lambda old: old.replace(b"vide", b"text"),
        "expected an index with one video track, found none",
    ),
    "no sample descriptions": (lambda old: without(old, b"stsd"), "expected the box stsd in the index"),
    "no tables": (lambda old: without(old, b"stbl"), "expected the box stbl in the index"),
    "a description of 20 bytes": (
        lambda old: with_entry(old, box(b"mp4v", bytes(20))),
        "expected a sample description of video, found one cut off",
    ),
    "a description longer than its table": (
        lambda old: with_entry(old, struct.pack(">I4s", 1 << 30, b"mp4v")),
        "expected boxes that fit into the index, found b'mp4v' with 1073741824 bytes",
    ),
    "a description of no size": (
        lambda old: with_entry(old, struct.pack(">I4s", 0, b"mp4v")),
        "expected boxes that fit into the index, found b'mp4v' with 0 bytes",
    ),
    "more descriptions than there are": (
        lambda old: old.replace(b"stsd\0\0\0\0\0\0\0\1", b"stsd\0\0\0\0\0\0\0\2"),
        "expected a sample description in the index, found a damaged one",
    ),
    "a box of 2**63 bytes": (
        lambda old: struct.pack(">I4sQ", 1, b"free", 1 << 63) + old,
        "expected whole boxes, found b'free' with 9223372036854775808 bytes",
    ),
    "a box of one byte": (
        lambda old: struct.pack(">I4sQ", 1, b"free", 1) + old,
        "expected whole boxes, found b'free' with 1 bytes",
    ),
}


def doubled(content, kind):
    index = cut_out(content, b"moov")
    track = box(kind, found(index, kind))
    return content.replace(index, box(b"moov", index[8:] + track))


def with_entry(content, entry):
    """Return the film with two other sample descriptions, with the sizes around them as they were."""
    at = content.index(b"stsd") + 12
    size = int.from_bytes(content[at : at + 4])
    rest = size - len(entry)
    return content[: at - 1] + b"\2" + entry + box(b"free", bytes(rest - 8)) + content[at + size :]


@pytest.mark.parametrize("damage", DAMAGED)
def test_a_damaged_file_is_refused_in_one_line_and_stays_as_it_is(film, damage):
    path = film()
    change, said = DAMAGED[damage]
    assert refusal(path, change(path.read_bytes())).startswith(said)


def test_a_huge_index_is_refused_before_it_is_read(film, monkeypatch):
    monkeypatch.setattr(mp4_marks, "_MOST_INDEX_BYTES", 100)
    path = film()
    assert refusal(path, path.read_bytes()).startswith("expected an index of at most 0 MB")


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"packing": "diagonal"}, "packing: expected one of None, side_by_side, top_bottom"),
        ({"projection": "cubic"}, "projection: expected one of rectilinear, equirectangular"),
        ({"field_of_view_deg": 0.0}, "field_of_view_deg: expected above 0"),
        ({"field_of_view_deg": float("nan")}, "field_of_view_deg: expected above 0"),
        ({"projection": "half_equirectangular", "field_of_view_deg": 181.0}, "at most 180, found 181"),
        ({"vertical_field_of_view_deg": 10.0}, "vertical_field_of_view_deg: expected"),
        ({"baseline_m": -0.06}, "baseline_m: expected above 0"),
        ({"baseline_m": float("inf")}, "baseline_m: expected above 0"),
    ],
)
def test_marks_that_cannot_be_are_refused(settings, said):
    with pytest.raises(StereoweaveError) as caught:
        VideoMarks(**settings)
    assert said in str(caught.value)
