import copy
import json

import numpy as np
import pytest
from lif_examples import describe, ending, field, jpeg, new_photo, tablet_photo
from PIL import Image
from video_examples import TEXTURED, shrunk

from stereoweave.errors import FormatError
from stereoweave.io.images import read_image
from stereoweave.pictures.loading import measure_embedded_views, open_pictures
from stereoweave.pictures.prepare import Request, prepare


@pytest.fixture(scope="module")
def eyes():
    return tuple(shrunk(read_image(TEXTURED / f"{eye}.png"), 240, 160) for eye in ("left", "right"))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "IMG_0001.jpg"


def assert_eyes(opened, left, right):
    for found, taken in ((opened.pair.left, left), (opened.pair.right, right)):
        assert found.shape == taken.shape
        assert np.abs(found.astype(int) - taken).mean() < 3


def refusal(path, *, format=None):
    with pytest.raises(FormatError) as caught:
        open_pictures([path], format)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(str(path))
    return message


def test_a_tablet_photo_holds_both_views(path, eyes):
    path.write_bytes(tablet_photo(*eyes))
    opened = open_pictures([path])
    assert_eyes(opened, *eyes)
    assert opened.layout == "two_pictures"
    assert [str(note) for note in opened.notes] == [
        "a LIF file, left and right view; override it if it is wrong (format)"
    ]
    assert opened.lens is None
    with Image.open(path) as picture:
        assert measure_embedded_views(path, picture, None) == [(240, 160), (240, 160)]
        assert measure_embedded_views(path, picture, "side_by_side") == []


def test_a_new_photo_holds_its_camera_too(path, eyes):
    path.write_bytes(new_photo(*eyes))
    opened = open_pictures([path])
    assert_eyes(opened, *eyes)
    # Half as wide as described: 240 px at a width of 480 px. The views are one baseline of 45 mm apart.
    assert (opened.lens.focal_px, opened.lens.baseline_m) == (120.0, 0.045)
    assert opened.lens.parallel
    notes = [str(note) for note in prepare([path], Request()).notes]
    assert "from the LIF file: focal length 120 px, baseline 45.0 mm" in notes


def test_the_camera_of_versions_5_0_to_5_2_is_a_ratio_of_the_width(path, eyes):
    camera = {"focal_ratio_to_width": 0.75, "rotation": [0, 0, 0], "frustum_skew": [0, 0]}
    views = [
        {"albedo": {"blob_id": -1}, "camera_data": {**camera, "position": [-0.5, 0, 0]}},
        {"albedo": {"blob_id": 1000001}, "camera_data": {**camera, "position": [0.5, 0, 0]}},
    ]
    path.write_bytes(new_photo(*eyes, said={"views": views}))
    opened = open_pictures([path])
    assert_eyes(opened, *eyes)
    assert (opened.lens.focal_px, opened.lens.baseline_m) == (180.0, None)


def test_the_places_of_the_cameras_decide_which_view_is_the_left_one(path, eyes):
    left, right = eyes
    path.write_bytes(new_photo(right, left, said=describe([-1, 1000001], places=[1.0, 0.0])))
    assert_eyes(open_pictures([path]), left, right)


def test_of_four_views_the_outermost_are_the_pair(path, eyes):
    left, right = eyes
    grey = np.full_like(left, 128)
    said = describe([1000001, -1, 1000002, 1000003], places=[-1.5, -0.5, 0.5, 1.5])
    path.write_bytes(new_photo(grey, left, grey, right, said=said))
    opened = open_pictures([path])
    assert_eyes(opened, left, right)
    assert "a LIF file, the outermost of 4 views" in str(opened.notes[0])
    assert opened.lens.baseline_m == pytest.approx(0.135)


def test_views_in_shifted_frusta_have_no_camera(path, eyes):
    said = describe([-1, 1000001])
    said["views"][1]["frustum_skew"]["x"] = 0.02
    path.write_bytes(new_photo(*eyes, said=said))
    assert open_pictures([path]).lens is None


def test_turned_cameras_are_not_parallel(path, eyes):
    said = describe([-1, 1000001])
    said["views"][1]["rotation"]["rotation_slant"]["x"] = 0.02
    path.write_bytes(new_photo(*eyes, said=said))
    assert not open_pictures([path]).lens.parallel


def test_a_format_makes_it_an_ordinary_picture(path, eyes):
    path.write_bytes(new_photo(np.hstack(eyes), eyes[1]))
    opened = open_pictures([path], "side_by_side")
    assert_eyes(opened, *eyes)


def test_a_lif_file_can_be_one_of_two_pictures(path, eyes, tmp_path):
    path.write_bytes(new_photo(*eyes))
    (tmp_path / "right.jpg").write_bytes(jpeg(eyes[1]))
    assert_eyes(open_pictures([path, tmp_path / "right.jpg"]), *eyes)


# Damaged and odd files


@pytest.mark.parametrize("said", [describe([-1]), describe([-1, 1000001], places=[0.0, 0.0])])
def test_a_single_view_with_its_depth_is_named(path, eyes, said):
    path.write_bytes(new_photo(*eyes, said=said))
    assert "found a LIF file with one view and its depth map; take the picture again as 3-D" in refusal(path)


