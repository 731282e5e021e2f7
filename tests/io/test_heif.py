"""HEIC pictures: which views are read, their colours and orientation, and the cameras of spatial photos."""

import io
import struct
import sys
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pillow_heif
import pytest
from heic_examples import LOSSLESS, write_heic
from picture_examples import DISPLAY_P3, profile, refusal_of
from PIL import Image, ImageCms, ImageOps
from video_examples import shrunk

from stereoweave.cameras.alignment import check_pair
from stereoweave.errors import FormatError
from stereoweave.io import heif
from stereoweave.io.colour_profiles import make_profile
from stereoweave.io.decoding import open_picture, read_picture
from stereoweave.io.images import read_image
from stereoweave.pictures.loading import open_pictures, pixel_factor
from stereoweave.pictures.pair_finding import find_pairs_in
from stereoweave.pictures.prepare import Request, prepare
from stereoweave.stereo import StereoPair

TEXTURED = Path(__file__).resolve().parents[1] / "textured_pair"
ORIENTATION, EXIF, FOCAL_35_MM = 0x0112, 0x8769, 0xA405
POSE = bytes.fromhex("4363e9145b7d4aab97aebea69803b434")
ADJUSTMENT = bytes.fromhex("de22508536cb436587432f8705e7c78a")


@pytest.fixture(scope="module")
def pair():
    left, right = (shrunk(read_image(TEXTURED / f"{eye}.png"), 240, 160) for eye in ("left", "right"))
    return StereoPair(left=left, right=right)


@pytest.fixture
def spatial(testdata):
    """Return a spatial photo of 2560x2560 px, of another program's making."""
    return testdata / "consumer" / "vision-pro.HEIC"


def assert_same(found, expected, tolerance=0.5):
    assert found.shape == expected.shape
    assert np.abs(found.astype(int) - expected).mean() <= tolerance


def changed(source, path, *changes):
    """Write a copy of a file in which each of some strings of bytes, which are there, is another."""
    content = source.read_bytes()
    for old, new in changes:
        assert len(old) == len(new)
        assert old in content
        content = content.replace(old, new)
    path.write_bytes(content)
    return path


# Spatial photos


@pytest.mark.testdata
def test_both_views_and_the_camera_of_a_spatial_photo_are_read(spatial):
    opened = open_pictures([spatial])
    assert opened.pair.left.shape == opened.pair.right.shape == (2560, 2560, 3)
    assert list(map(str, opened.notes)) == [
        "a HEIC file with a left and a right view",
        "colours converted from Display P3",
    ]
    # Of the file's bytes: 0x2622d86e / 2^30 widths, 0xf91e micrometres, 293 / 10000 widths.
    assert opened.lens.focal_px == pytest.approx(639817838 / 2**30 * 2560, abs=0.001)
    assert opened.lens.baseline_m == pytest.approx(0.063774)
    assert opened.lens.convergence_px == pytest.approx(75.008)
    assert opened.lens.parallel


@pytest.mark.testdata
def test_the_group_of_a_spatial_photo_says_which_view_is_the_left_one(tmp_path, spatial):
    group = b"ster" + struct.pack(">LLL", 0, 53, 2)
    turned = (group + struct.pack(">LL", 26, 52), group + struct.pack(">LL", 52, 26))
    swapped = open_pictures([changed(spatial, tmp_path / "a.heic", turned)])
    as_it_is = open_pictures([spatial])
    assert (swapped.pair.left == as_it_is.pair.right).all()
    assert (swapped.pair.right == as_it_is.pair.left).all()
    # Of two parallel cameras, the right one sees everything farther left.
    assert check_pair(as_it_is.pair.left, as_it_is.pair.right).range_px[0] > 0
    assert check_pair(swapped.pair.left, swapped.pair.right).range_px[1] < 0


@pytest.mark.testdata
def test_without_its_group_two_like_pictures_are_a_pair_of_unknown_baseline(tmp_path, spatial):
    path = changed(spatial, tmp_path / "a.heic", (b"\0\0\0\x1cster", b"\0\0\0\x1cpast"))
    opened = open_pictures([path])
    assert (opened.pair.left == open_pictures([spatial]).pair.left).all()
    assert opened.lens.focal_px == pytest.approx(1525.4446, abs=0.001)
    assert opened.lens.baseline_m is None


