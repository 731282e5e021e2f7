import struct

import cv2
import numpy as np
import pytest
from full_disks import disk_with_room
from picture_examples import refusal_of
from PIL import Image

from stereoweave.errors import StereoweaveError
from stereoweave.io import images, maps


@pytest.fixture
def picture():
    """Return an image that is smooth, so that JPEG keeps it, and differs in every channel and direction."""
    y, x = np.mgrid[:40, :48]
    return np.stack([5 * x, 6 * y, 255 - 2 * x - 2 * y], axis=-1).astype(np.uint8)


# PFM


@pytest.mark.parametrize(("scale", "order"), [("-1.0", "<"), ("1", ">"), ("-0.003922", "<")])
def test_a_pfm_file_has_its_bottom_row_first_in_either_byte_order(tmp_path, scale, order):
    values = struct.pack(f"{order}6f", 4, 5, 6.5, 1, 2, float("inf"))
    (tmp_path / "map.pfm").write_bytes(f"Pf\n3 2\n{scale}\n".encode() + values)
    found = maps.read_pfm(tmp_path / "map.pfm")
    np.testing.assert_array_equal(found, [[1, 2, np.inf], [4, 5, 6.5]])
    assert found.dtype == np.dtype("=f4")


def test_a_pfm_file_is_written_byte_for_byte(tmp_path):
    maps.write_pfm(tmp_path / "map.pfm", np.array([[1.0, 2.0], [3.0, -4.5]]))
    expected = b"Pf\n2 2\n-1.0\n" + struct.pack("<4f", 3, -4.5, 1, 2)
    assert (tmp_path / "map.pfm").read_bytes() == expected


def test_a_pfm_file_keeps_every_bit(tmp_path, rng):
    values = rng.normal(size=(7, 5)).astype(np.float32)
    values[0, 0], values[1, 1] = np.nan, -np.inf
    maps.write_pfm(tmp_path / "map.pfm", values)
    np.testing.assert_array_equal(maps.read_pfm(tmp_path / "map.pfm"), values)


def test_opencv_reads_the_same_pfm(tmp_path, rng):
    values = rng.normal(size=(7, 5)).astype(np.float32)
    maps.write_pfm(tmp_path / "map.pfm", values)
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
def test_a_file_that_is_not_a_pfm_is_refused(tmp_path, content, found):
    (tmp_path / "map.pfm").write_bytes(content)
    assert found in refusal_of(maps.read_pfm, tmp_path / "map.pfm")


def test_a_missing_pfm_is_named(tmp_path):
    assert refusal_of(maps.read_pfm, tmp_path / "map.pfm").endswith("found no such file")


# Disparity and depth in PNG


def stored(path):
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def test_a_disparity_png_holds_pixels_times_256_and_unknown_as_0(tmp_path):
    disparity_px = np.array([[1.0, 0.5, 255.99], [100.25, np.nan, np.inf]], np.float32)
    maps.write_disparity_png(tmp_path / "disparity.png", disparity_px)
    steps = stored(tmp_path / "disparity.png")
    assert steps.dtype == np.uint16
    np.testing.assert_array_equal(steps, [[256, 128, 65533], [25664, 0, 0]])


def test_a_disparity_of_zero_does_not_become_unknown(tmp_path):
    maps.write_disparity_png(tmp_path / "disparity.png", np.array([[0.0, 0.001, -0.001]]))
    np.testing.assert_array_equal(stored(tmp_path / "disparity.png"), [[1, 1, 1]])


def test_a_disparity_png_is_read_back_within_half_a_step(tmp_path, rng):
    disparity_px = rng.uniform(0.01, 255.99, (30, 40)).astype(np.float32)
    disparity_px[3, 4] = np.nan
    maps.write_disparity_png(tmp_path / "disparity.png", disparity_px)
    read = maps.read_disparity_png(tmp_path / "disparity.png")
    np.testing.assert_allclose(read, disparity_px, atol=0.5 / 256)
    assert read.dtype == np.float32


def test_a_map_without_a_known_pixel_is_written_as_unknown(tmp_path):
    maps.write_disparity_png(tmp_path / "disparity.png", np.full((2, 3), np.nan))
    assert np.isnan(maps.read_disparity_png(tmp_path / "disparity.png")).all()


@pytest.mark.parametrize(("wrong_px", "found"), [(-0.5, "-0.500 to 9.000"), (256.0, "9.000 to 256.000")])
def test_a_disparity_that_a_png_cannot_hold_leaves_no_file(tmp_path, wrong_px, found):
    disparity_px = np.array([[wrong_px, 9.0, np.nan]])
    path = tmp_path / "disparity.png"
    assert f"found {found}" in refusal_of(maps.write_disparity_png, path, disparity_px, kind=maps.RangeError)
    assert list(tmp_path.iterdir()) == []


