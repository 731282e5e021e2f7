import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.arrays import as_rgb
from stereoweave.io.images import read_image

# Neighbouring values differ everywhere, so that swapped axes or channels are detected.
COLOURS = np.arange(40 * 50 * 3).reshape(40, 50, 3).astype(np.uint8)


def test_a_uint8_rgb_array_is_returned_itself():
    assert as_rgb(COLOURS) is COLOURS


def test_grey_is_repeated_in_two_and_in_three_dimensions():
    grey = COLOURS[..., 0]
    for picture in (grey, grey[..., None], grey[None]):
        np.testing.assert_array_equal(as_rgb(picture), np.stack([grey, grey, grey], axis=2))


def test_alpha_is_dropped():
    with_alpha = np.dstack([COLOURS, np.full((40, 50), 7, np.uint8)])
    np.testing.assert_array_equal(as_rgb(with_alpha), COLOURS)
    np.testing.assert_array_equal(as_rgb(np.moveaxis(with_alpha, 2, 0)), COLOURS)


def test_16_bits_are_reduced_to_the_upper_byte_in_either_byte_order():
    deep = COLOURS.astype(np.uint16) * 256 + 255
    np.testing.assert_array_equal(as_rgb(deep), COLOURS)
    np.testing.assert_array_equal(as_rgb(deep.astype(">u2")), COLOURS)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_a_float_is_the_share_of_white(dtype):
    shares = np.broadcast_to(np.array([0, 0.5, 1], dtype), (40, 50, 3))
    assert as_rgb(shares)[0, 0].tolist() == [0, 128, 255]  # 127.5 is rounded to even


def test_a_float_slightly_outside_the_range_is_accepted():
    for dtype in (np.float16, np.float32, np.float64):
        assert as_rgb(np.full((40, 50), 1.001, dtype))[0, 0].tolist() == [255, 255, 255]
        assert as_rgb(np.full((40, 50), -0.001, dtype))[0, 0].tolist() == [0, 0, 0]


def test_the_result_is_contiguous():
    for picture in (COLOURS[:, ::-1], np.moveaxis(COLOURS, 2, 0), np.dstack([COLOURS, COLOURS[..., :1]])):
        assert as_rgb(picture).flags.c_contiguous


def test_channels_are_in_the_last_axis_if_its_length_fits():
    assert as_rgb(np.zeros((3, 50, 3), np.uint8)).shape == (3, 50, 3)
    assert as_rgb(np.zeros((3, 50, 40), np.uint8)).shape == (50, 40, 3)


@pytest.mark.parametrize(
    "mode",
    [
        "1",
        "CMYK",
        "F",
        "HSV",
        "I",
        "I;16",
        "I;16B",
        "L",
        "LA",
        "La",
        "LAB",
        "P",
        "PA",
        "RGBA",
        "RGBX",
        "RGBa",
    ],
)
def test_a_pil_image_of_any_mode_is_accepted(mode):
    image = as_rgb(Image.new(mode, (50, 40)))
    assert (image.shape, image.dtype) == ((40, 50, 3), np.uint8)


def test_a_pil_colour_image_has_the_pixels_of_its_array():
    picture = Image.fromarray(COLOURS)
    np.testing.assert_array_equal(as_rgb(picture), COLOURS)
    assert as_rgb(picture).flags.writeable


@pytest.mark.parametrize("values", [[[0, 255], [128, 7]], [[0, 65535], [32768, 256]]])
def test_a_32_bit_pil_image_is_read_as_the_same_file_is(tmp_path, values):
    picture = Image.fromarray(np.kron(np.array(values, np.int32), np.ones((32, 32), np.int32)))
    picture.save(tmp_path / "deep.tif")
    np.testing.assert_array_equal(as_rgb(picture), read_image(tmp_path / "deep.tif"))


def test_a_pil_image_is_not_turned_by_its_exif_tag():
    picture = Image.fromarray(COLOURS)
    picture.getexif()[0x0112] = 6  # rotate by 90 degrees for display
    assert as_rgb(picture).shape == (40, 50, 3)