@pytest.mark.testdata
def test_a_spatial_photo_is_aligned_and_keeps_metres(spatial):
    prepared = prepare([spatial], Request())
    assert prepared.pair.camera.focal_px == pytest.approx(1525.4446, abs=0.001)
    assert prepared.pair.camera.baseline_m == pytest.approx(0.063774)
    assert prepared.pair.camera.doffs_px == 0
    # 1.8 px before.
    assert prepared.alignment.vertical_error_px < 0.3
    assert "from the HEIC file: focal length 1525 px, baseline 63.8 mm, convergence 75 px" in map(
        str, prepared.notes
    )


# The cameras, read from boxes


def box(kind, *parts):
    content = b"".join(parts)
    kind = b"uuid" + kind if len(kind) == 16 else kind
    return struct.pack(">L", 4 + len(kind) + len(content)) + kind + content


def of_boxes(*properties, table=None):
    """Return a file whose items 1 and 2 have the given properties, from 1 on; no pictures."""
    if table is None:
        table = struct.pack(">LL", 0, 2) + bytes([0, 1, 2, 1, 3, 0, 2, 2, 0x82, 3])
    meta = box(b"meta", bytes(4), box(b"iprp", box(b"ipco", *properties), box(b"ipma", table)))
    return box(b"ftyp", b"heic", bytes(4)) + meta


def lens_of(path, content):
    path.write_bytes(content)
    group = {"type": "ster", "images": [0, 1], "entities": [1, 2]}
    picture = SimpleNamespace(size=(2000, 1000), info={"entity_groups": [group]})
    return heif.read_lens(path, picture)


def pose(flags, *micrometres, kind=POSE, rest=b""):
    return box(kind, struct.pack(">L", flags), struct.pack(f">{len(micrometres)}l", *micrometres), rest)


def test_the_baseline_is_the_distance_between_the_cameras(tmp_path):
    # From (1, -1, 2) mm to (4, 3, 14) mm: 3, 4 and 12 mm.
    content = of_boxes(pose(7, 1000, -1000, 2000), pose(7, 4000, 3000, 14000, kind=b"cmex"), box(b"free"))
    lens = lens_of(tmp_path / "a.heic", content)
    assert lens.baseline_m == pytest.approx(0.013)
    assert lens.parallel
    assert lens.convergence_px is None


def test_a_negative_adjustment_is_read_from_either_view(tmp_path):
    content = of_boxes(pose(0), pose(2, 65_000), box(ADJUSTMENT, struct.pack(">l", -250)))
    lens = lens_of(tmp_path / "a.heic", content)
    # 2.5 % of 2000 px.
    assert lens.convergence_px == pytest.approx(-50)
    assert lens.baseline_m == pytest.approx(0.065)


def test_cameras_are_parallel_only_if_their_directions_are_the_same(tmp_path):
    turned, other = bytes([0, 0, 0, 9]), bytes([0, 0, 0, 8])
    for rest, flags, parallel in ((turned, 9, True), (other, 9, False), (b"", 1, False)):
        content = of_boxes(pose(8, rest=turned), pose(flags, 64_000, rest=rest), box(b"free"))
        assert lens_of(tmp_path / "a.heic", content).parallel == parallel


def test_long_tables_and_boxes_are_read(tmp_path):
    # Version 1: items of 32 bits; flag 1: places of 16 bits. The second picture's own properties come first.
    table = struct.pack(">LL", 0x01000001, 2) + struct.pack(">LBHH", 2, 2, 0x8002, 3)
    table += struct.pack(">LBH", 1, 1, 1)
    content = of_boxes(pose(0), pose(1, 64_000), box(b"free"), table=table)
    start = content.index(b"meta") - 4
    size = len(content) - start
    content = content[:start] + struct.pack(">L4sQ", 1, b"meta", size + 8) + content[start + 8 :]
    assert lens_of(tmp_path / "a.heic", content).baseline_m == pytest.approx(0.064)


def test_damaged_boxes_give_no_camera(tmp_path):
    good = of_boxes(pose(0), pose(1, 64_000), box(b"free"))
    assert lens_of(tmp_path / "good.heic", good).baseline_m == pytest.approx(0.064)
    short = of_boxes(pose(0), pose(7, 64_000), box(b"free"))
    table = struct.pack(">LL", 0, 2**32 - 1) + bytes([0, 1, 200])
    missing = struct.pack(">LL", 0, 2) + bytes([0, 1, 2, 0, 99, 0, 2, 1, 98])
    damaged = [good[:size] for size in range(0, len(good), 5)]
    damaged += [short, of_boxes(pose(0), table=table), of_boxes(pose(0), table=missing), bytes(100)]
    for content in damaged:
        lens = lens_of(tmp_path / "damaged.heic", content)
        assert lens is None or lens.baseline_m is None


