import json
import math
from pathlib import Path

import numpy as np
import pytest

from stereoweave.cli.depth import measure
from stereoweave.errors import StereoweaveError
from stereoweave.learn.data.collage import paint_collage
from stereoweave.matching.matcher import Matcher
from stereoweave.outputs.measure import CameraError, Measurement, disparity_error_px, distance
from stereoweave.stereo import Estimate, StereoCamera

TEXTURED = Path(__file__).resolve().parents[1] / "textured_pair"
CAMERA = StereoCamera(focal_px=100.0, baseline_m=0.1, cx_px=30.0, cy_px=20.0)


def estimate_of(disparity_px, *, confidence=0.9, occluded=()) -> Estimate:
    hidden = np.zeros(disparity_px.shape, bool)
    for column, row in occluded:
        hidden[row, column] = True
    return Estimate(
        disparity_px=disparity_px.astype(np.float32),
        right_disparity_px=disparity_px.astype(np.float32),
        confidence=np.broadcast_to(np.float32(confidence), disparity_px.shape).copy(),
        occluded=hidden,
    )


def flat(disparity_px=5.0) -> np.ndarray:
    return np.full((40, 60), disparity_px)


def test_a_confidence_of_nine_in_ten_means_an_error_of_half_a_pixel():
    # 1 in 10 errors is at least 1 px, so 1 in 100 is at least 2 px, and 31.73 % are at least
    # ln(0.3173) / ln(0.1) px.
    assert disparity_error_px(0.9) == pytest.approx(0.49853, abs=1e-5)
    assert math.pow(0.1, 0.49853) == pytest.approx(0.3173, abs=1e-5)
    assert disparity_error_px(0.99) == pytest.approx(0.49853 / 2, abs=1e-5)
    assert 0.1 < disparity_error_px(1.0) < 0.2


def test_a_distance_across_the_picture():
    found = distance(estimate_of(flat()), CAMERA, (20, 20), (40, 20))
    # At 10 m * px / 5 px = 2 m, a pixel is 0.02 m wide.
    assert found.distance_m == pytest.approx(0.4)
    assert found.first_m == pytest.approx((-0.2, 0, 2))
    assert found.second_m == pytest.approx((0.2, 0, 2))
    # Each end moves along the line by 0.2 m / 5 px, for an error of 0.49853 px.
    assert found.uncertainty_m == pytest.approx(math.sqrt(2) * 0.04 * 0.49853, abs=1e-6)


def test_a_distance_along_the_axis_is_as_uncertain_as_its_far_end():
    disparity_px = flat()
    disparity_px[:, 30:] = 20
    found = distance(estimate_of(disparity_px), CAMERA, (29, 20), (30, 20))
    assert found.distance_m == pytest.approx(1.5, abs=1e-3)
    # Z^2 / (f B) * sigma_d: 4 / 10 and 0.25 / 10 m per px
    assert found.uncertainty_m == pytest.approx(math.hypot(0.4, 0.025) * 0.49853, rel=1e-3)


def test_depth_takes_doffs_into_account():
    camera = StereoCamera(focal_px=100.0, baseline_m=0.1, cx_px=30.0, cy_px=20.0, doffs_px=3.0)
    moved = distance(estimate_of(flat(2.0)), camera, (20, 20), (40, 20))
    assert moved == distance(estimate_of(flat()), CAMERA, (20, 20), (40, 20))


def test_the_camera_s_own_uncertainty_is_added_in_quadrature():
    disparity_px = flat()
    disparity_px[:, 30:] = 20
    sure = estimate_of(disparity_px)
    across, into = ((20, 10), (20, 30)), ((29, 20), (30, 20))
    for pixels, focal_share in ((across, 0.0), (into, 1.0)):
        exact = distance(sure, CAMERA, *pixels)
        found = distance(sure, CAMERA, *pixels, camera_error=CameraError(focal=0.3, baseline=0.4))
        # The full baseline error, and the part of the focal length error that is due to the depth difference.
        parts = exact.uncertainty_m, 0.4 * exact.distance_m, 0.3 * focal_share * exact.distance_m
        assert found.uncertainty_m == pytest.approx(math.hypot(*parts), rel=1e-3)


