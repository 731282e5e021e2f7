import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from full_disks import disk_with_room
from picture_examples import refusal_of
from PIL import Image

from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io import images
from stereoweave.io.decoding import read_picture


@pytest.fixture
def picture():
    """Return an image that is smooth, so that JPEG keeps it, and differs in every channel and direction."""
    y, x = np.mgrid[:40, :48]
    return np.stack([5 * x, 6 * y, 255 - 2 * x - 2 * y], axis=-1).astype(np.uint8)


# Pictures


@pytest.mark.parametrize("ending", ["png", "tiff", "bmp", "PNG"])
def test_a_lossless_picture_is_read_back_unchanged(tmp_path, picture, ending):
    path = tmp_path / f"picture.{ending}"
    images.write_image(path, picture)
    image = images.read_image(path)
    np.testing.assert_array_equal(image, picture)
    assert image.flags.writeable


@pytest.mark.parametrize("ending", ["jpg", "jpeg", "webp"])
def test_a_lossy_picture_is_read_back_nearly_unchanged(tmp_path, picture, ending):
    images.write_image(tmp_path / f"picture.{ending}", picture)
    assert np.abs(images.read_image(tmp_path / f"picture.{ending}").astype(int) - picture).max() < 12


def test_a_path_may_be_a_string(tmp_path, picture):
    images.write_image(f"{tmp_path}/picture.png", picture)
    np.testing.assert_array_equal(images.read_image(f"{tmp_path}/picture.png"), picture)


def test_a_grey_picture_has_three_equal_channels(tmp_path, picture):
    grey = picture[..., 0]
    images.write_image(tmp_path / "grey.png", grey)
    assert cv2.imread(str(tmp_path / "grey.png"), cv2.IMREAD_UNCHANGED).ndim == 2
    np.testing.assert_array_equal(images.read_image(tmp_path / "grey.png"), np.dstack([grey] * 3))


@pytest.mark.parametrize("alpha", [0, 128, 255])
def test_any_alpha_is_dropped(tmp_path, picture, alpha):
    rgba = np.dstack([picture, np.full(picture.shape[:2], alpha, np.uint8)])
    Image.fromarray(rgba).save(tmp_path / "rgba.png")
    np.testing.assert_array_equal(images.read_image(tmp_path / "rgba.png"), picture)


@pytest.mark.parametrize("ending", ["png", "tiff", "pgm"])
def test_sixteen_bit_grey_keeps_the_upper_byte(tmp_path, ending):
    values = np.full((40, 48), 0x1234, np.uint16)
    values[0, 0], values[0, 1] = 0, 0xFFFF
    cv2.imwrite(str(tmp_path / f"grey.{ending}"), values)
    expected = np.full((40, 48, 3), 0x12, np.uint8)
    expected[0, 0], expected[0, 1] = 0, 255
    np.testing.assert_array_equal(images.read_image(tmp_path / f"grey.{ending}"), expected)


@pytest.mark.parametrize(("scale", "shift"), [(1, 0), (257, 8)])
def test_32_bit_grey_is_read_as_the_8_or_16_bits_that_it_holds(tmp_path, scale, shift):
    values = np.tile(np.arange(256, dtype=np.int32) * scale, (40, 1))
    Image.fromarray(values).save(tmp_path / "grey.tiff")
    np.testing.assert_array_equal(images.read_image(tmp_path / "grey.tiff")[..., 1], values >> shift)


def test_dark_grey_of_16_bits_stays_dark_with_a_note(tmp_path):
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((40, 48), 2600, np.uint16))
    decoded = read_picture(tmp_path / "grey.png")
    assert np.unique(decoded.image) == [10]
    assert decoded.note.startswith("nearly black: 16 bits with values up to 2600; multiply")
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros((40, 48), np.uint16))
    assert read_picture(tmp_path / "black.png").note is None


def test_a_tiff_of_12_bits_keeps_the_upper_8(tmp_path):
    # Each row has the values 0x123 and 0xFFF in turn, two of which are three bytes.
    tags = {256: 48, 257: 40, 258: 12, 259: 1, 262: 1, 273: 122, 277: 1, 278: 40, 279: 40 * 72}
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    directory = struct.pack("<H", len(tags)) + entries + bytes(4)
    header = struct.pack("<2sHI", b"II", 42, 8)
    content = header + directory
    assert len(content) == 122
    (tmp_path / "grey.tif").write_bytes(content + bytes.fromhex("123fff") * 24 * 40)
    decoded = read_picture(tmp_path / "grey.tif")
    np.testing.assert_array_equal(np.asarray(decoded.image)[0, :2, 0], [0x12, 0xFF])
    assert decoded.note is None


@pytest.mark.parametrize("level", [-1, 65536])
def test_grey_beyond_16_bits_is_refused(tmp_path, level):
    Image.fromarray(np.full((40, 48), level, np.int32)).save(tmp_path / "grey.tiff")
    message = refusal_of(images.read_image, tmp_path / "grey.tiff")
    assert "more than 16 bits per channel or with negative values" in message


@pytest.mark.parametrize("channels", [3, 4])
def test_sixteen_bit_colour_keeps_the_upper_bytes_in_rgb_order(tmp_path, channels):
    values = np.empty((40, 48, channels), np.uint16)
    values[:] = (0x3056, 0x2034, 0x1012, 0x8000)[:channels]  # OpenCV writes blue first
    cv2.imwrite(str(tmp_path / "colour.png"), values)
    np.testing.assert_array_equal(images.read_image(tmp_path / "colour.png")[3, 4], [0x10, 0x20, 0x30])