# Other HEIC files


def test_two_like_pictures_are_the_left_and_the_right_view(tmp_path, pair):
    path = write_heic(tmp_path / "a.heic", pair.left, pair.right)
    opened = open_pictures([path])
    assert_same(opened.pair.left, pair.left)
    assert_same(opened.pair.right, pair.right)
    assert (opened.lens, opened.layout) == (None, "two_pictures")
    with pillow_heif.HeifImageFile(path) as picture:
        assert pixel_factor(path, picture, None) == 2
    assert_same(read_image(path), pair.left)


def test_the_first_picture_is_left_even_if_the_second_is_the_primary_one(tmp_path, pair):
    path = write_heic(tmp_path / "a.heic", pair.left, pair.right, primary_index=1)
    assert_same(open_pictures([path]).pair.left, pair.left)
    assert_same(read_image(path), pair.right)


def test_two_files_are_a_pair(tmp_path, pair):
    tags = Image.Exif()
    tags.get_ifd(EXIF)[FOCAL_35_MM] = 36
    paths = [tmp_path / "left.heic", tmp_path / "right.heic"]
    for path, image in zip(paths, (pair.left, pair.right), strict=True):
        write_heic(path, image, exif=tags)
    opened = open_pictures(paths)
    assert_same(opened.pair.right, pair.right)
    # 36 mm on film of 36 mm x 24 mm, which has the shape of 240x160 px.
    assert opened.lens.focal_px == pytest.approx(240)
    assert opened.lens.source == "EXIF"
    found = find_pairs_in(tmp_path)
    assert [named.pictures for named in found.pairs] == [tuple(paths)]


def test_a_single_picture_is_refused_like_a_photograph(tmp_path, pair):
    path = write_heic(tmp_path / "a.heic", pair.left)
    refusal = refusal_of(lambda path: open_pictures([path]), path)
    assert "found what looks like a single photograph" in refusal


def test_pictures_of_other_sizes_and_more_than_two_are_no_pair(tmp_path, pair):
    small = write_heic(tmp_path / "small.heic", pair.left, pair.right[:96, :96])
    three = write_heic(tmp_path / "three.heic", pair.left, pair.right, pair.left)
    for path in (small, three):
        refusal = refusal_of(lambda path: open_pictures([path]), path)
        assert "found what looks like a single photograph" in refusal


def test_a_single_picture_may_hold_both_views(tmp_path, pair):
    path = write_heic(tmp_path / "a.heic", np.hstack([pair.left, pair.right]))
    opened = open_pictures([path])
    assert opened.layout == "side_by_side"
    assert_same(opened.pair.right, pair.right)


@pytest.mark.parametrize("lies", range(1, 9))
def test_a_turned_picture_is_turned_upright_once(tmp_path, pair, lies):
    tags = Image.Exif()
    tags[ORIENTATION] = lies
    path = write_heic(tmp_path / "a.heic", pair.left, pair.left, exif=tags)
    lying = Image.fromarray(pair.left)
    lying.info["exif"] = tags.tobytes()
    expected = np.asarray(ImageOps.exif_transpose(lying))
    assert_same(read_image(path), expected)
    opened = open_pictures([path])
    assert_same(opened.pair.left, expected)
    assert_same(opened.pair.right, expected)


def test_alpha_grey_and_ten_bits_become_eight_bits_of_colour(tmp_path, pair):
    alpha = np.dstack([pair.left, np.full(pair.left.shape[:2], 200, np.uint8)])
    assert_same(read_image(write_heic(tmp_path / "alpha.heic", alpha)), pair.left)
    grey = pair.left[:, :, 1]
    assert_same(
        read_image(write_heic(tmp_path / "grey.heic", grey, matrix_coefficients=1)), np.dstack([grey] * 3)
    )
    deep = pair.left.astype(np.uint16) * 257
    file = pillow_heif.from_bytes("RGB;16", (240, 160), deep.tobytes())
    file.save(tmp_path / "deep.heic", **LOSSLESS)
    assert pillow_heif.open_heif(tmp_path / "deep.heic", convert_hdr_to_8bit=False).info["bit_depth"] == 10
    assert_same(read_image(tmp_path / "deep.heic"), pair.left, tolerance=1)
    deep_grey = pillow_heif.from_bytes("L;16", (240, 160), deep[:, :, 1].tobytes())
    deep_grey.save(tmp_path / "deep_grey.heic", quality=-1)
    assert_same(read_image(tmp_path / "deep_grey.heic"), np.dstack([grey] * 3), tolerance=1)


