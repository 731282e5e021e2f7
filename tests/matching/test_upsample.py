import cv2
import numpy as np
import pytest
from plain_enlarging import (
    plain_agreed,
    plain_costs,
    plain_filled,
    plain_pick,
    plain_sums,
)
from plain_refining import plain_census

from stereoweave.bench.metrics import bad_percent
from stereoweave.matching import upsample as enlarging
from stereoweave.matching import upsample_kernels as kernels
from stereoweave.matching.upsample import enlarge
from stereoweave.stereo import Estimate


def estimate_of(disparity_px, right_disparity_px, confidence=0.8):
    return Estimate(
        disparity_px=disparity_px.astype(np.float32),
        right_disparity_px=right_disparity_px.astype(np.float32),
        confidence=np.full(disparity_px.shape, confidence, np.float32),
        occluded=np.zeros(disparity_px.shape, bool),
    )


FAR_PX, NEAR_PX = 12, 30
BOARD = (slice(40, 80), slice(90, 150))  # in the right view; the left one sees it NEAR_PX farther right


@pytest.fixture
def scene(rng):
    """Return images and disparities of both views of a board in front of a wall, both of soft noise."""
    noise = rng.integers(0, 256, (2, 120, 260, 3), np.uint8)
    wall, board = (cv2.GaussianBlur(photo, (0, 0), 1.2) for photo in noise)
    left, right = wall[:, :240].copy(), wall[:, FAR_PX : FAR_PX + 240].copy()
    rows, columns = BOARD
    left_columns = slice(columns.start + NEAR_PX, columns.stop + NEAR_PX)
    left[rows, left_columns] = right[BOARD] = board[BOARD]
    left_px, right_px = (np.full((120, 240), FAR_PX, np.float32) for _ in range(2))
    left_px[rows, left_columns] = right_px[BOARD] = NEAR_PX
    return left, right, left_px, right_px


def smaller(disparity_px, times):
    """Return the disparity found in a copy that is `times` smaller, with blurred edges."""
    size = disparity_px.shape[1] // times, disparity_px.shape[0] // times
    return cv2.resize(disparity_px, size, interpolation=cv2.INTER_AREA) / times


def shifted_noise(rng, disparity_px, size=(96, 160)):
    """Return a pair of soft noise with the same disparity everywhere."""
    height, width = size
    noise = rng.integers(0, 256, (height, width + abs(disparity_px), 3), np.uint8)
    wide = cv2.GaussianBlur(noise, (0, 0), 1.2)
    return wide[:, :width] if disparity_px >= 0 else wide[:, -width:], (
        wide[:, disparity_px:] if disparity_px >= 0 else wide[:, :width]
    )


@pytest.mark.parametrize("times", [2, 3, 4.5])
def test_disparities_are_as_many_times_larger_as_the_picture(rng, times):
    left, right = shifted_noise(rng, 18)
    flat_px = np.full((round(96 / times), round(160 / times)), 18 / times)
    found = enlarge(left, right, estimate_of(flat_px, flat_px))
    inner = np.s_[8:-8, 40:-40]
    np.testing.assert_allclose(found.disparity_px[inner], 18, atol=0.6)
    assert abs(np.median(found.disparity_px[inner]) - 18) < 0.15
    assert abs(np.median(found.right_disparity_px[inner]) - 18) < 0.15


def test_disparities_behind_the_plane_of_convergence_are_enlarged_alike(rng):
    left, right = shifted_noise(rng, -18)
    flat_px = np.full((48, 80), -9.4)
    found = enlarge(left, right, estimate_of(flat_px, flat_px))
    assert abs(np.median(found.disparity_px) + 18) < 0.15


def test_parallel_cameras_get_no_negative_disparities():
    photo = np.full((96, 160, 3), 200, np.uint8)
    flat_px = np.zeros((48, 80))
    assert enlarge(photo, photo, estimate_of(flat_px, flat_px)).disparity_px.min() == 0


def test_errors_of_the_smaller_pair_are_corrected_and_edges_follow_the_images(scene):
    left, right, *true_px = scene
    left_px, right_px = (cv2.blur(smaller(px, 3), (3, 3)) + 0.5 for px in true_px)  # blurred, 1.5 px too near
    found = enlarge(left, right, estimate_of(left_px, right_px))
    plain_px = cv2.resize(left_px, (240, 120), interpolation=cv2.INTER_LINEAR) * 3
    seen = np.s_[:, 20:]
    assert bad_percent(plain_px[seen], true_px[0][seen], 1) > 95
    assert bad_percent(found.disparity_px[seen], true_px[0][seen], 1) < 2
    # The board's edge is within a pixel of its true position.
    found_board = found.disparity_px > (FAR_PX + NEAR_PX) / 2
    board = true_px[0] > (FAR_PX + NEAR_PX) / 2
    assert (found_board ^ board)[:, 20:].sum() < 2 * (40 + 60)


def test_blended_strips_equal_the_whole(scene, monkeypatch):
    left, right, *true_px = scene
    given = estimate_of(*(smaller(px, 4) for px in true_px))
    whole = enlarge(left, right, given)
    monkeypatch.setattr(enlarging, "_STRIP_BYTES", 0)
    monkeypatch.setattr(enlarging, "_SETTLED_ROWS", 37)
    in_strips = enlarge(left, right, given, threads=3)
    for name in ("disparity_px", "right_disparity_px", "confidence", "occluded"):
        np.testing.assert_array_equal(getattr(in_strips, name), getattr(whole, name))


