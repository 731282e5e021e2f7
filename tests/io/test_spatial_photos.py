import struct
from dataclasses import replace

import numpy as np
import pytest
from heic_examples import write_heic
from pillow_heif import open_heif
from video_examples import example_pairs

from stereoweave.cli.root import main
from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.boxes import change_boxes, make_box, split_boxes
from stereoweave.io.images import write_image
from stereoweave.io.spatial_photos import mark_views, write_spatial_photo
from stereoweave.pictures.loading import open_pictures
from stereoweave.pictures.prepare import Request, prepare
from stereoweave.stereo import StereoCamera

CAMERA = StereoCamera(focal_px=240.0, baseline_m=0.0635, cx_px=79.5, cy_px=47.5)
LEFT, RIGHT = example_pairs(1)[0]


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """Return the bytes of two pictures without a group."""
    return write_heic(tmp_path_factory.mktemp("heic") / "pair.heic", LEFT, RIGHT).read_bytes()


def test_a_spatial_photo_is_read_back_with_its_camera(tmp_path):
    path = tmp_path / "photo.heic"
    write_spatial_photo(path, LEFT, RIGHT, CAMERA)
    opened = open_pictures([path])
    assert (opened.lens.focal_px, opened.lens.baseline_m) == (240.0, 0.0635)
    assert opened.lens.parallel and opened.lens.convergence_px is None
    for read, written in ((opened.pair.left, LEFT), (opened.pair.right, RIGHT)):
        assert np.abs(read.astype(int) - written).mean() < 5
    assert [file.name for file in tmp_path.iterdir()] == ["photo.heic"]


def test_libheif_reads_the_group_with_the_left_view_first(tmp_path):
    write_spatial_photo(tmp_path / "photo.heic", LEFT, RIGHT, CAMERA)
    file = open_heif(tmp_path / "photo.heic")
    [group] = file.info["entity_groups"]
    assert (group["type"], group["images"]) == ("ster", [0, 1])
    matrices = [picture.info["heif"]["camera_intrinsic_matrix"] for picture in file]
    # The point in the middle of 160x96 px.
    assert [(m["focal_length_x"], m["principal_point_x"], m["principal_point_y"]) for m in matrices] == [
        (240.0, 80.0, 48.0)
    ] * 2


def test_the_camera_of_pictures_of_odd_size_is_kept(tmp_path):
    # libheif stores 159x95 px as 160x96, and gives lengths for the stored size.
    camera = StereoCamera(focal_px=240.0, baseline_m=0.0635, cx_px=89.5, cy_px=-10.5)
    write_spatial_photo(tmp_path / "photo.heic", LEFT[:95, :159], RIGHT[:95, :159], camera)
    assert open_pictures([tmp_path / "photo.heic"]).lens.focal_px == 240.0
    for picture in open_heif(tmp_path / "photo.heic"):
        matrix = picture.info["heif"]["camera_intrinsic_matrix"]
        assert picture.size == (159, 95)
        # Counted from the corner of the first pixel; libheif's cut to the odd size adds half a pixel.
        assert matrix["principal_point_x"] == pytest.approx(90.5)
        assert matrix["principal_point_y"] == pytest.approx(-9.5)


def test_without_a_camera_only_the_group_is_added(tmp_path):
    write_spatial_photo(tmp_path / "photo.heic", LEFT, RIGHT)
    opened = open_pictures([tmp_path / "photo.heic"])
    assert opened.lens is None or not opened.lens.is_known
    assert np.abs(opened.pair.right.astype(int) - RIGHT).mean() < 5
    assert open_heif(tmp_path / "photo.heic").info["entity_groups"][0]["type"] == "ster"


@pytest.mark.parametrize("changes", [{"focal_px": 1280.0}, {"cx_px": -1281.0}, {"baseline_m": 2148.0}])
def test_a_camera_beyond_the_format_s_numbers_is_left_out(tmp_path, changes):
    # The numbers have 32 bits: a focal length of less than 8 widths, and micrometres.
    write_spatial_photo(tmp_path / "photo.heic", LEFT, RIGHT, replace(CAMERA, **changes))
    opened = open_pictures([tmp_path / "photo.heic"])
    assert opened.lens is None or not opened.lens.is_known
    assert open_heif(tmp_path / "photo.heic").info["entity_groups"][0]["type"] == "ster"


