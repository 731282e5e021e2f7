import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io import files as io
from stereoweave.stereo import StereoPair


@pytest.fixture
def picture():
    """Smooth, so that JPEG keeps it, and different in every channel and direction."""
    y, x = np.mgrid[:40, :48]
    return np.stack([5 * x, 6 * y, 255 - 2 * x - 2 * y], axis=-1).astype(np.uint8)


def pair_of(width_px, height_px):
    image = np.zeros((height_px, width_px, 3), np.uint8)
    return StereoPair(left=image, right=image)


def raises(function, *arguments, kind=FormatError):
    """The message of the error that the call must end in, which names the file in one line."""
    with pytest.raises(kind) as caught:
        function(*arguments)
    message = str(caught.value)
    assert "\n" not in message
    assert str(arguments[0]) in message
    assert "expected" in message
    return message


# Pictures


@pytest.mark.parametrize("ending", ["png", "tiff", "bmp", "PNG"])
def test_a_picture_comes_back_as_it_was_written(tmp_path, picture, ending):
    path = tmp_path / f"picture.{ending}"
    io.write_image(path, picture)
    image = io.read_image(path)
    np.testing.assert_array_equal(image, picture)
    assert image.flags.writeable


@pytest.mark.parametrize("ending", ["jpg", "jpeg", "webp"])
def test_a_picture_of_few_bytes_comes_back_nearly(tmp_path, picture, ending):
    io.write_image(tmp_path / f"picture.{ending}", picture)
    assert np.abs(io.read_image(tmp_path / f"picture.{ending}").astype(int) - picture).max() < 12


def test_a_path_may_be_a_string(tmp_path, picture):
    io.write_image(f"{tmp_path}/picture.png", picture)
    np.testing.assert_array_equal(io.read_image(f"{tmp_path}/picture.png"), picture)


def test_a_grey_picture_has_three_equal_channels(tmp_path, picture):
    grey = picture[..., 0]
    io.write_image(tmp_path / "grey.png", grey)
    assert cv2.imread(str(tmp_path / "grey.png"), cv2.IMREAD_UNCHANGED).ndim == 2
    np.testing.assert_array_equal(io.read_image(tmp_path / "grey.png"), np.dstack([grey] * 3))


@pytest.mark.parametrize("alpha", [0, 128, 255])
def test_alpha_is_dropped_whatever_it_is(tmp_path, picture, alpha):
    rgba = np.dstack([picture, np.full(picture.shape[:2], alpha, np.uint8)])
    Image.fromarray(rgba).save(tmp_path / "rgba.png")
    np.testing.assert_array_equal(io.read_image(tmp_path / "rgba.png"), picture)


@pytest.mark.parametrize("ending", ["png", "tiff", "pgm"])
def test_sixteen_bit_grey_keeps_the_upper_byte(tmp_path, ending):
    values = np.full((40, 48), 0x1234, np.uint16)
    values[0, 0], values[0, 1] = 0, 0xFFFF
    cv2.imwrite(str(tmp_path / f"grey.{ending}"), values)
    expected = np.full((40, 48, 3), 0x12, np.uint8)
    expected[0, 0], expected[0, 1] = 0, 255
    np.testing.assert_array_equal(io.read_image(tmp_path / f"grey.{ending}"), expected)


@pytest.mark.parametrize(("scale", "shift"), [(1, 0), (257, 8)])
def test_grey_of_32_bits_is_taken_for_the_8_or_16_that_it_holds(tmp_path, scale, shift):
    values = np.tile(np.arange(256, dtype=np.int32) * scale, (40, 1))
    Image.fromarray(values).save(tmp_path / "grey.tiff")
    np.testing.assert_array_equal(io.read_image(tmp_path / "grey.tiff")[..., 1], values >> shift)


def test_dark_grey_of_16_bits_stays_dark(tmp_path):
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((40, 48), 200, np.uint16))
    assert io.read_image(tmp_path / "grey.png").max() == 0


@pytest.mark.parametrize("level", [-1, 65536])
def test_grey_beyond_16_bits_is_refused(tmp_path, level):
    Image.fromarray(np.full((40, 48), level, np.int32)).save(tmp_path / "grey.tiff")
    assert "more than 16 bits a channel or values below 0" in raises(io.read_image, tmp_path / "grey.tiff")


@pytest.mark.parametrize("channels", [3, 4])
def test_sixteen_bit_colour_keeps_the_upper_bytes_in_rgb_order(tmp_path, channels):
    values = np.empty((40, 48, channels), np.uint16)
    values[:] = (0x3056, 0x2034, 0x1012, 0x8000)[:channels]  # OpenCV writes blue first
    cv2.imwrite(str(tmp_path / "colour.png"), values)
    np.testing.assert_array_equal(io.read_image(tmp_path / "colour.png")[3, 4], [0x10, 0x20, 0x30])