def test_a_plain_picture_keeps_what_the_smaller_ones_showed():
    photo = np.full((96, 160, 3), 120, np.uint8)
    slant_px = np.linspace(4, 9, 80) * np.ones((48, 1))
    found = enlarge(photo, photo, estimate_of(slant_px, slant_px))
    expected_px = cv2.resize(slant_px, (160, 96), interpolation=cv2.INTER_LINEAR) * 2
    np.testing.assert_allclose(found.disparity_px, expected_px, atol=2)


def test_confidence_is_kept_where_the_images_confirm_it_and_lowered_elsewhere(rng):
    left, right = shifted_noise(rng, 18)
    found = enlarge(left, right, estimate_of(*[np.full((48, 80), 9.0)] * 2, confidence=0.8))
    inner = np.s_[8:-8, 40:-40]
    np.testing.assert_allclose(found.confidence[inner], 0.8, atol=1e-6)
    # The prior is off by 7 px: the images show another disparity, to which its confidence does not apply.
    found = enlarge(left, right, estimate_of(*[np.full((48, 80), 12.5)] * 2, confidence=0.8))
    assert np.median(found.confidence[inner]) == 0.5
    # Nothing in the images matches: the views agree only by chance.
    other = rng.integers(0, 256, left.shape, np.uint8)
    found = enlarge(left, other, estimate_of(*[np.full((48, 80), 9.0)] * 2, confidence=0.8))
    assert np.isclose(found.confidence[inner], 0.8 * 0.85).mean() > 0.2


def test_pixels_without_a_match_in_the_picture_are_occluded(rng):
    left, right = shifted_noise(rng, 18)
    flat_px = np.full((48, 80), 9.0)
    occluded = enlarge(left, right, estimate_of(flat_px, flat_px)).occluded
    assert occluded[:, :16].mean() > 0.95
    assert occluded[:, 20:].mean() < 0.01


def test_the_kernels_find_what_the_plain_loops_find(rng):
    shape, small = (41, 60), (20, 30)
    grey, other = rng.integers(0, 256, (2, *shape), np.uint8)
    smaller_px = np.full(small, 4.0, np.float32)
    smaller_px[5:15, 10:20] = 21.3
    smaller_px[8:12, 20:26] = -3.2
    view = enlarging._StripView(grey, other, smaller_px)
    first = view.first_candidates(slice(0, shape[0]))
    assert first.min() < -12 and first.max() > 30
    costs = plain_costs(plain_census(grey), grey, plain_census(other), other, first)
    expected_px = plain_pick(plain_sums(costs, first, grey), first)
    np.testing.assert_allclose(enlarging._match_view(view, 2, lambda pixels: None), expected_px, atol=1e-5)


def test_bands_are_around_the_surfaces_that_the_smaller_copy_shows_near_a_pixel():
    smaller_px = np.full((20, 30), 4.0, np.float32)
    smaller_px[:, 15:] = 20
    grey = np.zeros((40, 60), np.uint8)
    first = enlarging._StripView(grey, grey, smaller_px).first_candidates(slice(10, 11))[0]
    # Within two small pixels of the edge between columns 14 (28..29) and 15 (30..31), both surfaces count.
    np.testing.assert_array_equal(first[:26], [[0, 0]] * 26)
    np.testing.assert_array_equal(first[26:34], [[0, 32]] * 8)
    np.testing.assert_array_equal(first[34:], [[32, 32]] * 26)


def test_agreeing_and_filling_are_what_the_plain_loops_do(rng):
    found_px, other_px = (rng.integers(-2, 6, (30, 40)) + rng.random((2, 30, 40))).astype(np.float32)
    agreed = np.empty(found_px.shape, bool)
    kernels.agree(found_px, other_px, agreed)
    np.testing.assert_array_equal(agreed, plain_agreed(found_px, other_px))
    known, gap = rng.random((2, 30, 40)) < 0.3, rng.random((30, 40)) < 0.8
    known = known[0]
    known[3] = False  # a row without known pixels does not change
    farthest_px = rng.uniform(-12, 4, found_px.shape).astype(np.float32)
    nearest_px = farthest_px + 3
    expected_px = plain_filled(known, gap, farthest_px, nearest_px, found_px)
    kernels.fill(known, gap, farthest_px, nearest_px, found_px)
    np.testing.assert_array_equal(found_px, expected_px)


def test_pixels_behind_a_nearer_surface_get_the_background_disparity():
    known = np.array([[True, True, False, False, False, True, True]])
    gap = np.array([[False, False, True, True, False, False, False]])
    disparity_px = np.array([[3, 4, 7, 7, 7, 12, 12]], np.float32)
    around = np.full((1, 7), 4, np.float32), np.full((1, 7), 12, np.float32)
    kernels.fill(known, gap, *around, disparity_px)
    np.testing.assert_array_equal(disparity_px, [[3, 4, 4, 4, 7, 12, 12]])


def test_levels_are_halves_of_the_full_size_down_to_the_smaller_copy():
    assert enlarging._divisors(6000, 1800) == [2, 1]
    assert enlarging._divisors(6000, 1400) == [4, 2, 1]
    assert enlarging._divisors(2000, 1900) == [1]
    assert enlarging._divisors(2000, 1000) == [1]
