import cv2
import numpy as np
import pytest

from stereoweave.ranging import find_range, goes_beyond

FAR_PX, NEAR_PX = 10, 30
EVERYWHERE = np.ones((240, 320), bool)


def soft_noise(rng, size):
    return cv2.GaussianBlur(rng.integers(0, 256, (*size, 3), np.uint8), (0, 0), 1.5)


def scene(rng, far_px=FAR_PX, near_px=NEAR_PX):
    """A wall, and a board before it on a fifth of the picture, 320x240 px."""
    wall, board = soft_noise(rng, (240, 640)), soft_noise(rng, (120, 120))
    left, right = wall[:, 160:480].copy(), wall[:, 160 + far_px : 480 + far_px].copy()
    left[60:180, 150:270] = board
    right[60:180, 150 - near_px : 270 - near_px] = board
    return left, right


def cut(pair, by_px):
    """The pair with by_px columns less, its disparities by_px lower."""
    left, right = pair
    return left[:, by_px:], right[:, :-by_px]


def enlarged(pair, times):
    return [cv2.resize(photo, None, fx=times, fy=times, interpolation=cv2.INTER_CUBIC) for photo in pair]


def test_the_range_is_the_scenes_and_a_little_more(rng):
    low_px, high_px = find_range(*scene(rng))
    assert FAR_PX - 6 <= low_px <= FAR_PX - 1
    assert NEAR_PX + 1 <= high_px <= NEAR_PX + 6


@pytest.mark.parametrize("by_px", [8, 40])
def test_negative_disparities_are_found(rng, by_px):
    low_px, high_px = find_range(*cut(scene(rng), by_px))
    assert FAR_PX - by_px - 6 <= low_px <= FAR_PX - by_px - 1
    assert NEAR_PX - by_px + 1 <= high_px <= NEAR_PX - by_px + 6


@pytest.mark.parametrize("times", [3, 8])
def test_disparities_are_px_of_the_pictures_however_large_they_are(rng, times):
    low_px, high_px = find_range(*enlarged(scene(rng), times))
    assert (FAR_PX - 7) * times <= low_px <= (FAR_PX - 1) * times
    assert (NEAR_PX + 1) * times <= high_px <= (NEAR_PX + 7) * times


def test_swapped_sides_have_negative_disparities(rng):
    left, right = scene(rng)
    low_px, high_px = find_range(right, left)
    assert -NEAR_PX - 6 <= low_px <= -NEAR_PX - 1
    assert -FAR_PX + 1 <= high_px <= -FAR_PX + 6


def test_pictures_that_are_no_pair_or_plain_have_no_range(rng):
    assert find_range(soft_noise(rng, (240, 320)), soft_noise(rng, (240, 320))) is None
    plain = np.full((240, 320, 3), 90, np.uint8)
    assert find_range(plain, plain) is None
    assert find_range(plain[:32, :32], plain[:32, :32]) is None


def test_a_pair_of_the_least_size_has_a_range_or_none_but_no_error(rng):
    left, right = scene(rng)
    assert find_range(left[:32, :32], right[:32, :32]) is None


def test_what_is_beyond_a_range_is_noticed_where_one_looks(rng):
    left, right = scene(rng)
    board = np.zeros((240, 320), bool)
    board[60:180, 150:270] = True
    assert not goes_beyond(left, right, EVERYWHERE, (5, 35))
    assert goes_beyond(left, right, EVERYWHERE, (5, 20))
    assert goes_beyond(left, right, EVERYWHERE, (20, 35))
    assert goes_beyond(left, right, board, (5, 20))
    assert not goes_beyond(left, right, ~board, (5, 20))
    assert not goes_beyond(left, right, ~EVERYWHERE, (5, 20))