@pytest.mark.parametrize("transparency", [None, 1, bytes([0, 128, 255])])
def test_a_palette_picture_shows_its_colours(tmp_path, transparency):
    indices = np.tile(np.arange(3, dtype=np.uint8), (40, 16))
    picture = Image.fromarray(indices)
    picture.putpalette([255, 0, 0, 0, 255, 0, 0, 0, 255])
    picture.save(tmp_path / "palette.png", **({} if transparency is None else {"transparency": transparency}))
    image = io.read_image(tmp_path / "palette.png")
    np.testing.assert_array_equal(image[0, :3], [[255, 0, 0], [0, 255, 0], [0, 0, 255]])


def test_a_picture_is_turned_upright(tmp_path, picture):
    exif = Image.Exif()
    exif[0x0112] = 6  # to be shown turned clockwise by 90 degrees
    Image.fromarray(picture).save(tmp_path / "turned.png", exif=exif)
    np.testing.assert_array_equal(io.read_image(tmp_path / "turned.png"), np.rot90(picture, -1))


@pytest.mark.parametrize("options", [{"format": "PNG"}, {"format": "JPEG"}, {"format": "TIFF"}], ids=str)
def test_a_truncated_picture_is_an_error(tmp_path, rng, options):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    Image.fromarray(rng.integers(0, 256, (64, 80, 3), dtype=np.uint8)).save(whole, **options)
    content = whole.read_bytes()
    for share in (0.02, 0.3, 0.5, 0.9, 0.99):
        cut.write_bytes(content[: int(share * len(content))])
        assert "found" in raises(io.read_image, cut)


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_wherever_a_picture_is_cut_it_never_comes_back_changed(tmp_path, picture, kind):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    Image.fromarray(picture).save(whole, kind)
    content, expected = whole.read_bytes(), io.read_image(whole)
    errors = 0
    for length in range(len(content)):
        cut.write_bytes(content[:length])
        try:
            np.testing.assert_array_equal(io.read_image(cut), expected)
        except FormatError:
            errors += 1
    assert errors > len(content) - 32  # what a PNG has after its pixels may be missing


def test_a_missing_picture_names_itself(tmp_path):
    assert raises(io.read_image, tmp_path / "none.png").endswith("found no such file")


def test_a_folder_is_no_picture(tmp_path):
    assert raises(io.read_image, tmp_path).endswith("found a folder")


@pytest.mark.parametrize("content", [b"", b"hello", b"cam0=[994.978 0 311.193]\n", b"\x89PNG\r\n\x1a\n"])
def test_what_is_no_picture_is_named(tmp_path, content):
    (tmp_path / "picture.png").write_bytes(content)
    assert raises(io.read_image, tmp_path / "picture.png").endswith("found something else")


def test_a_picture_of_floats_is_refused(tmp_path):
    Image.fromarray(np.ones((40, 48), np.float32)).save(tmp_path / "float.tiff")
    assert "more than 16 bits" in raises(io.read_image, tmp_path / "float.tiff")


def test_a_picture_of_a_huge_declared_size_is_refused(tmp_path):
    (tmp_path / "huge.ppm").write_bytes(b"P6 100000 100000 255\n")
    assert "10000000000 pixels" in raises(io.read_image, tmp_path / "huge.ppm")


@pytest.mark.parametrize(("width_px", "height_px"), [(31, 40), (40, 31), (1, 1)])
def test_a_picture_under_32_pixels_is_refused(tmp_path, width_px, height_px):
    io.write_image(tmp_path / "small.png", np.zeros((height_px, width_px, 3), np.uint8))
    message = raises(io.read_image, tmp_path / "small.png")
    assert message.endswith(f"expected at least 32x32 pixels, found {width_px}x{height_px}")


def test_a_picture_of_32_pixels_is_read(tmp_path):
    io.write_image(tmp_path / "small.png", np.zeros((32, 32, 3), np.uint8))
    assert io.read_image(tmp_path / "small.png").shape == (32, 32, 3)


@pytest.mark.parametrize("name", ["picture", "picture.foo", "picture.psd", "picture.pdf"])
def test_an_unknown_ending_is_refused(tmp_path, picture, name):
    message = raises(io.write_image, tmp_path / name, picture, kind=StereoweaveError)
    assert f"found {Path(name).suffix!r}" in message
    assert list(tmp_path.iterdir()) == []


# Pairs


def test_a_pair_is_read_from_two_files(tmp_path, picture):
    io.write_image(tmp_path / "left.png", picture)
    io.write_image(tmp_path / "right.png", picture[::-1])
    pair = io.read_pair(tmp_path / "left.png", tmp_path / "right.png")
    np.testing.assert_array_equal(pair.left, picture)
    np.testing.assert_array_equal(pair.right, picture[::-1])