@pytest.mark.parametrize(
    "arrange",
    [lambda t: t, lambda t: t.permute(2, 0, 1), lambda t: t.permute(2, 0, 1)[None], lambda t: t[None]],
    ids=["h w 3", "3 h w", "1 3 h w", "1 h w 3"],
)
@pytest.mark.parametrize("as_kind", [lambda t: t, lambda t: t.float() / 255, lambda t: t.double() / 255])
def test_a_tensor_is_accepted_with_any_axis_order_and_type(arrange, as_kind):
    tensor = arrange(as_kind(torch.from_numpy(COLOURS)))
    np.testing.assert_array_equal(as_rgb(tensor), COLOURS)


def test_a_tensor_with_a_gradient_or_of_half_precision_is_accepted():
    white = torch.ones(3, 40, 50, requires_grad=True)
    for tensor in (white, white.half(), white.bfloat16()):
        assert (as_rgb(tensor) == 255).all()


def test_a_grey_tensor_is_repeated():
    assert as_rgb(torch.full((1, 40, 50), 9, dtype=torch.uint8))[3, 4].tolist() == [9, 9, 9]


def test_converting_images_does_not_import_pytorch():
    program = "import sys, stereoweave.io.arrays; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


@pytest.mark.parametrize("as_kind", [str, Path])
def test_a_path_is_read_and_turned_upright(tmp_path, as_kind):
    picture = Image.fromarray(COLOURS)
    picture.getexif()[0x0112] = 6  # rotate clockwise by 90 degrees for display
    picture.save(tmp_path / "left.png", exif=picture.getexif())
    image = as_rgb(as_kind(tmp_path / "left.png"))
    np.testing.assert_array_equal(image, np.rot90(COLOURS, -1))


@pytest.mark.parametrize("name", ["missing.png", ""])
def test_a_path_that_cannot_be_read_is_named_with_the_reason(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        FormatError,
        match=r"^(missing.png|\.): expected a picture .*(no such file|a folder; give the files in it)$",
    ):
        as_rgb(name, "left")


@pytest.mark.usefixtures("without_shape_checks")
@pytest.mark.parametrize(
    ("thing", "words"),
    [
        (b"left.png", ["got bytes", "expected a path"]),
        (None, ["got None, which cv2.imread returns", "check the path"]),
        (np.zeros((2, 40, 50, 3), np.uint8), ["got [2, 40, 50, 3]", "one image at a time"]),
        (np.zeros((40, 50, 2), np.uint8), ["got [40, 50, 2]"]),
        (np.zeros(3), ["got [3]"]),
        (np.zeros((40, 50, 3), np.int64), ["int64 [40, 50, 3]", "astype('uint8')"]),
        (np.full((40, 50), 1023, np.uint16), ["uint16 [40, 50] up to 1023", "of 10 bits by 64"]),
        (np.zeros((40, 50), bool), ["bool [40, 50]", "uint8, uint16 or floats", "astype('uint8') * 255"]),
        (torch.full((3, 40, 50), 255.0), ["float32 [3, 40, 50]", "from 255 to 255", "divide"]),
        (np.full((40, 50, 3), -0.1), ["float64", "-0.1", "0..1"]),
        (np.full((40, 50), np.nan), ["nan", "replace NaN"]),
        (np.full((40, 50), 1e308), ["from 1e+308 to 1e+308"]),
        (torch.full((40, 50), 300.0).half().numpy(), ["float16", "from 300 to 300"]),
        (Image.new("I", (0, 0)), ["int32 [0, 0]"]),
        (Image.new("F", (50, 40), 3), ["float32 [40, 50]", "from 3 to 3"]),
        (Image.new("I", (50, 40), 70000), ["int32"]),
    ],
)
def test_anything_else_is_refused_in_one_line_that_describes_it(thing, words):
    with pytest.raises(StereoweaveError, match=r"^left picture: expected") as refusal:
        as_rgb(thing, "left picture")
    assert "\n" not in str(refusal.value)
    for word in words:
        assert word in str(refusal.value)