@pytest.mark.parametrize("transparency", [None, 1, bytes([0, 128, 255])])
def test_a_palette_picture_shows_its_colours(tmp_path, transparency):
    indices = np.tile(np.arange(3, dtype=np.uint8), (40, 16))
    picture = Image.fromarray(indices)
    picture.putpalette([255, 0, 0, 0, 255, 0, 0, 0, 255])
    picture.save(tmp_path / "palette.png", **({} if transparency is None else {"transparency": transparency}))
    image = images.read_image(tmp_path / "palette.png")
    np.testing.assert_array_equal(image[0, :3], [[255, 0, 0], [0, 255, 0], [0, 0, 255]])


def test_a_picture_is_turned_upright(tmp_path, picture):
    exif = Image.Exif()
    exif[0x0112] = 6  # rotate clockwise by 90 degrees for display
    Image.fromarray(picture).save(tmp_path / "turned.png", exif=exif)
    np.testing.assert_array_equal(images.read_image(tmp_path / "turned.png"), np.rot90(picture, -1))


@pytest.mark.parametrize("options", [{"format": "PNG"}, {"format": "JPEG"}, {"format": "TIFF"}], ids=str)
def test_a_truncated_picture_is_an_error(tmp_path, rng, options):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    Image.fromarray(rng.integers(0, 256, (64, 80, 3), dtype=np.uint8)).save(whole, **options)
    content = whole.read_bytes()
    for share in (0.02, 0.3, 0.5, 0.9, 0.99):
        cut.write_bytes(content[: int(share * len(content))])
        assert "found" in refusal_of(images.read_image, cut)


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_a_picture_cut_anywhere_is_never_read_with_changed_pixels(tmp_path, picture, kind):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    Image.fromarray(picture).save(whole, kind)
    content, expected = whole.read_bytes(), images.read_image(whole)
    errors = 0
    for length in range(len(content)):
        cut.write_bytes(content[:length])
        try:
            np.testing.assert_array_equal(images.read_image(cut), expected)
        except FormatError:
            errors += 1
    assert errors > len(content) - 32  # the part of a PNG after its pixels may be missing


def test_a_missing_picture_is_named(tmp_path):
    assert refusal_of(images.read_image, tmp_path / "none.png").endswith("found no such file")


def test_a_folder_is_refused_as_a_picture(tmp_path):
    assert refusal_of(images.read_image, tmp_path).endswith("found a folder; give the files in it")


@pytest.mark.parametrize("content", [b"hello", b"cam0=[994.978 0 311.193]\n", b"\x89PNG\r\n\x1a\n"])
def test_a_file_that_is_not_a_picture_is_named(tmp_path, content):
    (tmp_path / "picture.png").write_bytes(content)
    assert refusal_of(images.read_image, tmp_path / "picture.png").endswith(
        "found another type of file; save it as PNG or JPEG"
    )


def test_a_picture_of_floats_is_refused(tmp_path):
    Image.fromarray(np.ones((40, 48), np.float32)).save(tmp_path / "float.tiff")
    assert "more than 16 bits" in refusal_of(images.read_image, tmp_path / "float.tiff")


def test_a_picture_of_a_huge_declared_size_is_refused(tmp_path):
    (tmp_path / "huge.ppm").write_bytes(b"P6 100000 100000 255\n")
    assert "10000000000 pixels" in refusal_of(images.read_image, tmp_path / "huge.ppm")


@pytest.mark.parametrize(("width_px", "height_px"), [(31, 40), (40, 31), (1, 1)])
def test_a_picture_under_32_pixels_is_refused(tmp_path, width_px, height_px):
    images.write_image(tmp_path / "small.png", np.zeros((height_px, width_px, 3), np.uint8))
    message = refusal_of(images.read_image, tmp_path / "small.png")
    size = f"{width_px}x{height_px}"
    assert message.endswith(f"expected at least 32x32 pixels, found {size}; give larger pictures")


def test_a_picture_of_32_pixels_is_read(tmp_path):
    images.write_image(tmp_path / "small.png", np.zeros((32, 32, 3), np.uint8))
    assert images.read_image(tmp_path / "small.png").shape == (32, 32, 3)


@pytest.mark.parametrize("name", ["picture", "picture.foo", "picture.psd", "picture.pdf"])
def test_an_unknown_ending_is_refused(tmp_path, picture, name):
    message = refusal_of(images.write_image, tmp_path / name, picture, kind=StereoweaveError)
    assert f"found {Path(name).suffix or 'none'}" in message
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", [".png", ".jpg", ".tif", ".webp", ".bmp"])
def test_a_picture_that_a_full_disk_cuts_off_is_an_error_and_keeps_the_earlier_file(tmp_path, rng, ending):
    path = tmp_path / f"picture{ending}"
    images.write_image(path, rng.integers(0, 256, (40, 48, 3), dtype=np.uint8))
    earlier = path.read_bytes()
    with disk_with_room(len(earlier) // 2):
        found = refusal_of(images.write_image, path, images.read_image(path), kind=StereoweaveError)
    assert found == f"{path}: expected a writable file, found file too large"
    assert [file.read_bytes() for file in tmp_path.iterdir()] == [earlier]


# Pairs


def test_a_pair_is_read_from_two_files(tmp_path, picture):
    images.write_image(tmp_path / "left.png", picture)
    images.write_image(tmp_path / "right.png", picture[::-1])
    pair = images.read_pair(tmp_path / "left.png", tmp_path / "right.png")
    np.testing.assert_array_equal(pair.left, picture)
    np.testing.assert_array_equal(pair.right, picture[::-1])


def test_pictures_of_two_sizes_are_both_named_with_their_sizes(tmp_path, picture):
    left, right = tmp_path / "left.png", tmp_path / "right.png"
    images.write_image(left, picture)
    images.write_image(right, picture[:, :-1])
    assert f"{left} with 48x40 and {right} with 47x40" in refusal_of(images.read_pair, left, right)
