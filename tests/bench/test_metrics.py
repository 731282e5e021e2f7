import math
import runpy

import numpy as np
import pytest

from stereoweave.bench import metrics
from stereoweave.errors import StereoweaveError
from stereoweave.io.images import read_image

TRUTH_PX = np.array([[10.0, 20.0, 100.0, 100.0], [np.nan, np.inf, 40.0, 40.0]])
ESTIMATE_PX = TRUTH_PX + np.array([[0.5, -1.0, 4.0, -6.0], [7.0, 7.0, 2.0, -2.5]])
ESTIMATE_PX[1, :2] = 3.0


def flat(level):
    return np.full((32, 40, 3), level, np.uint8)


def test_epe_is_the_mean_absolute_error_of_the_known_pixels():
    assert metrics.epe_px(ESTIMATE_PX, TRUTH_PX) == pytest.approx((0.5 + 1 + 4 + 6 + 2 + 2.5) / 6)


def test_a_pixel_is_bad_when_it_is_off_by_more_than_the_threshold():
    assert metrics.bad_percent(ESTIMATE_PX, TRUTH_PX, 1) == pytest.approx(100 * 4 / 6)
    assert metrics.bad_percent(ESTIMATE_PX, TRUTH_PX, 2) == pytest.approx(100 * 3 / 6)
    assert metrics.bad_percent(ESTIMATE_PX, TRUTH_PX, 0.5) == pytest.approx(100 * 5 / 6)


def test_d1_needs_both_thresholds():
    truth_px = np.array([[100.0, 10.0, 10.0, 10.0, 100.0, 60.0, 20.0, 50.0]])
    estimate_px = truth_px + np.array([[4.0, 4.0, 2.0, 0.0, -6.0, 3.0, -3.5, 2.6]])
    # In percent: 4, 40, 20, 0, 6, 5, 17.5, 5.2; bad are the second, the fifth and the seventh.
    assert metrics.d1_percent(estimate_px, truth_px) == 100 * 3 / 8


def test_depth_errors_are_in_metres_over_known_depths():
    truth_m = np.array([[1.0, 2.0, np.inf, np.nan]])
    assert metrics.depth_error_m(np.array([[1.1, 1.7, 5.0, 5.0]]), truth_m) == pytest.approx(0.2)
    assert metrics.depth_error_m(np.array([[np.inf, 2.0, 5.0, 5.0]]), truth_m) == np.inf


def test_a_mean_over_no_pixel_is_nan():
    unknown = np.full((2, 3), np.nan)
    estimate = np.ones((2, 3))
    assert math.isnan(metrics.epe_px(estimate, unknown))
    assert math.isnan(metrics.bad_percent(estimate, unknown, 1))
    assert math.isnan(metrics.d1_percent(estimate, unknown))
    assert math.isnan(metrics.depth_error_m(estimate, unknown))


def test_an_estimate_of_nan_is_bad():
    truth_px, estimate_px = np.array([[10.0, 20.0]]), np.array([[10.0, np.nan]])
    assert metrics.bad_percent(estimate_px, truth_px, 1) == 50
    assert metrics.d1_percent(estimate_px, truth_px) == 50
    assert math.isnan(metrics.epe_px(estimate_px, truth_px))


@pytest.mark.usefixtures("without_shape_checks")
def test_an_estimate_of_another_shape_is_refused():
    with pytest.raises(StereoweaveError, match=r"truth's shape \(2, 4\), found \(1, 4\)"):
        metrics.epe_px(ESTIMATE_PX[:1], TRUTH_PX)
    for score in (metrics.mae, metrics.psnr_db, metrics.ssim):
        with pytest.raises(StereoweaveError, match="shape"):
            score(flat(0)[:1], flat(0))


def test_mae_is_in_grey_levels():
    image = flat(100)
    image[:16] += 10
    image[16:, :, 0] -= 60
    assert metrics.mae(image, flat(100)) == pytest.approx(0.5 * 10 + 0.5 * 60 / 3)


def test_psnr_of_ten_levels_everywhere_is_28_db():
    assert metrics.psnr_db(flat(110), flat(100)) == pytest.approx(10 * math.log10(65025 / 100))


def test_psnr_of_equal_pictures_is_finite():
    assert metrics.psnr_db(flat(7), flat(7)) == pytest.approx(10 * math.log10(65025 / 1e-10))


def test_ssim_of_flat_pictures_is_that_of_their_levels():
    c1 = 2.55**2
    expected = (2 * 100 * 150 + c1) / (100**2 + 150**2 + c1)
    assert metrics.ssim(flat(100), flat(150)) == pytest.approx(expected, abs=1e-9)