def test_a_focal_length_error_changes_the_distance_as_predicted():
    disparity_px = flat()
    disparity_px[:, 30:] = 8
    pixels = (10, 5), (50, 33)
    exact = distance(estimate_of(disparity_px), CAMERA, *pixels)
    other = StereoCamera(focal_px=100.1, baseline_m=0.1, cx_px=30.0, cy_px=20.0)
    moved_m = distance(estimate_of(disparity_px), other, *pixels).distance_m - exact.distance_m
    found = distance(estimate_of(disparity_px), CAMERA, *pixels, camera_error=CameraError(focal=0.001))
    assert math.sqrt(found.uncertainty_m**2 - exact.uncertainty_m**2) == pytest.approx(moved_m, rel=0.01)


@pytest.mark.parametrize(("pixel", "least", "most"), [((30, 20), 0.66, 0.71), ((10, 5), 0.61, 0.72)])
def test_68_percent_of_laplace_distributed_errors_are_below_the_uncertainty(rng, pixel, least, most):
    # One point is far, and its error dominates; or both points are alike, and their errors add up.
    truth_px = flat(50.0)
    truth_px[pixel[1] - 3 : pixel[1] + 4, pixel[0] - 3 : pixel[0] + 4] = 20 if pixel == (30, 20) else 50
    other = (50, 35)
    true_m = distance(estimate_of(truth_px), CAMERA, pixel, other).distance_m
    width_px = 1 / math.log(10)  # an error below 1 px then has a probability of 0.9
    held = []
    for first_px, second_px in rng.laplace(0, width_px, (1500, 2)):
        noisy_px = truth_px + second_px
        noisy_px[:25, :40] = truth_px[:25, :40] + first_px
        found = distance(estimate_of(noisy_px), CAMERA, pixel, other)
        held.append(abs(found.distance_m - true_m) < found.uncertainty_m)
    assert least < np.mean(held) < most


def test_the_network_s_measurements_are_as_certain_as_stated(rng):
    matcher, ratios = Matcher("small"), []
    height, width = 256, 384
    camera = StereoCamera(focal_px=550.0, baseline_m=0.1, cx_px=191.5, cy_px=127.5)
    for index in range(4):
        pair = paint_collage(7, 0, index, height, width)
        estimate, exact = matcher.estimate(pair.left, pair.right), pair.disparity_px
        certain = estimate_of(exact, confidence=1.0)
        known = np.argwhere((estimate.confidence >= 0.5) & ~estimate.occluded & (exact > 2))
        for (y1, x1), (y2, x2) in rng.choice(known, (100, 2)).tolist():
            found = distance(estimate, camera, (x1, y1), (x2, y2))
            true_m = distance(certain, camera, (x1, y1), (x2, y2)).distance_m
            ratios.append(abs(found.distance_m - true_m) / found.uncertainty_m)
    assert 0.62 < np.mean(np.array(ratios) < 1) < 0.85
    assert 0.88 < np.mean(np.array(ratios) < 2) < 0.98


def test_a_disparity_is_the_median_of_its_surface():
    disparity_px = flat()
    disparity_px[20, 20] = 5.9  # noise in one pixel
    disparity_px[:, 42:] = 50  # another surface, next to the second pixel
    disparity_px[19, 41] = 9  # not on this surface either
    found = distance(estimate_of(disparity_px), CAMERA, (20, 20), (41, 20))
    assert found.first_m[2] == found.second_m[2] == pytest.approx(2)