def test_pixels_stay_as_they_are(tmp_path, plain):
    (tmp_path / "marked.heic").write_bytes(mark_views(plain, CAMERA, (160, 96)))
    file = open_heif(tmp_path / "marked.heic")
    np.testing.assert_array_equal(np.asarray(file[0]), LEFT)  # the primary picture is lossless


def test_items_with_extents_that_count_from_the_file_s_start_move_too(tmp_path, plain):
    def without_base(table):
        # Version 1, whose items have a construction method, and no base; the extents take its place.
        items, at = b"", 8
        for _ in range(int.from_bytes(table[6:8])):
            number, base, extents, offset, length = struct.unpack_from(">HxxIHII", table, at)
            assert extents == 1
            items += struct.pack(">HHHHII", number, 0, 0, 1, base + offset, length)
            at += 18
        # Each item is two bytes shorter.
        return b"\1\0\0\0\x44\0" + table[6:8] + items

    boxes = split_boxes(plain)
    meta = boxes[1].content
    changed = change_boxes(meta[4:], (b"iloc",), without_base)
    shorter = len(meta) - 4 - len(changed)

    def moved(table):
        entries = [struct.unpack_from(">HHHHII", table, at) for at in range(8, len(table), 16)]
        return table[:8] + b"".join(struct.pack(">HHHHII", *e[:4], e[4] - shorter, e[5]) for e in entries)

    content = boxes[0].whole + make_box(b"meta", meta[:4] + change_boxes(changed, (b"iloc",), moved))
    content += b"".join(box.whole for box in boxes[2:])
    (tmp_path / "marked.heic").write_bytes(mark_views(content, CAMERA, (160, 96)))
    file = open_heif(tmp_path / "marked.heic")
    assert file.info["entity_groups"][0]["images"] == [0, 1]
    np.testing.assert_array_equal(np.asarray(file[0]), LEFT)


def changed(content, way, change):
    """Return the file after a change of the box `meta` that keeps everything else."""
    boxes = split_boxes(content)
    inner = change_boxes(boxes[1].content[4:], way, change)
    return boxes[0].whole + make_box(b"meta", bytes(4) + inner) + b"".join(b.whole for b in boxes[2:])