def test_pictures_of_two_sizes_are_both_named_with_their_sizes(tmp_path, picture):
    left, right = tmp_path / "left.png", tmp_path / "right.png"
    io.write_image(left, picture)
    io.write_image(right, picture[:, :-1])
    assert f"{left} of 48x40 and {right} of 47x40" in raises(io.read_pair, left, right)


# PFM


@pytest.mark.parametrize(("scale", "order"), [("-1.0", "<"), ("1", ">"), ("-0.003922", "<")])
def test_a_pfm_file_has_its_bottom_row_first_in_either_byte_order(tmp_path, scale, order):
    values = struct.pack(f"{order}6f", 4, 5, 6.5, 1, 2, float("inf"))
    (tmp_path / "map.pfm").write_bytes(f"Pf\n3 2\n{scale}\n".encode() + values)
    found = io.read_pfm(tmp_path / "map.pfm")
    np.testing.assert_array_equal(found, [[1, 2, np.inf], [4, 5, 6.5]])
    assert found.dtype == np.dtype("=f4")


def test_a_pfm_file_is_written_byte_for_byte(tmp_path):
    io.write_pfm(tmp_path / "map.pfm", np.array([[1.0, 2.0], [3.0, -4.5]]))
    expected = b"Pf\n2 2\n-1.0\n" + struct.pack("<4f", 3, -4.5, 1, 2)
    assert (tmp_path / "map.pfm").read_bytes() == expected


def test_a_pfm_file_keeps_every_bit(tmp_path, rng):
    values = rng.normal(size=(7, 5)).astype(np.float32)
    values[0, 0], values[1, 1] = np.nan, -np.inf
    io.write_pfm(tmp_path / "map.pfm", values)
    np.testing.assert_array_equal(io.read_pfm(tmp_path / "map.pfm"), values)


def test_opencv_reads_the_same_pfm(tmp_path, rng):
    values = rng.normal(size=(7, 5)).astype(np.float32)
    io.write_pfm(tmp_path / "map.pfm", values)
    read = cv2.imread(str(tmp_path / "map.pfm"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(read, values)


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"PF\n1 1\n-1.0\n" + bytes(12), "found b'PF"),
        (b"\x89PNG\r\n\x1a\n", "found b'"),
        (b"", "found b''"),
        (b"Pf\n2 2\n-1.0\n" + bytes(15), "expected 16 bytes for 2x2 values, found 15"),
        (b"Pf\n2 2\n-1.0\n" + bytes(17), "expected 16 bytes for 2x2 values, found 17"),
        (b"Pf\n2 2\nx\n" + bytes(16), "could not convert"),
    ],
)
def test_what_is_no_pfm_is_refused(tmp_path, content, found):
    (tmp_path / "map.pfm").write_bytes(content)
    assert found in raises(io.read_pfm, tmp_path / "map.pfm")


def test_a_missing_pfm_names_itself(tmp_path):
    assert raises(io.read_pfm, tmp_path / "map.pfm").endswith("found no such file")


# Disparity and depth in PNG


def stored(path):
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def test_a_disparity_png_holds_pixels_times_256_and_unknown_as_0(tmp_path):
    disparity_px = np.array([[1.0, 0.5, 255.99], [100.25, np.nan, np.inf]], np.float32)
    io.write_disparity_png(tmp_path / "disparity.png", disparity_px)
    steps = stored(tmp_path / "disparity.png")
    assert steps.dtype == np.uint16
    np.testing.assert_array_equal(steps, [[256, 128, 65533], [25664, 0, 0]])


def test_a_disparity_of_zero_does_not_become_unknown(tmp_path):
    io.write_disparity_png(tmp_path / "disparity.png", np.array([[0.0, 0.001, -0.001]]))
    np.testing.assert_array_equal(stored(tmp_path / "disparity.png"), [[1, 1, 1]])


def test_a_disparity_png_comes_back_within_half_a_step(tmp_path, rng):
    disparity_px = rng.uniform(0.01, 255.99, (30, 40)).astype(np.float32)
    disparity_px[3, 4] = np.nan
    io.write_disparity_png(tmp_path / "disparity.png", disparity_px)
    read = io.read_disparity_png(tmp_path / "disparity.png")
    np.testing.assert_allclose(read, disparity_px, atol=0.5 / 256)
    assert read.dtype == np.float32


def test_a_map_without_a_known_pixel_is_written_as_unknown(tmp_path):
    io.write_disparity_png(tmp_path / "disparity.png", np.full((2, 3), np.nan))
    assert np.isnan(io.read_disparity_png(tmp_path / "disparity.png")).all()