def test_a_scaled_png_holds_negative_and_large_disparities_with_scale_and_offset(tmp_path):
    path = tmp_path / "disparity_scaled.png"
    maps.write_scaled_disparity_png(path, np.array([[-3.5, 0.0, 600.0, np.nan]]))
    # From an offset of -5 to 600 are 605 px; 65,535 steps of 1/128 px are 512 px, too few, of 1/64 px enough.
    with Image.open(path) as picture:
        assert picture.text == {
            "disparity_scale_px": "0.015625",
            "disparity_offset_px": "-5.0",
            "disparity_unknown_value": "0",
        }
    np.testing.assert_array_equal(stored(path), [[1.5 * 64, 5 * 64, 605 * 64, 0]])
    assert maps.format_scale(0.015625, -5.0) == "value / 64 - 5"
    assert maps.format_scale(0.25, 7.0) == "value / 4 + 7"


@pytest.mark.parametrize(("low_px", "high_px"), [(-0.6, 40), (-640, 640), (300, 301), (0, 32766), (0, 255)])
def test_a_scaled_png_of_any_range_is_read_back_within_half_a_step(tmp_path, rng, low_px, high_px):
    disparity_px = rng.uniform(low_px, high_px, (30, 40)).astype(np.float32)
    disparity_px[3, 4], disparity_px[0, 0], disparity_px[1, 1] = np.nan, low_px, high_px
    maps.write_scaled_disparity_png(tmp_path / "scaled.png", disparity_px)
    read_px = maps.read_disparity_png(tmp_path / "scaled.png")
    # No power of two for a step is more than twice as large as necessary, and none is below 1/256 px.
    step_px = max(2 * (high_px - low_px + 2) / 65535, 1 / 256)
    np.testing.assert_allclose(read_px, disparity_px, atol=max(step_px / 2, 1 / 256))
    assert (np.isnan(read_px) == np.isnan(disparity_px)).all()


@pytest.mark.parametrize("text", ["a few", "nan", "inf", ""])
def test_a_scale_that_is_no_number_is_refused(tmp_path, text):
    path = tmp_path / "scaled.png"
    images.save_picture(path, np.ones((2, 3), np.uint16), "PNG", texts={"disparity_scale_px": text})
    message = refusal_of(maps.read_disparity_png, path)
    assert (
        f"expected numbers in the text chunks disparity_scale_px and disparity_offset_px, found {text!r}"
        in message
    )


def test_a_disparity_png_of_8_bits_is_refused(tmp_path, picture):
    images.write_image(tmp_path / "disparity.png", picture[..., 0])
    assert "found mode L (PNG)" in refusal_of(maps.read_disparity_png, tmp_path / "disparity.png")


def test_a_depth_png_holds_millimetres_and_unknown_as_0(tmp_path):
    depth_m = np.array([[1.0, 2.3456, 65.535], [65.536, np.inf, np.nan]])
    maps.write_depth_png(tmp_path / "depth.png", depth_m)
    np.testing.assert_array_equal(stored(tmp_path / "depth.png"), [[1000, 2346, 65535], [0, 0, 0]])


@pytest.mark.parametrize("write", [maps.write_pfm, maps.write_float_tiff, maps.write_npy])
def test_a_map_that_a_full_disk_cuts_off_is_an_error_and_leaves_no_file(tmp_path, write):
    path = tmp_path / "disparity"
    with disk_with_room(4000):  # for 1000 values of 4 bytes, and no header
        found = refusal_of(write, path, np.ones((25, 40)), kind=StereoweaveError)
    assert found == f"{path}: expected a writable file, found file too large"
    assert list(tmp_path.iterdir()) == []


# Stored values of pictures


@pytest.mark.parametrize(
    ("mode", "values"),
    [
        ("L", np.arange(12, dtype=np.uint8).reshape(3, 4)),
        ("1", np.eye(4, dtype=np.bool_)),
        ("I;16", np.array([[0, 1, 65535]], np.uint16)),
        ("RGB", np.array([[[1, 2, 3], [255, 0, 128]]], np.uint8)),
    ],
)
def test_stored_values_are_read_unchanged(tmp_path, mode, values):
    path = tmp_path / "numbers.png"
    Image.fromarray(values).save(path)
    read = maps.read_pixels(path, "other", mode)
    assert read.dtype == values.dtype
    np.testing.assert_array_equal(read, values)


def test_stored_values_of_another_mode_are_refused(tmp_path, picture):
    images.write_image(tmp_path / "colour.png", picture)
    assert "mode L or 1, found mode RGB (PNG)" in refusal_of(
        maps.read_pixels, tmp_path / "colour.png", "L", "1"
    )
    refusal_of(maps.read_pixels, tmp_path / "nowhere.png", "L")
