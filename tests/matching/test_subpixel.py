from dataclasses import replace

import cv2
import numpy as np
import pytest
from plain_subpixel import plain_change, plain_compare, plain_smooth

from stereoweave.matching.subpixel import to_subpixel
from stereoweave.matching.subpixel_kernels import change, compare, smooth
from stereoweave.stereo import Estimate

HEIGHT, WIDTH = 120, 200


def estimate_of(disparity_px, occluded=None):
    disparity_px = np.asarray(disparity_px, np.float32)
    return Estimate(
        disparity_px=disparity_px,
        right_disparity_px=disparity_px,
        confidence=np.ones_like(disparity_px),
        occluded=np.zeros(disparity_px.shape, bool) if occluded is None else occluded,
    )


def pair_with(disparity_px, texture):
    """Return a right image, and a left image that shows at x what the right one shows at x - disparity."""
    right = texture[:HEIGHT, :WIDTH]
    rows, columns = np.indices((HEIGHT, WIDTH), np.float32)
    left = cv2.remap(
        right, columns - disparity_px, rows, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT_101
    )
    return left, np.ascontiguousarray(right)


def ramp_px():
    """Return the disparity of a slanted floor: 6 px at the top, 12 px at the bottom."""
    rows = np.linspace(6, 12, HEIGHT, dtype=np.float32)
    return np.repeat(rows[:, None], WIDTH, axis=1)


def errors_px(found, truth_px):
    # The border is excluded, because the image is mirrored beyond it.
    return np.abs(found.disparity_px - truth_px)[8:-8, 20:-8]


@pytest.fixture
def texture(rng):
    return cv2.GaussianBlur(rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8), (0, 0), 1)


def test_disparity_off_by_noise_and_bias_is_brought_to_a_tenth_of_its_error(rng, texture):
    truth_px = ramp_px()
    left, right = pair_with(truth_px, texture)
    noise = cv2.GaussianBlur(rng.normal(size=truth_px.shape).astype(np.float32), (0, 0), 2)
    given = estimate_of(truth_px + 0.1 + 0.2 * noise / noise.std())
    found = to_subpixel(left, right, given)
    before, after = (np.median(errors_px(estimate, truth_px)) for estimate in (given, found))
    assert before > 0.12
    assert after < 0.02


def test_a_difference_in_exposure_shifts_nothing(texture):
    truth_px = ramp_px()
    left, right = pair_with(truth_px, texture)
    darker = np.rint(right * 0.6 + 20).astype(np.uint8)
    found = to_subpixel(left, darker, estimate_of(truth_px + 0.3))
    assert np.median(errors_px(found, truth_px)) < 0.03


def test_disparity_that_is_right_stays(texture):
    truth_px = ramp_px()
    left, right = pair_with(truth_px, texture)
    assert np.percentile(errors_px(to_subpixel(left, right, estimate_of(truth_px)), truth_px), 95) < 0.03


def test_no_disparity_moves_by_more_than_a_pixel(rng, texture):
    left, right = pair_with(ramp_px(), texture)
    given = estimate_of(ramp_px() + rng.uniform(-5, 5, (HEIGHT, WIDTH)).astype(np.float32))
    found = to_subpixel(left, right, given)
    assert np.abs(found.disparity_px - given.disparity_px).max() < 1 + 1e-5


def test_an_edge_between_two_depths_stays_where_it_is(texture):
    truth_px = np.full((HEIGHT, WIDTH), 5, np.float32)
    truth_px[:, 100:] = 15
    left, right = pair_with(truth_px, texture)
    found = to_subpixel(left, right, estimate_of(truth_px))
    np.testing.assert_allclose(found.disparity_px, truth_px, atol=1)
    assert np.median(errors_px(found, truth_px)) < 0.01


def test_plain_and_occluded_places_and_all_but_the_left_disparity_stay(rng, texture):
    truth_px = ramp_px()
    left, right = pair_with(truth_px, texture)
    occluded = np.zeros((HEIGHT, WIDTH), bool)
    occluded[40:80, 60:120] = True
    given = estimate_of(truth_px + 0.3, occluded)
    found = to_subpixel(left, right, given)
    np.testing.assert_array_equal(found.disparity_px[occluded], given.disparity_px[occluded])
    assert found.right_disparity_px is given.right_disparity_px
    assert found.confidence is given.confidence
    plain = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    flat = estimate_of(np.full((HEIGHT, WIDTH), 7.3))
    for estimate in (flat, replace(flat, occluded=np.ones((HEIGHT, WIDTH), bool))):
        np.testing.assert_allclose(to_subpixel(plain, plain, estimate).disparity_px, 7.3, atol=1e-5)


