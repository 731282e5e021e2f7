import cv2
import numpy as np
import pytest

from stereoweave.matching.disparity_range import find_range, goes_beyond
from stereoweave.stereo import StereoPair

FAR_PX, NEAR_PX = 10, 30
EVERYWHERE = np.ones((240, 320), bool)


def soft_noise(rng, size):
    return cv2.GaussianBlur(rng.integers(0, 256, (*size, 3), np.uint8), (0, 0), 1.5)


def scene(rng, far_px=FAR_PX, near_px=NEAR_PX):
    """Return a pair of 320x240 px: a wall, and a board in front of it that covers a fifth of the picture."""
    wall, board = soft_noise(rng, (240, 640)), soft_noise(rng, (120, 120))
    left, right = wall[:, 160:480].copy(), wall[:, 160 + far_px : 480 + far_px].copy()
    left[60:180, 150:270] = board
    right[60:180, 150 - near_px : 270 - near_px] = board
    return StereoPair(left=left, right=right)


def cut(pair, by_px):
    """Return the pair with by_px fewer columns and disparities by_px lower."""
    left, right = (np.ascontiguousarray(photo) for photo in (pair.left[:, by_px:], pair.right[:, :-by_px]))
    return StereoPair(left=left, right=right)


def enlarged(pair, times):
    left, right = (
        cv2.resize(photo, None, fx=times, fy=times, interpolation=cv2.INTER_CUBIC)
        for photo in (pair.left, pair.right)
    )
    return StereoPair(left=left, right=right)


def test_the_range_is_that_of_the_scene_with_a_margin_for_nearer_surfaces(rng):
    low_px, high_px = find_range(scene(rng))
    assert abs(low_px - FAR_PX) < 1
    assert NEAR_PX + 1 <= high_px <= NEAR_PX + 6


@pytest.mark.parametrize("by_px", [8, 40])
def test_negative_disparities_are_found(rng, by_px):
    low_px, high_px = find_range(cut(scene(rng), by_px))
    assert abs(low_px - (FAR_PX - by_px)) < 1
    assert NEAR_PX - by_px + 1 <= high_px <= NEAR_PX - by_px + 6


@pytest.mark.parametrize("times", [3, 8])
def test_disparities_are_in_px_of_the_pictures_at_any_size(rng, times):
    low_px, high_px = find_range(enlarged(scene(rng), times))
    assert (FAR_PX - 1) * times <= low_px <= (FAR_PX + 0.3) * times
    assert (NEAR_PX + 1) * times <= high_px <= (NEAR_PX + 7) * times


def test_swapped_sides_have_negative_disparities(rng):
    pair = scene(rng)
    low_px, high_px = find_range(StereoPair(left=pair.right, right=pair.left))
    assert abs(low_px + NEAR_PX) < 1
    assert -FAR_PX + 1 <= high_px <= -FAR_PX + 6


@pytest.mark.parametrize("side", [np.s_[:, :1], np.s_[:, -1:]])
def test_the_border_of_the_picture_is_not_a_match(rng, side):
    pair = scene(rng)
    for photo in (pair.left, pair.right):
        photo[side] = 0
    low_px, _ = find_range(pair)
    assert abs(low_px - FAR_PX) < 1
    assert not goes_beyond(pair, EVERYWHERE, (FAR_PX - 1, NEAR_PX + 1))


def test_unrelated_and_plain_pictures_have_no_range(rng):
    left, right = soft_noise(rng, (240, 320)), soft_noise(rng, (240, 320))
    assert find_range(StereoPair(left=left, right=right)) is None
    plain = np.full((240, 320, 3), 90, np.uint8)
    assert find_range(StereoPair(left=plain, right=plain)) is None


def test_the_smallest_pair_raises_no_error(rng):
    left, right = (np.ascontiguousarray(photo[:32, :32]) for photo in (scene(rng).left, scene(rng).right))
    assert find_range(StereoPair(left=left, right=right)) is None


def test_disparities_beyond_a_range_are_detected_within_the_region(rng):
    pair = scene(rng)
    board = np.zeros((240, 320), bool)
    board[60:180, 150:270] = True
    assert not goes_beyond(pair, EVERYWHERE, (5, 35))
    assert goes_beyond(pair, EVERYWHERE, (5, 20))
    assert goes_beyond(pair, EVERYWHERE, (20, 35))
    assert goes_beyond(pair, board, (5, 20))
    assert not goes_beyond(pair, ~board, (5, 20))
    assert not goes_beyond(pair, ~EVERYWHERE, (5, 20))


def test_a_pixel_beyond_a_range_is_detected_but_rounding_is_not(rng):
    pair = scene(rng)
    assert goes_beyond(pair, EVERYWHERE, (FAR_PX + 1, 35))
    assert goes_beyond(pair, EVERYWHERE, (5, NEAR_PX - 1))
    assert not goes_beyond(pair, EVERYWHERE, (FAR_PX + 0.3, NEAR_PX - 0.3))


def test_pixels_without_content_have_no_matches(rng):
    """The mask of one of the pictures covers a second board, at 90 px."""
    pair, other = scene(rng), soft_noise(rng, (120, 60))
    left, right = pair.left.copy(), pair.right.copy()
    left[60:180, 90:150], right[60:180, 0:60] = other, other
    hidden = np.ones((240, 320), bool)
    hidden[58:182, 88:152] = False
    hidden_right = np.ones((240, 320), bool)
    hidden_right[58:182, :62] = False
    assert find_range(StereoPair(left=left, right=right))[1] > 90
    assert find_range(StereoPair(left=left, right=right, left_seen=hidden))[1] <= NEAR_PX + 6
    assert find_range(StereoPair(left=left, right=right, right_seen=hidden_right))[1] <= NEAR_PX + 6
