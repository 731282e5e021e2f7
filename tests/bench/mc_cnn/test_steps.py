"""The steps of MC-CNN's stereo method: worked examples, and fast kernels against plain references."""

from dataclasses import replace

import numpy as np
import pytest
from plain_mc_cnn import plain_aggregated, plain_costs, plain_paths, plain_replaced, plain_smoothed

from stereoweave.bench.mc_cnn import cross_kernels, outlier_kernels, refinement_kernels, volume_kernels
from stereoweave.bench.mc_cnn.steps import (
    AGGREGATED,
    FAST,
    DescribedView,
    aggregate,
    find_disparity,
    find_nearest_vectors,
    replace_outliers,
    smooth,
    sum_paths,
)

SIZE, CANDIDATES = (9, 12), 6
# Several steps between levels 0, 0.5 and 1 are strong gradients, several are not.
SETTINGS = replace(AGGREGATED, cross_intensity=0.7, cross_distance_px=4, small_penalty=0.3, large_penalty=1.1)


def levels(rng, size=SIZE):
    return rng.choice(np.array([0.0, 0.01, 0.5, 1.0], np.float32), size)


def random_costs(rng, height=SIZE[0]):
    """Return costs, and the same with infinity outside the right view, for the plain references."""
    costs = rng.random((height, SIZE[1], CANDIDATES), np.float32) - np.float32(0.5)
    outside = np.arange(CANDIDATES) > np.arange(SIZE[1])[:, None]
    costs[:, outside] = volume_kernels.OUTSIDE
    return costs, np.where(outside, np.inf, costs.astype(float))


def known(costs):
    """Return costs with infinity outside the right view."""
    return np.where(costs >= volume_kernels.OUTSIDE, np.inf, costs)


def unit_vectors(rng, height, width):
    vectors = rng.standard_normal((height, width, 16)).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=2, keepdims=True)


def views_at_7_px(rng):
    """Return two views of noise of a plane at a disparity of 7 px."""
    vectors, grey = unit_vectors(rng, 24, 67), rng.standard_normal((24, 67)).astype(np.float32)
    left = DescribedView(grey=grey[:, :60].copy(), vectors=vectors[:, :60].copy())
    return left, DescribedView(grey=grey[:, 7:].copy(), vectors=vectors[:, 7:].copy())


def test_the_costs_are_minus_the_dot_products_and_outside_the_right_view_the_highest(rng):
    left, right = unit_vectors(rng, *SIZE), unit_vectors(rng, *SIZE)
    costs = np.empty((*SIZE, CANDIDATES), np.float32)
    volume_kernels.compare(left, right, costs)
    np.testing.assert_allclose(known(costs), plain_costs(left, right, CANDIDATES), atol=1e-6)
    assert np.isinf(known(costs)).sum() == SIZE[0] * (5 + 4 + 3 + 2 + 1)


def test_of_equal_costs_the_first_is_picked():
    costs = np.array([[[3, 1000, 1000], [2, 1, 1000], [2, 1, 1]]], np.float32)
    disparity_px = np.empty((1, 3), np.int32)
    volume_kernels.pick(costs, disparity_px)
    assert disparity_px.tolist() == [[0, 1, 1]]


def test_an_arm_ends_before_a_step_of_the_levels_and_before_its_greatest_length():
    grey = np.array([[0, 0, 0, 0, 0, 9, 9]], np.float32)
    arms = np.empty((4, 1, 7), np.int32)
    cross_kernels.find_arms(grey, 3, 1.0, arms)
    # The neighbour always belongs to an arm, so the arm of column 4 reaches over the step.
    assert arms[0].tolist() == [[0, 1, 2, 2, 2, 1, 1]]
    assert arms[1].tolist() == [[2, 2, 2, 1, 1, 1, 0]]
    assert not arms[2:].any()


def test_costs_are_averaged_over_the_part_of_the_region_that_both_views_have():
    grey, split = np.zeros((1, 4), np.float32), np.array([[0, 0, 5, 5]], np.float32)
    costs = np.array([[[1], [2], [6], [8]]], np.float32)
    aggregate(costs, grey, split, replace(SETTINGS, cross_distance_px=4, cross_intensity=1.0), 1)
    # Reaches in the right view: column 0 to 1, 1 from 0 to 2, 2 from 1 to 3, 3 from 2.
    np.testing.assert_allclose(costs[0, :, 0], [1.5, 3, 16 / 3, 7])


def test_fast_aggregation_equals_the_plain_one(rng):
    left, right = levels(rng), levels(rng)
    costs, plain = random_costs(rng)
    aggregate(costs, left, right, SETTINGS, 2)
    for _ in range(2):
        plain = plain_aggregated(plain, left, right, SETTINGS.cross_distance_px, SETTINGS.cross_intensity)
    np.testing.assert_allclose(known(costs), plain, atol=1e-5)


