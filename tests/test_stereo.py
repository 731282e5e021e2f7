import re

import numpy as np
import pytest

from stereoweave.errors import StereoweaveError
from stereoweave.stereo import Estimate, StereoCamera, StereoPair

CAMERA = {"focal_px": 1000.0, "baseline_m": 0.1, "cx_px": 320.0, "cy_px": 240.0}


def test_a_pair_longer_than_the_limit_is_refused_in_one_line():
    image = np.zeros((32_767, 32, 3), np.uint8)
    with pytest.raises(StereoweaveError, match="at most 32766 pixels per side, got 32x32767"):
        StereoPair(left=image, right=image)


def test_depth_is_focal_length_times_baseline_over_disparity_and_doffs():
    camera = StereoCamera(**CAMERA, doffs_px=5.0)
    depth_m = camera.depth_m(np.array([[45.0, 15.0, -3.0]], np.float32))
    np.testing.assert_array_equal(depth_m, [[2.0, 5.0, 50.0]])
    assert depth_m.dtype == np.float32


@pytest.mark.parametrize("doffs_px", [0.0, 31.086, -12.5])
def test_depth_of_the_disparity_of_a_depth_is_that_depth(rng, doffs_px):
    camera = StereoCamera(**CAMERA, doffs_px=doffs_px)
    depth_m = rng.uniform(0.5, 50, (30, 40))
    np.testing.assert_allclose(camera.depth_m(camera.disparity_px(depth_m)), depth_m, rtol=1e-12)


def test_depth_is_infinite_where_disparity_and_doffs_are_zero_or_less():
    camera = StereoCamera(**CAMERA, doffs_px=2.0)
    depth_m = camera.depth_m(np.array([[-2.0, -2.5, -100.0]]))
    np.testing.assert_array_equal(depth_m, [[np.inf, np.inf, np.inf]])


def test_the_disparity_of_infinite_depth_is_minus_doffs():
    camera = StereoCamera(**CAMERA, doffs_px=2.0)
    np.testing.assert_array_equal(camera.disparity_px(np.array([[np.inf]])), [[-2.0]])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("focal_px", 0.0),
        ("focal_px", -995.0),
        ("focal_px", np.nan),
        ("focal_px", np.inf),
        ("baseline_m", 0.0),
        ("baseline_m", -0.1),
        ("cx_px", np.nan),
        ("doffs_px", np.inf),
        ("focal_px", 1e300),
        ("cx_px", -1e300),
    ],
)
def test_a_camera_refuses_nonsense(name, value):
    with pytest.raises(StereoweaveError, match=re.escape(f"{value:g}")):
        StereoCamera(**CAMERA | {name: value})


@pytest.mark.usefixtures("without_shape_checks")
def test_a_pair_refuses_pictures_of_two_sizes():
    with pytest.raises(StereoweaveError, match=r"same size, got 40x32 and 41x32; crop"):
        StereoPair(left=np.zeros((32, 40, 3), np.uint8), right=np.zeros((32, 41, 3), np.uint8))


@pytest.mark.usefixtures("without_shape_checks")
@pytest.mark.parametrize("image", [np.zeros((32, 40, 3), np.float32), np.zeros((32, 40), np.uint8)])
def test_a_pair_refuses_images_that_are_not_8_bit_rgb(image):
    with pytest.raises(StereoweaveError, match="right image: expected uint8 RGB"):
        StereoPair(left=np.zeros((32, 40, 3), np.uint8), right=image)


def test_the_mirrored_pair_keeps_its_disparities(rng):
    left = rng.integers(0, 256, (32, 40, 3), dtype=np.uint8)
    right = np.roll(left, -5, axis=1)
    mirrored = StereoPair(left=left, right=right).mirror()
    np.testing.assert_array_equal(mirrored.right, np.roll(mirrored.left, -5, axis=1))
    np.testing.assert_array_equal(mirrored.left, right[:, ::-1])


def make_estimate(**changes):
    parts = {
        "disparity_px": np.zeros((4, 5), np.float32),
        "right_disparity_px": np.zeros((4, 5), np.float32),
        "confidence": np.zeros((4, 5), np.float32),
        "occluded": np.zeros((4, 5), bool),
    }
    return Estimate(**parts | changes)


def test_an_estimate_refuses_disparities_that_are_not_finite():
    disparity_px = np.zeros((4, 5), np.float32)
    disparity_px[1, :2] = np.nan, np.inf
    with pytest.raises(
        StereoweaveError, match="right_disparity_px: expected finite values, got 2 that are NaN"
    ):
        make_estimate(right_disparity_px=disparity_px)


@pytest.mark.usefixtures("without_shape_checks")
def test_an_estimate_refuses_maps_of_two_sizes():
    with pytest.raises(StereoweaveError, match="occluded: expected the shape of disparity_px"):
        make_estimate(occluded=np.zeros((4, 6), bool))