@pytest.mark.parametrize(("wrong_px", "found"), [(-0.5, "-0.500 to 9.000"), (256.0, "9.000 to 256.000")])
def test_a_disparity_that_a_png_cannot_hold_leaves_none(tmp_path, wrong_px, found):
    disparity_px = np.array([[wrong_px, 9.0, np.nan]])
    path = tmp_path / "disparity.png"
    assert f"found {found}" in raises(io.write_disparity_png, path, disparity_px, kind=io.RangeError)
    assert list(tmp_path.iterdir()) == []


def test_a_disparity_png_of_8_bits_is_refused(tmp_path, picture):
    io.write_image(tmp_path / "disparity.png", picture[..., 0])
    assert "found PNG of mode L" in raises(io.read_disparity_png, tmp_path / "disparity.png")


def test_a_depth_png_holds_millimetres_and_unknown_as_0(tmp_path):
    depth_m = np.array([[1.0, 2.3456, 65.535], [65.536, np.inf, np.nan]])
    io.write_depth_png(tmp_path / "depth.png", depth_m)
    np.testing.assert_array_equal(stored(tmp_path / "depth.png"), [[1000, 2346, 65535], [0, 0, 0]])


# Numbers in pictures


@pytest.mark.parametrize(
    ("mode", "values"),
    [
        ("L", np.arange(12, dtype=np.uint8).reshape(3, 4)),
        ("1", np.eye(4, dtype=np.bool_)),
        ("I;16", np.array([[0, 1, 65535]], np.uint16)),
        ("RGB", np.array([[[1, 2, 3], [255, 0, 128]]], np.uint8)),
    ],
)
def test_numbers_come_back_as_they_are_stored(tmp_path, mode, values):
    path = tmp_path / "numbers.png"
    Image.fromarray(values).save(path)
    read = io.read_pixels(path, "other", mode)
    assert read.dtype == values.dtype
    np.testing.assert_array_equal(read, values)


def test_numbers_in_a_picture_of_another_kind_are_refused(tmp_path, picture):
    io.write_image(tmp_path / "colour.png", picture)
    assert "mode L or 1, found PNG of mode RGB" in raises(io.read_pixels, tmp_path / "colour.png", "L", "1")
    raises(io.read_pixels, tmp_path / "nowhere.png", "L")


# Writing whole files


def test_a_file_takes_its_name_only_when_it_is_whole(tmp_path):
    target = tmp_path / "out.txt"
    target.write_text("old")
    with io.replacing(target) as temporary:
        temporary.write_text("new")
        assert target.read_text() == "old"
        assert (temporary.parent, temporary.suffix) == (tmp_path, ".txt")
    assert target.read_text() == "new"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_error_leaves_what_was_there_and_nothing_else(tmp_path, error):
    target = tmp_path / "out.txt"
    target.write_text("old")
    with pytest.raises(error), io.replacing(target) as temporary:
        temporary.write_text("half")
        raise error
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_a_written_file_may_be_read_by_the_same_people_as_any_other(tmp_path, picture):
    (tmp_path / "plain").touch()
    io.write_image(tmp_path / "picture.png", picture)
    assert (tmp_path / "picture.png").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_missing_folders_are_made(tmp_path, picture):
    io.write_image(tmp_path / "new" / "folder" / "picture.png", picture)
    assert (tmp_path / "new" / "folder" / "picture.png").exists()


@pytest.mark.parametrize("folder", ["occupied", "occupied/below"])
def test_a_file_in_the_place_of_the_output_folder_is_named(tmp_path, picture, folder):
    (tmp_path / "occupied").write_text("a file")
    for function, arguments in [
        (io.make_folder, ()),
        (io.write_image, (picture,)),
        (io.write_pfm, (np.zeros((2, 2)),)),
    ]:
        target = tmp_path / folder / "out.png" if arguments else tmp_path / folder
        with pytest.raises(StereoweaveError) as caught:
            function(target, *arguments)
        assert str(caught.value).startswith(
            f"{tmp_path / folder}: expected a folder that can be written, found"
        )
        assert "\n" not in str(caught.value)
    assert (tmp_path / "occupied").read_text() == "a file"


def test_a_folder_in_the_place_of_the_output_is_named(tmp_path, picture):
    (tmp_path / "out.png").mkdir()
    message = raises(io.write_image, tmp_path / "out.png", picture, kind=StereoweaveError)
    assert message.endswith("found a folder")
    assert list(tmp_path.iterdir()) == [tmp_path / "out.png"]


def test_a_folder_is_made_and_left_empty(tmp_path):
    folder = io.make_folder(tmp_path / "new" / "folder")
    assert folder == tmp_path / "new" / "folder"
    assert list(folder.iterdir()) == []