@pytest.mark.parametrize(
    ("first_px", "second_px", "message"),
    [
        ((20, 20), (60, 20), "expected a pixel of the left picture, from 0,0 to 59,39, found 60,20"),
        ((20, -1), (30, 20), "expected a pixel of the left picture, .*, found 20,-1"),
        ((20, 20), (20, 20), "two different pixels, found 20,20 twice"),
        ((5, 5), (20, 20), "pixel 5,5: .* only the left camera sees"),
        ((20, 20), (6, 6), "pixel 6,6: .* at least 50 %, found 49 %"),
        ((20, 20), (7, 30), "pixel 7,30: .* at infinity"),
    ],
)
def test_a_pixel_without_depth_is_a_one_line_error(first_px, second_px, message):
    disparity_px, confidence = flat(), np.full((40, 60), 0.9, np.float32)
    disparity_px[25:] = 0
    confidence[6, 6] = 0.49
    with pytest.raises(StereoweaveError, match=message) as error:
        distance(
            estimate_of(disparity_px, confidence=confidence, occluded=[(5, 5)]), CAMERA, first_px, second_px
        )
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("shares", [{"focal": -0.1}, {"baseline": math.nan}])
def test_an_uncertainty_is_not_negative(shares):
    with pytest.raises(StereoweaveError, match="at least 0"):
        CameraError(**shares)


@pytest.mark.parametrize(
    ("distance_m", "uncertainty_m", "words"),
    [
        (1.23412, 0.01234, "1.234 m ± 0.012 m (68 %)"),
        (12.34, 1.7, "12.3 m ± 1.7 m (68 %)"),
        (123.4, 45.2, "123 m ± 45 m (68 %)"),
        (2.0, 0.0, "2.000000 m ± 0.000000 m (68 %)"),
    ],
)
def test_a_measurement_is_formatted_with_its_significant_digits(distance_m, uncertainty_m, words):
    there = (0.0, 0.0, 1.0)
    found = Measurement(distance_m=distance_m, uncertainty_m=uncertainty_m, first_m=there, second_m=there)
    assert str(found) == words


def test_the_command_measures_between_two_pixels(capfd):
    pictures, calib = [TEXTURED / "left.png", TEXTURED / "right.png"], TEXTURED / "calib.txt"
    measure(pictures, "300,320", "420,300", calib=calib, model="small")
    line, *_ = capfd.readouterr().out.splitlines()
    measure(pictures, "300,320", "420,300", calib=calib, model="small", as_json=True)
    found = json.loads(capfd.readouterr().out)
    told_m, uncertainty_m = (float(words.split(" m")[0]) for words in line.split("±"))
    assert told_m == pytest.approx(found["distance_m"], abs=uncertainty_m)
    assert uncertainty_m == pytest.approx(found["uncertainty_m"], rel=0.05)
    assert line.endswith(" m (68 %)")
    assert np.linalg.norm(np.subtract(found["second_m"], found["first_m"])) == pytest.approx(
        found["distance_m"]
    )


@pytest.mark.parametrize(
    ("first", "options", "message"),
    [
        (
            "320",
            {"calib": TEXTURED / "calib.txt"},
            "--from: expected column and row of a pixel.* found '320'",
        ),
        ("40.5,30", {"calib": TEXTURED / "calib.txt"}, "--from: .* in whole numbers, found '40.5,30'"),
        ("1,2,3", {"calib": TEXTURED / "calib.txt"}, "--from: .* found '1,2,3'"),
        ("a,b", {"calib": TEXTURED / "calib.txt"}, "--from: .* found 'a,b'"),
        ("320,240", {}, r"give a calibration.*\(calibration, focal_px, baseline_m\)"),
        ("320,240", {"range_px": "9,3"}, "--range: .* found '9,3'"),
        ("320,240", {"range_px": "nan,3"}, "--range: .* found 'nan,3'"),
    ],
)
def test_wrong_measuring_options_are_reported_before_matching(first, options, message):
    pictures = [TEXTURED / "left.png", TEXTURED / "right.png"]
    with pytest.raises(StereoweaveError, match=message):
        measure(pictures, first, "420,300", model="none.onnx", **options)
