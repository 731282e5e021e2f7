import math
import re

import numpy as np
import pytest

from stereoweave.errors import StereoweaveError
from stereoweave.stereo import Estimate, Sample, StereoCamera, StereoPair, View, assume_camera

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


def test_depth_of_half_floats_does_not_overflow():
    camera = StereoCamera(**CAMERA | {"focal_px": 1e6})
    depth_m = camera.depth_m(np.array([[1.0]], np.float16))
    np.testing.assert_array_equal(depth_m, [[1e5]])  # the greatest half float is 65504
    np.testing.assert_array_equal(camera.disparity_px(np.array([[1.0]], np.float16)), [[1e5]])


@pytest.mark.usefixtures("without_shape_checks")
def test_single_numbers_are_converted_like_arrays():
    camera = StereoCamera(**CAMERA, doffs_px=5.0)
    assert (camera.depth_m(45), camera.depth_m(-5.0)) == (2.0, np.inf)
    assert (camera.disparity_px(2.0), camera.disparity_px(0.0)) == (45.0, np.inf)


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
def test_an_image_with_the_channels_first_has_no_centre():
    image = np.zeros((3, 480, 640), np.uint8)
    with pytest.raises(
        StereoweaveError, match=r"^image: expected uint8 RGB \[H, W, 3\], got .* \[3, 480, 640\]"
    ):
        StereoCamera.centred(image, focal_px=1000.0, baseline_m=0.1)


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


def test_an_estimate_refuses_maps_of_no_pixels():
    nothing = np.zeros((0, 5), np.float32)
    with pytest.raises(StereoweaveError, match="^disparity_px: expected at least one pixel, found 5x0$"):
        make_estimate(
            disparity_px=nothing, right_disparity_px=nothing, confidence=nothing, occluded=nothing > 0
        )


@pytest.mark.parametrize(("shape", "size"), [((0, 40, 3), "40x0"), ((32, 0, 3), "0x32")])
def test_a_pair_refuses_images_of_no_pixels(shape, size):
    nothing = np.zeros(shape, np.uint8)
    with pytest.raises(StereoweaveError, match=f"^left image: expected at least one pixel, found {size}$"):
        StereoPair(left=nothing, right=nothing)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_an_estimate_holds_its_maps_as_float32(dtype):
    found = make_estimate(
        disparity_px=np.full((4, 5), 2.5, dtype),
        right_disparity_px=np.full((4, 5), 2.5, dtype),
        confidence=np.full((4, 5), 0.5, dtype),
    )
    maps = found.disparity_px, found.right_disparity_px, found.confidence
    assert {each.dtype for each in maps} == {np.dtype(np.float32)}
    assert [each.max() for each in maps] == [2.5, 2.5, 0.5]


def test_an_estimate_refuses_what_float32_cannot_hold():
    with pytest.raises(StereoweaveError, match="disparity_px: expected finite values, got 20 that"):
        make_estimate(disparity_px=np.full((4, 5), 1e300))


@pytest.mark.usefixtures("without_shape_checks")
def test_an_estimate_refuses_maps_of_two_sizes():
    with pytest.raises(StereoweaveError, match="occluded: expected the shape of disparity_px"):
        make_estimate(occluded=np.zeros((4, 6), bool))


def test_a_pair_is_shown_by_its_size_camera_and_share_of_content():
    image = np.zeros((480, 640, 3), np.uint8)
    seen = np.ones((480, 640), bool)
    seen[:, :64] = False
    assert repr(StereoPair(left=image, right=image)) == "StereoPair(640x480)"
    assert repr(StereoPair(left=image, right=image, camera=StereoCamera(**CAMERA), right_seen=seen)) == (
        "StereoPair(640x480, focal length 1000 px, baseline 0.1 m, 90.0 % of right with content)"
    )


def test_an_estimate_is_shown_by_its_size_range_confidence_and_occlusion():
    disparity_px = np.full((4, 5), 3.14, np.float32)
    disparity_px[2, 3] = -60.96
    occluded = np.zeros((4, 5), bool)
    occluded[0, :3] = True
    found = make_estimate(
        disparity_px=disparity_px, confidence=np.full((4, 5), 0.756, np.float32), occluded=occluded
    )
    assert repr(found) == "Estimate(5x4, disparity -61.0 to 3.1 px, mean confidence 0.76, 15.0 % occluded)"


def test_values_with_arrays_are_equal_to_themselves_alone():
    def make_values():
        image, px, mask = np.zeros((4, 5, 3), np.uint8), np.zeros((4, 5), np.float32), np.zeros((4, 5), bool)
        maps = {"disparity_px": px, "right_disparity_px": px, "occluded": mask}
        sample = Sample(left=image, right=image, **maps, right_occluded=mask)
        return [StereoPair(left=image, right=image), make_estimate(), View(image=image, drawn=mask), sample]

    values, others = make_values(), make_values()
    assert [value in others for value in values] == [False] * 4
    assert len({*values, *values, *others}) == 8


def test_a_view_is_shown_by_its_size_and_the_share_that_is_drawn():
    drawn = np.ones((8, 10), bool)
    drawn[0] = False
    assert repr(View(image=np.zeros((8, 10, 3), np.uint8), drawn=drawn)) == "View(10x8, 87.5 % drawn)"


def test_a_sample_is_shown_by_the_range_of_what_is_known():
    image, mask = np.zeros((2, 4, 3), np.uint8), np.zeros((2, 4), bool)
    disparity_px = np.array([[1, 2, 3, np.nan], [4, 5, np.nan, 7]], np.float32)

    def shown(truth_px):
        views = {"left": image, "right": image, "disparity_px": truth_px, "right_disparity_px": truth_px}
        return repr(Sample(**views, occluded=mask, right_occluded=mask, camera=None))

    assert shown(disparity_px) == "Sample(4x2, disparity 1.0 to 7.0 px, 75.0 % known, 0.0 % occluded)"
    assert shown(disparity_px * np.nan) == "Sample(4x2, disparity unknown, 0.0 % known, 0.0 % occluded)"


def test_the_camera_that_is_assumed_sees_53_degrees_about_its_centre():
    camera = assume_camera((640, 480))
    assert 2 * math.degrees(math.atan(640 / 2 / camera.focal_px)) == pytest.approx(53.13, abs=0.01)
    assert (camera.cx_px, camera.cy_px, camera.doffs_px) == (319.5, 239.5, 0)