@pytest.mark.parametrize("threads", [2, 3])
def test_bands_of_rows_find_what_the_whole_picture_does(rng, threads):
    left, right = rng.integers(0, 256, (2, 230, 90, 3), dtype=np.uint8)
    given = estimate_of(cv2.GaussianBlur(rng.uniform(0, 30, (230, 90)).astype(np.float32), (0, 0), 2))
    whole = to_subpixel(left, right, given, threads=1)
    in_bands = to_subpixel(left, right, given, threads=threads)
    assert np.abs(whole.disparity_px - given.disparity_px).mean() > 0.05
    np.testing.assert_allclose(in_bands.disparity_px, whole.disparity_px, atol=1e-3)


@pytest.mark.parametrize(("height", "width"), [(HEIGHT - 1, WIDTH - 1), (HEIGHT - 1, WIDTH), (HEIGHT, 91)])
def test_odd_sizes_are_as_good_as_even_ones(texture, height, width):
    truth_px = ramp_px()
    left, right = (np.ascontiguousarray(image[:height, :width]) for image in pair_with(truth_px, texture))
    truth_px = truth_px[:height, :width]
    found = to_subpixel(left, right, estimate_of(truth_px + 0.3))
    assert found.disparity_px.shape == (height, width)
    assert np.median(errors_px(found, truth_px)) < 0.03


def test_a_steep_slant_is_no_edge(texture):
    truth_px = np.repeat(np.linspace(5, 29, HEIGHT, dtype=np.float32)[:, None], WIDTH, axis=1)
    left, right = pair_with(truth_px, texture)
    found = to_subpixel(left, right, estimate_of(truth_px + 0.2))
    assert np.median(np.abs(found.disparity_px - truth_px)[8:-8, 40:-8]) < 0.05


def test_no_threads_are_refused(texture):
    left, right = pair_with(ramp_px(), texture)
    with pytest.raises(ValueError, match="threads: expected a number from 1 to 1024, got 0"):
        to_subpixel(left, right, estimate_of(ramp_px()), threads=0)


def test_disparity_becomes_negative_only_if_the_input_is(texture):
    left, right = pair_with(np.full((HEIGHT, WIDTH), -0.4, np.float32), texture)
    given_px = np.full((HEIGHT, WIDTH), 0.1, np.float32)
    parallel = to_subpixel(left, right, estimate_of(given_px))
    assert parallel.disparity_px.min() == 0
    given_px[0, 0] = -2
    converged = to_subpixel(left, right, estimate_of(given_px))
    assert np.median(errors_px(converged, -0.4)) < 0.05


@pytest.mark.parametrize("shape", [(7, 1), (1, 9), (5, 3)], ids=["columns", "rows", "both"])
def test_the_smoothing_kernel_agrees_with_its_plain_reference(rng, shape):
    padded_px = np.cumsum(rng.normal(0, 0.4, (40, 50)), axis=1).astype(np.float32)
    nearness = rng.uniform(0.1, 1, shape).astype(np.float32)
    smooth_px = np.empty((40 - shape[0] + 1, 50 - shape[1] + 1), np.float32)
    smooth(padded_px, nearness, 0.6, smooth_px)
    expected_px = plain_smooth(padded_px.astype(float), nearness, 0.6)
    np.testing.assert_allclose(smooth_px, expected_px, atol=1e-4)


def test_the_comparing_kernel_agrees_with_its_plain_reference(rng):
    here, there = rng.integers(0, 256, (2, 20, 60), dtype=np.uint8)
    given_px = rng.uniform(-5, 70, (20, 60)).astype(np.float32)
    smooth_px = cv2.resize(given_px, (30, 10), interpolation=cv2.INTER_AREA)
    start_px, means = np.empty_like(given_px), np.empty((10, 4, 30), np.float32)
    compare(here, there, given_px, smooth_px, 6.0, 1.2, start_px, means)
    expected_px, expected = plain_compare(here, there, given_px, smooth_px, 6.0, 1.2)
    assert 0.05 < (expected_px != given_px).mean() < 0.95
    np.testing.assert_allclose(start_px, expected_px, atol=1e-4)
    np.testing.assert_allclose(means, expected, rtol=1e-3, atol=0.5)


def test_the_changing_kernel_agrees_with_its_plain_reference(rng):
    given_px, start_px = rng.uniform(0, 3, (2, 20, 60)).astype(np.float32)
    change_px = rng.uniform(-1, 1, (10, 30)).astype(np.float32)
    occluded = rng.integers(0, 2, (20, 60), dtype=np.uint8)
    found_px = np.full_like(given_px, -1)
    change(given_px, start_px, change_px, occluded, 0.5, 0.25, 4, 15, found_px)
    expected_px = plain_change(given_px, start_px, change_px, occluded, 0.5, 0.25)
    np.testing.assert_allclose(found_px[4:15], expected_px[4:15], atol=1e-5)
    assert (found_px[:4] == -1).all()
    assert (found_px[15:] == -1).all()
