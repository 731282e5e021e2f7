from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from stereoweave.errors import StereoweaveError
from stereoweave.io.images import read_pair
from stereoweave.matching.estimate import match
from stereoweave.matching.matcher import Matcher
from stereoweave.matching.opencv_interface.stereo_matcher import StereoMatcher
from stereoweave.matching.options import MatchOptions

TEXTURED = Path(__file__).resolve().parents[2] / "textured_pair"
# calib.txt beside it: 600 px, centre 319.5, 239.5, baseline 0.1 m.
Q = np.array([[1, 0, 0, -319.5], [0, 1, 0, -239.5], [0, 0, 0, 600], [0, 0, 10, 0]], np.float32)


def photographs() -> tuple[np.ndarray, np.ndarray]:
    """Return the example pair in BGR, as users of OpenCV have it."""
    left, right = (cv2.imread(str(TEXTURED / name)) for name in ("left.png", "right.png"))
    assert left is not None
    assert right is not None
    return left, right


def moved_pair(by_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a BGR pair of 96x160 with a textured wall at a disparity of by_px."""
    coarse = np.random.default_rng(0).integers(0, 256, (24, 64, 3), dtype=np.uint8)
    wall = cv2.resize(coarse, (256, 96), interpolation=cv2.INTER_CUBIC)
    return wall[:, 48 : 48 + 160], wall[:, 48 + by_px : 48 + by_px + 160]


# As programs for StereoSGBM have them.
SETTINGS = {
    "minDisparity": 0,
    "numDisparities": 64,
    "blockSize": 5,
    "P1": 600,
    "P2": 2400,
    "disp12MaxDiff": 1,
    "uniquenessRatio": 10,
    "speckleWindowSize": 100,
    "speckleRange": 2,
    "mode": cv2.STEREO_SGBM_MODE_HH,
}


def points_of(matcher: cv2.StereoMatcher | StereoMatcher) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return disparity in px, points and the mask of valid pixels as programs for StereoSGBM do."""
    left, right = photographs()
    disparity = matcher.compute(left, right)
    assert disparity.dtype == np.int16
    disparity_px = disparity.astype(np.float32) / 16.0
    known = disparity_px > matcher.getMinDisparity() - 1
    return disparity_px, cv2.reprojectImageTo3D(disparity_px, Q), known


def test_a_program_for_sgbm_finds_the_same_points_through_it():
    theirs_px, their_points, known_to_them = points_of(cv2.StereoSGBM.create(**SETTINGS))
    ours_px, our_points, known_to_us = points_of(StereoMatcher.create(**SETTINGS))
    both = known_to_them & known_to_us
    assert both.mean() > 0.8
    assert np.mean(np.abs(theirs_px - ours_px)[both] < 1) > 0.97
    depths_m = [np.median(points[both][:, 2]) for points in (their_points, our_points)]
    assert abs(depths_m[0] - depths_m[1]) < 0.02 * depths_m[0]


def test_valid_pixels_are_the_estimate_times_16_and_others_are_marked():
    left, right = photographs()
    pair = read_pair(TEXTURED / "left.png", TEXTURED / "right.png")
    estimate = match(Matcher(), pair, MatchOptions(range_px=(0, 64)))
    disparity = StereoMatcher(0, 64, min_confidence=0.8).compute(left, right)
    known = ~estimate.occluded & (estimate.confidence >= 0.8)
    known &= (estimate.disparity_px >= 0) & (estimate.disparity_px <= 64)
    assert 0.05 < 1 - known.mean() < 0.5
    np.testing.assert_allclose(disparity[known] / 16, estimate.disparity_px[known], atol=1 / 32)
    assert (disparity[~known] == -16).all()


def test_a_wall_is_valid_within_the_range_and_invalid_beyond_it():
    left, right = moved_pair(12)
    matcher = StereoMatcher(minDisparity=0, numDisparities=32)
    disparity = matcher.compute(left, right)
    assert abs(np.median(disparity[:, 40:]) - 12 * 16) <= 4
    matcher.setNumDisparities(8)
    assert np.median(matcher.compute(left, right)) == -16


def test_converged_cameras_have_disparities_below_0_and_the_mark_below_those():
    left, right = moved_pair(-9)
    matcher = StereoMatcher(minDisparity=-16, numDisparities=48)
    disparity = matcher.compute(left, right)
    assert abs(np.median(disparity[:, 20:-20]) + 9 * 16) <= 4
    assert disparity.min() == -17 * 16


def test_a_range_beyond_the_pictures_width_is_named_by_its_own_parameters():
    with pytest.raises(StereoweaveError) as refused:
        StereoMatcher(minDisparity=500, numDisparities=192).compute(*moved_pair(12))
    assert str(refused.value) == (
        "minDisparity, numDisparities: expected disparities between -160 and 160 px, the width of the "
        "pictures, got 500 and 692"
    )


def test_grey_pictures_are_taken():
    left, right = (cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) for picture in moved_pair(12))
    disparity = StereoMatcher(0, 32).compute(left, right)
    assert abs(np.median(disparity[:, 40:]) - 12 * 16) <= 4