def test_views_of_two_sizes_are_refused(path, eyes):
    left, right = eyes
    path.write_bytes(new_photo(left, right[:100]))
    assert "expected a LIF file with two pictures of the same size, found 240x160 and 240x100" in refusal(
        path
    )


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{}",
        b"[]",
        b"null",
        b"not JSON",
        b"\xff\xfe",
        b'{"views": []}',
        b'{"views": 3}',
        b'{"views": {"image": 1}}',
        b'{"views": [1, 2]}',
        b'{"views": [{}, {}]}',
        b'{"views": [{"image": {"blob_id": "x"}}, {"image": {"blob_id": -1}}]}',
        b'{"views": [{"image": {"blob_id": 77}}, {"image": {"blob_id": -1}}]}',
        b'{"views": [{"image": {"blob_id": 1e999}}, {"image": {"blob_id": -1}}]}',
        b'{"views": [{"image": {"blob_id": -1}, "position": {"x": 0}}]}',
        b'{"views": [{"image": {"blob_id": -1}, "position": [NaN, 0]}, {"image": {"blob_id": -1}}]}',
        b'{"views": [{"image": {"blob_id": -1}, "position": [1]}, {"image": {"blob_id": -1}}]}',
        b'{"views": [{"image": {"blob_id": -1}, "position": {"x": 1%s, "y": 0}}]}' % (400 * b"0"),
        b'{"views": [{"image": {"blob_id": -1}, "frustum_skew": ["wide", 0]}]}',
        b'{"views": [{"image": {"blob_id": -1}, "frustum_skew": [0]}]}',
        b'{"views": [{"image": {"blob_id": -1}, "frustum_skew": {"x": 0}}]}',
        b"[" * 100_000,
        b'{"views": "' + b"x" * 1_000_001 + b'"}',
    ],
)
def test_a_damaged_description_is_named(path, eyes, content):
    path.write_bytes(jpeg(eyes[0]) + ending([field(1000001, jpeg(eyes[1])), field(8, content)]))
    assert refusal(path) == (
        f"{path}: expected a LIF file, found one whose table of views is damaged; copy it again"
    )


@pytest.mark.parametrize("length", [0, 1, 2**31, 2**32 - 1])
def test_a_field_of_false_length_is_named(path, eyes, length):
    content = bytearray(new_photo(*eyes))
    at = content.rfind((1000001).to_bytes(4) + len(jpeg(eyes[1])).to_bytes(4))
    content[at + 4 : at + 8] = length.to_bytes(4)
    path.write_bytes(content)
    assert "found one whose table of views is damaged; copy it again" in refusal(path)


@pytest.mark.parametrize("value", [0, 5, 2**32 - 1])
def test_an_end_that_only_looks_like_a_table_is_ignored(path, eyes, value):
    """Any bytes may follow a JPEG; a pair side by side remains one."""
    path.write_bytes(jpeg(np.hstack(eyes)) + value.to_bytes(4) + b"\x1e\x1a")
    assert open_pictures([path]).layout == "side_by_side"


def test_a_file_that_was_cut_off_is_an_ordinary_picture(path, eyes):
    content = new_photo(*eyes)
    path.write_bytes(content[:-1])
    assert "found what looks like a single photograph" in refusal(path)


@pytest.mark.parametrize("blob", [b"", b"\xff\xd8\xff", b"GIF89a", b"%!PS-Adobe-3.0"])
def test_a_damaged_right_view_is_named(path, eyes, blob):
    said = json.dumps(describe([-1, 1000001])).encode()
    path.write_bytes(jpeg(eyes[0]) + ending([field(1000001, blob), field(8, said)]))
    assert refusal(path).startswith(f"{path}, right view: expected a picture")


def test_a_huge_right_view_is_refused_before_it_is_decoded(path, eyes):
    blob = bytearray(jpeg(eyes[1]))
    at = blob.find(b"\xff\xc0")
    blob[at + 5 : at + 9] = (60_000).to_bytes(2) * 2
    said = json.dumps(describe([-1, 1000001])).encode()
    path.write_bytes(jpeg(eyes[0]) + ending([field(1000001, bytes(blob)), field(8, said)]))
    assert "right view: expected at most 65 megapixels, found" in refusal(path)


@pytest.mark.parametrize(
    ("key", "value"),
    [("focal_px", v) for v in (0, -1, 1e300, 10**400, "wide", None, True)]
    + [("focal_ratio_to_width", v) for v in (10**400, -(10**400), float("nan"), "wide", [1])]
    + [("width_px", v) for v in (0, -3, "wide")]
    + [("rotation", None)],
)
def test_an_implausible_camera_is_left_out(path, eyes, key, value):
    said = copy.deepcopy(describe([-1, 1000001]))
    for view in said["views"]:
        view[key] = value
    path.write_bytes(new_photo(*eyes, said=said))
    lens = open_pictures([path]).lens
    assert lens.baseline_m == 0.045
    assert lens.focal_px is None or key == "rotation"
    assert not lens.parallel or key != "rotation"


@pytest.mark.parametrize("baseline_mm", [0, -45, 1e300, 10**400, "45", None, [45]])
def test_an_implausible_baseline_is_left_out(path, eyes, baseline_mm):
    path.write_bytes(new_photo(*eyes, said=describe([-1, 1000001]) | {"baseline_mm": baseline_mm}))
    assert open_pictures([path]).lens.baseline_m is None