def test_a_colour_profile_is_applied_to_both_views(tmp_path):
    # Display P3's (234, 51, 35) is the red of sRGB.
    red = np.full((48, 64, 3), (234, 51, 35), np.uint8)
    path = write_heic(tmp_path / "a.heic", red, red, icc_profile=profile("Display P3", *DISPLAY_P3))
    opened = open_pictures([path])
    for image in (opened.pair.left, opened.pair.right):
        assert np.abs(image.astype(int) - (255, 0, 0)).max() <= 2
    assert "colours converted from Display P3" in map(str, opened.notes)


@pytest.mark.parametrize(
    ("primaries", "curve", "stored", "name"),
    [
        # By CSS Color 4, the red of sRGB is color(display-p3 0.917 0.200 0.139). In linear light, it is
        # (0.6274, 0.0691, 0.0164) of BT.2020 (ITU-R BT.2087); 0.8137, 0.2914, 0.1353 on the curve of sRGB.
        (12, 13, (234, 51, 35), "Display P3"),
        (9, 13, (207, 74, 34), "BT.2020"),
    ],
)
def test_colours_stated_in_numbers_are_converted(tmp_path, primaries, curve, stored, name):
    image = np.full((48, 64, 3), stored, np.uint8)
    options = {"color_primaries": primaries, "transfer_characteristics": curve}
    decoded = read_picture(write_heic(tmp_path / "a.heic", image, **options))
    assert np.abs(decoded.upright(None).astype(int) - (255, 0, 0)).max() <= 6
    assert decoded.note == f"colours converted from {name}"


def write_hdr(path, codes, *, transfer=16, primaries=9):
    """Write a picture in 10 bits, each row of which has the given shares of the greatest code, RGB."""
    row = np.rint(np.asarray(codes) * 65535).astype(np.uint16)
    row = np.repeat(row[:, None] if row.ndim == 1 else row, 16, axis=0)
    image = np.ascontiguousarray(np.broadcast_to(row, (48, *row.shape)))
    is_grey = row.shape[1] == 1
    file = pillow_heif.from_bytes("L;16" if is_grey else "RGB;16", image.shape[1::-1], image.tobytes())
    colours = {"color_primaries": primaries, "transfer_characteristics": transfer}
    file.save(path, **({"quality": -1} if is_grey else LOSSLESS) | colours)
    return path


def srgb(light):
    return 255 * (1.055 * light ** (1 / 2.4) - 0.055)


def middles(decoded):
    """Return the colours that `write_hdr` was given, as they were read."""
    return decoded.upright(None)[24, 8::16].astype(int).tolist()


# SMPTE ST 2084 has 50 % of the signal at 92.2457 cd/m2, 25 % at 5.1545 and 58.07 % at 203; white becomes 159
# of 203 by the curve of BT.2390 (tests/video/test_colours.py).
PQ_GREYS = {0.25: srgb(5.1545 / 203), 0.5: srgb(92.2457 / 203), 0.5807: srgb(0.784), 0.0: 0, 0.8: 255}


@pytest.mark.parametrize("grey", [False, True], ids=["colour", "grey"])
def test_the_brightness_of_pq_is_that_of_a_white_surface(tmp_path, grey):
    codes = [share if grey else (share,) * 3 for share in PQ_GREYS]
    decoded = read_picture(write_hdr(tmp_path / "a.heic", codes))
    np.testing.assert_allclose(middles(decoded), [(shown,) * 3 for shown in PQ_GREYS.values()], atol=1)
    assert decoded.note == "HDR (PQ), tone-mapped to SDR (BT.709)"


def test_a_pair_of_hlg_and_pq_shows_the_same_white_surface(tmp_path):
    # BT.2408: white at 203 cd/m2 is 75 % HLG.
    left = write_hdr(tmp_path / "left.heic", [(0.75,) * 3] * 4, transfer=18)
    right = write_hdr(tmp_path / "right.heic", [(0.5807,) * 3] * 4)
    opened = open_pictures([left, right])
    for eye in (opened.pair.left, opened.pair.right):
        np.testing.assert_allclose(eye, PQ_GREYS[0.5807], atol=1)
    notes = " ".join(map(str, opened.notes))
    assert all(f"HDR ({name}), tone-mapped to SDR (BT.709)" in notes for name in ("HLG", "PQ"))