DAMAGED = {
    "an empty file": lambda old: b"",
    "five bytes": lambda old: old[:5],
    "cut in the index": lambda old: old[:100],
    "no index": lambda old: old.replace(b"meta", b"free", 1),
    "two indices": lambda old: old + split_boxes(old)[1].whole,
    "pictures before the index": lambda old: make_box(b"mdat", b"") + old,
    "no table of items": lambda old: old.replace(b"iinf", b"free", 1),
    "an empty table of items": lambda old: changed(old, (b"iinf",), lambda table: b""),
    "one picture": lambda old: changed(
        old, (b"iinf",), lambda table: table[:6] + split_boxes(table[6:])[0].whole
    ),
    "a hidden picture": lambda old: old.replace(b"infe\2\0\0\0", b"infe\2\0\0\1", 1),
    "a group already": lambda old: mark_views(old, None, (160, 96)),
    "no properties": lambda old: old.replace(b"ipco", b"free", 1),
    "no owners of properties": lambda old: old.replace(b"ipma", b"free", 1),
    "another table of owners": lambda old: changed(old, (b"iprp", b"ipma"), lambda table: b"\1" + table[1:]),
    "owners cut off": lambda old: changed(old, (b"iprp", b"ipma"), lambda table: table[:-3]),
    "2**32 - 1 owners": lambda old: changed(
        old, (b"iprp", b"ipma"), lambda table: table[:4] + b"\xff\xff\xff\xff" + table[8:]
    ),
    "200 properties": lambda old: changed(
        old, (b"iprp", b"ipco"), lambda shared: shared + 200 * make_box(b"free", b"")
    ),
    "no places": lambda old: old.replace(b"iloc", b"free", 1),
    "another table of places": lambda old: changed(old, (b"iloc",), lambda table: b"\2" + table[1:]),
    "places cut off": lambda old: changed(old, (b"iloc",), lambda table: table[:-3]),
    "65535 places": lambda old: changed(old, (b"iloc",), lambda table: table[:6] + b"\xff\xff" + table[8:]),
    "places above 4 GB": lambda old: changed(
        old, (b"iloc",), lambda table: table[:12] + b"\xff\xff\xff\xff" + table[16:]
    ),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_a_damaged_file_is_refused_in_one_line(plain, damage):
    with pytest.raises(FormatError) as caught:
        mark_views(DAMAGED[damage](plain), CAMERA, (160, 96))
    assert str(caught.value).startswith("expected ") and "\n" not in str(caught.value)


def test_the_command_view_writes_a_spatial_photo(tmp_path, capsys):
    for name, eye in (("left", LEFT), ("right", RIGHT)):
        write_image(tmp_path / f"{name}.png", eye)
    words = ["view", str(tmp_path / "left.png"), str(tmp_path / "right.png"), "--model", "small", "-o"]
    assert main([*words, str(tmp_path / "photo.heic")]) == 0
    assert "photo.heic: two pictures of 160x96 px in one file" in capsys.readouterr().out
    assert np.abs(open_pictures([tmp_path / "photo.heic"]).pair.left.astype(int) - LEFT).mean() < 5
    assert main([*words, str(tmp_path / "photo.heic"), "--layout", "quilt"]) == 2
    assert "expected the layout side_by_side for this extension, found quilt" in capsys.readouterr().err


def test_the_principal_point_of_a_spatial_photo_is_that_of_its_pair(tmp_path):
    camera = replace(CAMERA, cx_px=90.25, cy_px=40.5)
    write_spatial_photo(tmp_path / "photo.heic", LEFT, RIGHT, camera)
    found = prepare([tmp_path / "photo.heic"], Request(rectify=False)).pair.camera
    assert (found.cx_px, found.cy_px) == pytest.approx((90.25, 40.5), abs=1e-6)
    given = prepare([tmp_path / "photo.heic"], Request(focal_px=200.0, rectify=False)).pair.camera
    assert (given.cx_px, given.cy_px) == (79.5, 47.5)


def test_an_implausible_principal_point_is_taken_for_unknown(tmp_path):
    write_spatial_photo(tmp_path / "photo.heic", LEFT, RIGHT, replace(CAMERA, cx_px=120.0))
    assert open_pictures([tmp_path / "photo.heic"]).lens.principal_point_px is None


def test_a_view_of_a_spatial_photo_keeps_its_camera_unless_it_is_shifted(tmp_path):
    write_spatial_photo(tmp_path / "photo.heic", LEFT, RIGHT, CAMERA)
    words = ["view", str(tmp_path / "photo.heic"), "--model", "small", "--no-rectify", "-o"]
    assert main([*words, str(tmp_path / "wide.heic"), "--strength", "1.5"]) == 0
    assert main([*words, str(tmp_path / "shifted.heic"), "--convergence", "5"]) == 0
    wide, shifted = (open_pictures([tmp_path / f"{name}.heic"]).lens for name in ("wide", "shifted"))
    assert wide.focal_px == 240
    assert wide.baseline_m == pytest.approx(1.5 * 0.0635, abs=1e-6)
    assert shifted is None or shifted.baseline_m is None


def test_a_folder_in_the_place_of_the_photo_is_refused(tmp_path):
    (tmp_path / "photo.heic").mkdir()
    with pytest.raises(StereoweaveError, match="expected a writable file"):
        write_spatial_photo(tmp_path / "photo.heic", LEFT, RIGHT)


def test_an_odd_size_is_kept(tmp_path):
    write_spatial_photo(tmp_path / "photo.heic", LEFT[:95, :157], RIGHT[:95, :157])
    assert open_heif(tmp_path / "photo.heic").size == (157, 95)