def test_a_path_pays_for_each_change_of_the_disparity():
    grey = np.zeros((1, 3), np.float32)
    costs = np.array([[[0, 1000], [5, 0], [5, 0]]], np.float32)
    settings = replace(FAST, small_penalty=2.0, large_penalty=9.0, one_edge=1.0, two_edges=1.0)
    total = 4 * sum_paths(costs, grey, grey, settings)[0, 1]
    # From the left 5 and 0 + 2, from the right 5 + 2 and 0; from the top and the bottom 5 and 0 each.
    np.testing.assert_allclose(total, [5 + 7 + 5 + 5, 2 + 0 + 0 + 0])


def test_fast_paths_equal_the_plain_ones(rng):
    left, right = levels(rng), levels(rng)
    costs, plain = random_costs(rng)
    settings = replace(SETTINGS, one_edge=2.0, two_edges=5.0, vertical=1.5)
    totals = sum_paths(costs, left, right, settings)
    np.testing.assert_allclose(known(totals), plain_paths(plain, left, right, settings), atol=1e-5)


def test_an_occluded_pixel_takes_the_background_and_a_mismatched_one_the_median_around_it():
    left_px = np.array([[0, 1, 0, 2, 0, 0, 3, 0]], np.int32)
    right_px = np.array([[9, 2, 9, 9, 9, 9, 9, 0]], np.int32)
    labels = np.empty((1, 8), np.uint8)
    outlier_kernels.label(left_px, right_px, 4, labels)
    # Columns 3 and 7 agree; 1 px would agree within 1 px in column 2, and 3 px in column 4.
    assert labels.tolist() == [[1, 1, 2, 0, 2, 1, 1, 0]]
    # Column 4 sees 2 px to its left, straight and slanted, and 0 px to its right.
    assert replace_outliers(left_px, right_px, 4).tolist() == [[2, 2, 2, 2, 2, 2, 2, 0]]


def test_fast_replacement_equals_the_plain_one(rng):
    for size in (SIZE, (1, 1), (3, 40)):
        left_px = rng.integers(0, CANDIDATES, size, np.int32)
        left_px = np.minimum(left_px, np.arange(size[1], dtype=np.int32))
        right_px = rng.integers(0, 3 * CANDIDATES, size, np.int32)
        replaced_px = replace_outliers(left_px, right_px, CANDIDATES)
        np.testing.assert_array_equal(replaced_px, plain_replaced(left_px, right_px, CANDIDATES))


def test_the_minimum_of_a_parabola_is_found_to_a_fraction_of_a_pixel():
    costs = (np.arange(5, dtype=np.float32) - np.float32(2.3)) ** 2
    costs = np.tile(costs, (1, 6, 1))
    disparity_px = np.empty((1, 6), np.float32)
    refinement_kernels.fit_parabolas(costs, np.array([[0, 1, 2, 2, 3, 4]], np.int32), disparity_px)
    # Candidates 0 and 4, and those of columns 1 and 2, lack a neighbour; the minimum is 0.7 px from 3 px.
    np.testing.assert_allclose(disparity_px, [[0, 1, 2, 2.3, 2.3, 4]], atol=1e-6)


@pytest.mark.parametrize(("costs", "found_px"), [((0.0, 1.0, 2.5), 0.0), ((4.0, 5.0, 4.0), 1.0)])
def test_the_fraction_is_at_most_a_pixel_and_needs_a_minimum(costs, found_px):
    disparity_px = np.empty((1, 3), np.float32)
    costs = np.tile(np.float32(costs), (1, 3, 1))
    refinement_kernels.fit_parabolas(costs, np.array([[0, 0, 1]], np.int32), disparity_px)
    assert disparity_px[0, 2] == found_px


def test_smoothing_leaves_out_disparities_of_another_surface():
    disparity_px = np.array([[4.0, 4.5, 9.0, 9.0]], np.float32)
    smoothed_px = smooth(disparity_px, replace(FAST, blur_px=1.0, blur_step_px=2.0))
    beside = np.exp(-0.5)
    np.testing.assert_allclose(smoothed_px[0, 0], (4 + 4.5 * beside) / (1 + beside), rtol=1e-6)
    np.testing.assert_allclose(smoothed_px[0, 2:], 9)


def test_fast_smoothing_equals_the_plain_one(rng):
    disparity_px = (8 * rng.random(SIZE)).astype(np.float32)
    smoothed_px = smooth(disparity_px, replace(FAST, blur_px=1.5, blur_step_px=3.0))
    np.testing.assert_allclose(smoothed_px, plain_smoothed(disparity_px, 1.5, 3.0), rtol=1e-5)


@pytest.mark.parametrize("settings", [FAST, AGGREGATED])
def test_a_plane_is_found_also_where_the_right_view_ends(rng, settings):
    left, right = views_at_7_px(rng)
    nearest_px = find_nearest_vectors(left, right, 12)
    np.testing.assert_array_equal(nearest_px[:, 7:], 7)
    assert (nearest_px[:, :7] <= np.arange(7)).all()
    disparity_px = find_disparity(left, right, 12, settings)
    assert disparity_px.dtype == np.float32
    np.testing.assert_allclose(disparity_px[:, 20:], 7, atol=0.1)
    # What lies outside the right view takes the disparity beside it, but for the fraction.
    np.testing.assert_allclose(disparity_px, 7, atol=0.99)