@pytest.mark.parametrize(
    ("primaries", "red"),
    [
        # Linear red of BT.709 in BT.2020 (BT.2087) and in Display P3 (CSS Color 4), and as it is.
        (9, (0.6274, 0.0691, 0.0164)),
        (12, (0.8225, 0.0332, 0.0171)),
        (1, (1.0, 0.0, 0.0)),
    ],
)
def test_the_red_of_bt709_stays_pure(tmp_path, primaries, red):
    def encode(nits):
        power = (nits / 10_000) ** (2610 / 16384)
        return ((3424 / 4096 + 2413 / 128 * power) / (1 + 2392 / 128 * power)) ** (2523 / 32)

    path = write_hdr(tmp_path / "a.heic", [[encode(80 * share) for share in red]] * 2, primaries=primaries)
    np.testing.assert_allclose(middles(read_picture(path)), [(srgb(80 / 203), 0, 0)] * 2, atol=5)


def test_hdr_of_eight_bits_is_tone_mapped_too(tmp_path):
    image = np.full((48, 64, 3), 128, np.uint8)
    options = {"color_primaries": 9, "transfer_characteristics": 16}
    decoded = read_picture(write_heic(tmp_path / "a.heic", image, **options))
    # 128 / 255 is 0.50196, 94 cd/m2.
    np.testing.assert_allclose(decoded.upright(None), srgb(94 / 203), atol=1.5)