@pytest.mark.parametrize(("least", "count"), [(0, 0), (0, 2048), (2000, 48), (-2047, 1)])
def test_a_range_that_int16_does_not_hold_is_refused(least, count):
    with pytest.raises(StereoweaveError, match="from -2046 to 2047 px"):
        StereoMatcher(least, count)
    with pytest.raises(StereoweaveError, match=f"numDisparities {count}"):
        matcher = StereoMatcher(0, 1)
        matcher.setMinDisparity(least)
        matcher.setNumDisparities(count)


def test_a_confidence_in_percent_is_refused():
    with pytest.raises(StereoweaveError, match=r"^min_confidence: expected .* 0 to 1, found 50"):
        StereoMatcher(0, 64, min_confidence=50)


def test_the_widest_ranges_that_int16_holds_are_taken():
    assert StereoMatcher(-2046, 4093).getNumDisparities() == 4093


def test_parameters_of_opencv_s_algorithms_have_no_effect():
    left, right = moved_pair(12)
    matcher = StereoMatcher(0, 32)
    expected = matcher.compute(left, right)
    effective = {"MinDisparity", "NumDisparities", "SpeckleWindowSize", "SpeckleRange", "ROI1", "ROI2"}
    setters = {name[3:] for name in dir(matcher) if name.startswith("set")} - effective
    assert len(setters) == 11
    for name in setters:
        getattr(matcher, f"set{name}")(7)
    np.testing.assert_array_equal(matcher.compute(left, right), expected)


def test_speckles_are_removed_as_opencv_removes_them():
    left, right = photographs()
    matcher = StereoMatcher(0, 64)
    expected = matcher.compute(left, right)
    before = expected.copy()
    cv2.filterSpeckles(expected, -16, 200, 16)  # differences of at most 1 px within an area
    matcher.setSpeckleWindowSize(200)
    matcher.setSpeckleRange(1)
    np.testing.assert_array_equal(matcher.compute(left, right), expected)
    assert (expected != before).sum() > 100


def test_pixels_outside_the_regions_of_interest_are_invalid():
    left, right = moved_pair(12)
    matcher = StereoMatcher(0, 32, min_confidence=0)
    everywhere = matcher.compute(left, right) > -16
    matcher.setROI1((50, 10, 300, 40))  # beyond the image's right edge
    seen = matcher.compute(left, right) > -16
    assert not seen[:, :50].any()
    assert not seen[:10].any()
    assert not seen[50:].any()
    np.testing.assert_array_equal(seen[10:50, 50:], everywhere[10:50, 50:])
    matcher.setROI1((0, 0, 0, 0))
    matcher.setROI2((60, 0, 100, 96))
    # Column x is at x - 12 in the right image, so the first column with a match is 72.
    seen = matcher.compute(left, right) > -16
    assert not seen[:, :71].any()
    assert seen[:, 73:].mean() > 0.95


def test_the_result_is_written_to_the_output_argument():
    left, right = moved_pair(12)
    matcher = StereoMatcher(0, 32)
    expected = matcher.compute(left, right)
    given = np.zeros((96, 160), np.int16)
    assert matcher.compute(left, right, given) is given
    np.testing.assert_array_equal(given, expected)
    given[:] = 0
    assert matcher.compute(left=left, right=right, disparity=given) is given
    np.testing.assert_array_equal(given, expected)


@pytest.mark.parametrize("given", [np.zeros((95, 160), np.int16), np.zeros((96, 160), np.float32)])
def test_an_output_argument_of_another_kind_is_left_unchanged_as_by_opencv(given):
    left, right = moved_pair(12)
    theirs, ours = cv2.StereoSGBM.create(0, 32), StereoMatcher(0, 32)
    for matcher in (theirs, ours):
        result = matcher.compute(left, right, given)
        assert (result.shape, result.dtype) == ((96, 160), np.int16)
        assert not given.any()


@pytest.mark.usefixtures("without_shape_checks")
def test_an_output_argument_that_cannot_be_written_is_refused():
    locked = np.zeros((96, 160), np.int16)
    locked.flags.writeable = False
    for given, found in ((locked, r"int16 \[96, 160\]"), ([1, 2], r"\[1, 2\]")):
        with pytest.raises(StereoweaveError, match=rf"^disparity: expected a writable .*{found}"):
            StereoMatcher(0, 32).compute(*moved_pair(12), given)


def test_a_matcher_is_shown_by_its_range_and_model():
    assert repr(StereoMatcher(-8, 40)) == "StereoMatcher(minDisparity=-8, numDisparities=40, model='small')"


@pytest.mark.usefixtures("without_shape_checks")
@pytest.mark.parametrize(
    ("picture", "found"),
    [
        (Image.new("RGB", (64, 64)), "got Image"),
        (np.zeros((64, 64), np.float32), "got float32"),
        (None, "got None, which cv2.imread returns for a file that it cannot read; check the path"),
    ],
)
def test_pictures_that_cv2_would_not_return_are_refused(picture, found):
    with pytest.raises(StereoweaveError, match=found):
        StereoMatcher(0, 64).compute(picture, picture)
