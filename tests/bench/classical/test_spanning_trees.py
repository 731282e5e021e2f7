import cv2
import numpy as np
import pytest
from plain_labels import plain_fronts, plain_search

from stereoweave.bench.classical import label_kernels as kernels
from stereoweave.bench.classical.costs import match_census_and_colour, see_from_right
from stereoweave.bench.classical.spanning_trees import find_planes, match_spanning_trees
from stereoweave.bench.classical.trees import Forest
from stereoweave.stereo import StereoPair


@pytest.fixture
def forest(rng):
    """Return random trees over 6x8 pixels, of 20, 1 and 27 places."""
    starts = np.array([0, 20, 21, 48])
    parents = np.full(48, -1, np.int32)
    for start, end in zip(starts[:-1], starts[1:], strict=True):
        for i in range(start + 1, end):
            parents[i] = rng.integers(start, i)
    similarity = np.where(parents < 0, 0, rng.uniform(0.2, 1, 48)).astype(np.float32)
    return Forest(rng.permutation(48).astype(np.int32), parents, similarity, starts)


@pytest.fixture
def costs(rng):
    return rng.integers(0, 109, (48, 12), dtype=np.uint8)


def label_whole(costs, forest):
    labels, least = np.empty((len(costs), 3), np.float32), np.empty(len(costs), np.float32)
    kernels.label_fronts(costs, *forest[1:], labels, least)
    return labels, least


def test_the_fast_whole_disparities_equal_the_plain_ones(forest, costs):
    labels, least = label_whole(costs, forest)
    expected, expected_least = plain_fronts(costs, *forest[1:])
    np.testing.assert_array_equal(labels[:, 2], expected)
    np.testing.assert_allclose(least, expected_least, rtol=1e-5)


def test_the_fast_search_equals_the_plain_one(forest, costs, rng):
    labels, least = label_whole(costs, forest)
    plain_labels, plain_least = labels.astype(float), least.astype(float)
    before = least.copy()
    places = np.stack(np.divmod(forest.order, 8), 1).astype(np.float32)
    at_pixel = np.argsort(forest.order).reshape(6, 8)
    draws = rng.random((3, 19, kernels.DRAWS))
    kernels.search_labels(costs, places, at_pixel, *forest[1:], draws, labels, least)
    plain_search(costs, places, at_pixel, forest, draws, plain_labels, plain_least)
    assert (least < before - 1).any()
    np.testing.assert_allclose(least, plain_least, rtol=1e-4)
    np.testing.assert_allclose(labels, plain_labels, atol=1e-3)


def test_the_right_view_s_costs_are_those_of_the_left_pixels_that_match():
    costs = np.arange(12, dtype=np.uint8).reshape(1, 4, 3)
    assert see_from_right(costs, 99).tolist() == [[[0, 4, 8], [3, 7, 11], [6, 10, 99], [9, 99, 99]]]


def slanted(rng, a, b, c):
    """Return a pair of smooth noise, and the disparity a * x + b * y + c of its left view."""
    rows, columns = np.indices((60, 100))
    disparity_px = a * columns + b * rows + c
    right = cv2.GaussianBlur(rng.integers(0, 256, (60, 100, 3)).astype(np.float32), (0, 0), 1.5)
    right = np.clip(2 * (right - 128) + 128, 0, 255)
    left = np.empty_like(right)
    for y, channel in np.ndindex(60, 3):
        left[y, :, channel] = np.interp(columns[y] - disparity_px[y], np.arange(100), right[y, :, channel])
    return StereoPair(left=left.astype(np.uint8), right=right.astype(np.uint8)), disparity_px


def test_3dmst_finds_the_plane_of_a_slanted_surface(rng):
    pair, disparity_px = slanted(rng, 0.3, 0.2, 4.0)
    rows, columns = np.indices((60, 100))
    planes = find_planes(pair.left, match_census_and_colour(pair), rng)[:, 50:]
    np.testing.assert_allclose(np.median(planes, (0, 1))[:2], (0.3, 0.2), atol=0.01)
    found_px = planes[..., 0] * columns[:, 50:] + planes[..., 1] * rows[:, 50:] + planes[..., 2]
    # The best whole disparities are off by 0.25 px or more.
    assert np.median(abs(found_px - disparity_px[:, 50:])) < 0.12


def test_3dmst_finds_a_plain_box_before_a_wall_up_to_its_edges(rng):
    wall = rng.integers(0, 90, (60, 120, 3), dtype=np.uint8)
    left, right = wall.copy(), wall.copy()
    left[:, 4:] = wall[:, :-4]
    box = rng.integers(160, 256, (30, 40, 3), dtype=np.uint8)
    left[15:45, 60:100] = right[15:45, 40:80] = box  # 20 px, and the wall 4 px
    found_px = match_spanning_trees(StereoPair(left=left, right=right))
    inside = np.zeros(found_px.shape, bool)
    inside[15:45, 60:100] = True
    assert (abs(found_px[inside] - 20) < 1).mean() > 0.98
    # The box hides the wall left of it from the right camera: columns 44 to 59 are holes.
    seen = ~inside
    seen[:, :8] = seen[15:45, 44:60] = False
    assert (abs(found_px[seen] - 4) < 1).mean() > 0.95
    assert (found_px[17:43, 46:58] == -1).mean() > 0.8


def test_other_matching_costs_take_the_place_of_census_and_colour():
    image = np.full((24, 32, 3), 90, np.uint8)
    costs = np.full((24, 32, 10), 50, np.uint8)
    costs[..., 6] = 0
    planes = find_planes(image, costs, np.random.default_rng(0))
    np.testing.assert_allclose(planes, np.broadcast_to([0, 0, 6], (24, 32, 3)), atol=1e-6)


def test_the_same_seed_gives_the_same_planes(rng):
    image = rng.integers(0, 256, (20, 30, 3), dtype=np.uint8)
    costs = rng.integers(0, 100, (20, 30, 16), dtype=np.uint8)
    one, again, other = (find_planes(image, costs, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert (one != other).any()