def test_a_damaged_hdr_picture_is_refused_in_one_line(tmp_path):
    path = write_hdr(tmp_path / "a.heic", [(0.5, 0.4, 0.3)] * 4)
    content = path.read_bytes()
    for end in (len(content) - 20, len(content) // 2):
        path.write_bytes(content[:end])
        assert str(path) in refusal_of(read_image, path)


def test_a_profile_of_colours_in_numbers_has_a_copyright_of_its_own(tmp_path, pair):
    with open_picture(write_heic(tmp_path / "a.heic", pair.left, color_primaries=12)) as picture:
        stored = ImageCms.ImageCmsProfile(io.BytesIO(make_profile(picture.info["nclx_profile"])))
    assert ImageCms.getProfileDescription(stored).strip() == "Display P3"
    assert ImageCms.getProfileCopyright(stored).strip() == "No copyright, use freely"


def test_without_pillow_heif_the_error_names_the_extra(tmp_path, pair, monkeypatch):
    path = write_heic(tmp_path / "a.heic", pair.left, pair.right)
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    for function in (read_image, lambda path: open_pictures([path])):
        assert refusal_of(function, path) == (
            f"{path}: expected a picture, found HEIC, which needs pillow-heif, but the module pillow_heif is "
            "not installed; install the extra 'heic' from your wheel or your copy of the source: "
            'pip install "stereoweave[heic]"'
        )


def test_an_enormous_file_is_refused_unread(tmp_path):
    path = tmp_path / "a.heic"
    with path.open("wb") as file:
        file.write(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic")
        file.truncate(600_000_000)
    assert "expected a HEIC picture of at most 500 MB, found 600 MB" in refusal_of(read_image, path)


# Hostile files


def test_a_file_of_more_than_twenty_pictures_is_refused_before_it_is_opened(tmp_path, monkeypatch):
    small = np.zeros((64, 64, 3), np.uint8)
    most = write_heic(tmp_path / "most.heic", *[small] * 20)
    assert read_image(most).shape == (64, 64, 3)
    path = write_heic(tmp_path / "a.heic", *[small] * 21)
    monkeypatch.setattr(pillow_heif, "HeifImageFile", None)
    refusal = refusal_of(read_image, path)
    assert "expected a HEIC file of at most 20 pictures, found 21; save its two views as" in refusal


def test_hidden_pictures_and_metadata_do_not_count(tmp_path):
    small = np.zeros((64, 64, 3), np.uint8)
    tags = Image.Exif()
    tags[ORIENTATION] = 1
    path = write_heic(tmp_path / "a.heic", *[small] * 21, exif=tags)
    content = path.read_bytes()
    last = content.rindex(b"hvc1") - 12
    assert content[last : last + 8] == b"infe\2\0\0\0"
    path.write_bytes(content[: last + 7] + b"\1" + content[last + 8 :])
    assert read_image(path).shape == (64, 64, 3)


def test_pictures_that_share_a_large_profile_are_refused_before_they_are_opened(tmp_path, monkeypatch):
    small = np.zeros((64, 64, 3), np.uint8)
    path = write_heic(tmp_path / "a.heic", *[small] * 20, icc_profile=bytes(3_000_000))
    monkeypatch.setattr(pillow_heif, "HeifImageFile", None)
    refusal = refusal_of(read_image, path)
    assert "expected a HEIC picture whose box 'meta' is at most 1 MB, found 3.0 MB; save it" in refusal


@pytest.mark.parametrize("first", [True, False])
def test_a_second_box_of_pictures_is_refused(tmp_path, pair, first):
    path = write_heic(tmp_path / "a.heic", pair.left)
    content = path.read_bytes()
    start = content.index(b"meta") - 4
    end = start + int.from_bytes(content[start : start + 4])
    at = start if first else len(content)
    path.write_bytes(content[:at] + content[start:end] + content[at:])
    assert "found one that cannot be read (no box 'meta', or several)" in refusal_of(read_image, path)


def test_endless_boxes_are_not_followed(tmp_path):
    content = of_boxes(pose(0), pose(1, 64_000), box(b"free"))
    few, many = box(b"free") * 900, box(b"free") * 1000
    assert lens_of(tmp_path / "few.heic", few + content).baseline_m == pytest.approx(0.064)
    assert lens_of(tmp_path / "many.heic", many + content) is None


def test_a_view_of_enormous_size_is_refused_before_memory_is_allocated(tmp_path, pair):
    path = write_heic(tmp_path / "a.heic", pair.left, pair.right[:96, :96])
    stated = b"ispe" + bytes(4) + struct.pack(">LL", 96, 96)
    enormous = b"ispe" + bytes(4) + struct.pack(">LL", 12_000, 11_000)
    changed(path, path, (stated, enormous))
    refusal = refusal_of(lambda path: open_pictures([path]), path)
    assert "expected at most 130 megapixels, found 12000x11000; scale it down" in refusal


def test_a_crop_larger_than_its_picture_is_refused(tmp_path):
    # Widths and heights are fractions: 24,000 / 2 and 11,000 / 1.
    crop = box(b"clap", struct.pack(">8L", 24_000, 2, 11_000, 1, 0, 1, 0, 1))
    path = tmp_path / "a.heic"
    path.write_bytes(of_boxes(box(b"ispe", bytes(4), struct.pack(">LL", 64, 48)), crop))
    assert heif.read_sizes(path) == [(64, 48), (12_000, 11_000)]


# Damaged files


@pytest.mark.parametrize(
    "damage",
    [
        *(pytest.param(slice(share), id=f"cut at {share:.0%}") for share in (0.001, 0.005, 0.01, 0.1, 0.5)),
        *(pytest.param(slice(share), id=f"cut at {share:.0%}") for share in (0.75, 0.9, 0.999)),
        *(pytest.param((kind, b"xxxx"), id=f"no {kind.decode()}") for kind in (b"meta", b"iloc", b"iinf")),
        *(pytest.param((kind, b"xxxx"), id=f"no {kind.decode()}") for kind in (b"ipma", b"ipco", b"hvcC")),
        *(pytest.param((kind, b"xxxx"), id=f"no {kind.decode()}") for kind in (b"ispe", b"pitm", b"hdlr")),
        pytest.param((b"infe", b"infe\xff\xff\xff\xff"), id="an item of an unknown version"),
        pytest.param((b"iinf", b"iinf\0\0\0\0\xff\xff"), id="more items than there are"),
        pytest.param((b"mdat", b"mdat" + bytes(2000)), id="no pixels"),
    ],
)
def test_a_damaged_file_is_refused_in_one_line(tmp_path, pair, damage):
    path = write_heic(tmp_path / "a.heic", pair.left, pair.right)
    content = path.read_bytes()
    if isinstance(damage, slice):
        content = content[: int(damage.stop * len(content))]
    else:
        kind, new = damage
        at = content.index(kind)
        content = content[:at] + new + content[at + len(new) :]
    path.write_bytes(content)
    assert "found " in refusal_of(lambda path: open_pictures([path]), path)
    with suppress(FormatError):  # what is left of one view may be sound
        read_image(path)


def test_a_picture_of_another_size_than_its_header_states_is_refused(tmp_path, pair):
    path = write_heic(tmp_path / "a.heic", pair.left)
    content = path.read_bytes()
    size = b"ispe" + bytes(4) + struct.pack(">LL", 240, 160)
    assert size in content
    path.write_bytes(content.replace(size, b"ispe" + bytes(4) + struct.pack(">LL", 64, 64)))
    with pytest.raises(FormatError, match="found"):
        read_image(path)