def test_ssim_of_equal_pictures_is_one(rng):
    image = rng.integers(0, 256, (32, 40, 3), dtype=np.uint8)
    assert metrics.ssim(image, image) == pytest.approx(1, abs=1e-12)


def test_ssim_sees_luminance_alone_rounded_to_8_bits():
    green, grey = flat(0), flat(59)  # 0.587 * 100 = 58.7
    green[..., 1] = 100
    assert metrics.ssim(green, grey) == pytest.approx(1, abs=1e-12)


@pytest.mark.testdata
def test_disparity_scores_are_those_of_the_referee(testdata, rng):
    referee = runpy.run_path(str(testdata / "referee" / "score_pairs.py"))
    *_, truth_px, known = referee["read"](testdata / "stereo" / "pairs" / "motorcycle")
    estimate_px = (truth_px + rng.normal(0, 3, truth_px.shape)).astype(np.float32)
    expected = referee["score"](estimate_px, truth_px, known)
    truth_px[~known] = np.nan
    assert metrics.epe_px(estimate_px, truth_px) == pytest.approx(expected["epe"], abs=1e-6)
    assert metrics.bad_percent(estimate_px, truth_px, 1) == pytest.approx(expected["bad1"], abs=1e-6)
    assert metrics.bad_percent(estimate_px, truth_px, 2) == pytest.approx(expected["bad2"], abs=1e-6)
    assert metrics.d1_percent(estimate_px, truth_px) == pytest.approx(expected["d1"], abs=1e-6)


@pytest.mark.testdata
@pytest.mark.parametrize("scene", ["cones", "tsukuba", "venus"])
def test_picture_scores_are_those_of_the_referee(testdata, scene):
    referee = runpy.run_path(str(testdata / "referee" / "score_views.py"))
    folder = testdata / "stereo" / "views" / scene
    left, right = read_image(folder / "left.png"), read_image(folder / "right.png")
    np.testing.assert_array_equal(left, referee["read"](folder / "left.png"))
    assert metrics.psnr_db(left, right) == pytest.approx(referee["psnr"](left, right), abs=1e-6)
    assert metrics.ssim(left, right) == pytest.approx(referee["ssim"](left, right), abs=1e-6)


def test_calibration_error_is_the_mean_gap_between_probability_and_frequency():
    probability = np.array([0.95, 0.95, 0.95, 0.95, 0.05, 0.05])
    happened = np.array([True, True, True, False, False, False])
    # Four events of probability 0.95 happened 3 times in 4, two of 0.05 never: (4 * 0.20 + 2 * 0.05) / 6.
    assert metrics.calibration_error(probability, happened) == pytest.approx(0.15)


def test_the_calibration_error_of_no_value_is_nan():
    assert math.isnan(metrics.calibration_error(np.ones(0), np.ones(0, bool)))


def test_sparsification_is_the_mean_error_of_the_pixels_that_remain():
    error_px = np.array([1.0, 4.0, 2.0, 3.0])
    best = metrics.sparsification(error_px, np.array([0.9, 0.1, 0.6, 0.5]))
    worst = metrics.sparsification(error_px, np.array([-9.0, 3.0, 1.0, 2.0]))
    # Of four pixels the first is dropped at 25 %, the second at 50 % and the third at 75 %.
    times = [25, 25, 25, 21]
    np.testing.assert_allclose(best.kept, np.repeat([2.5, 2, 1.5, 1], times))
    np.testing.assert_allclose(worst.kept, np.repeat([2.5, 3, 3.5, 4], times))
    np.testing.assert_allclose(best.oracle, best.kept)
    np.testing.assert_allclose(worst.oracle, best.kept)
    assert best.ause == 0
    # The gap is 0, 1, 2 and 3 px; the trapezoids halve the first and the last.
    assert worst.ause == pytest.approx((25 * 1 + 25 * 2 + 21 * 3 - 1.5) / 100)


def test_pixels_of_equal_confidence_are_dropped_in_any_order():
    error_px = np.array([5.0, 0.0, 1.0, 0.0])
    curve = metrics.sparsification(error_px, np.array([-np.inf, 1.0, -np.inf, 2.0])).kept
    np.testing.assert_allclose(curve, np.repeat([1.5, 1, 0, 0], [25, 25, 25, 21]))
    np.testing.assert_allclose(metrics.sparsification(error_px, np.zeros(4)).kept, 1.5)


def test_the_curve_without_pixels_is_nan():
    nothing = metrics.sparsification(np.ones(0), np.ones(0))
    assert np.isnan(nothing.kept).all()
    assert math.isnan(nothing.ause)
