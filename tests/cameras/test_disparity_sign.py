import cv2
import numpy as np
import pytest

from stereoweave.cameras.disparity_sign import estimate_depth_order, find_negative_disparities

NONE = np.zeros((0, 2)), np.zeros(0)


def textured(rng, width, blur_px=1.0):
    """Return a wall of noise without repetitions."""
    noise = cv2.GaussianBlur(rng.normal(0, 1, (240, width)).astype(np.float32), (0, 0), blur_px)
    return np.repeat(np.clip(128 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def apart(wall, disparity_px):
    """Return both views, 320 px wide, of a wall with a single disparity."""
    start = 40 + disparity_px
    return np.ascontiguousarray(wall[:, 40:360]), np.ascontiguousarray(wall[:, start : start + 320])


def places(columns, disparity_px):
    points = np.stack(np.meshgrid(columns, np.arange(20, 220, 20)), axis=-1).reshape(-1, 2).astype(float)
    return points, np.full(len(points), float(disparity_px))


def test_disparities_behind_the_plane_of_convergence_are_certain(rng):
    pair = apart(textured(rng, 400), -8)
    points, disparity_px = places(np.arange(20, 300, 40), -8)
    np.testing.assert_array_equal(find_negative_disparities(*pair, points, disparity_px), disparity_px)


@pytest.mark.parametrize("disparity_px", [-8, -4])
def test_plain_parts_behind_it_are_found_without_matches(rng, disparity_px):
    pair = apart(textured(rng, 400, blur_px=4), disparity_px)
    assert np.median(find_negative_disparities(*pair, *NONE)) == pytest.approx(disparity_px, abs=0.5)


def test_a_wall_at_a_positive_disparity_has_nothing_negative(rng):
    assert len(find_negative_disparities(*apart(textured(rng, 400, blur_px=4), 8), *NONE)) == 0


def test_matches_a_period_too_far_are_not_sure(rng):
    repeated = np.tile(textured(rng, 30), (1, 14, 1))
    pair = apart(repeated, 12)
    assert len(find_negative_disparities(*pair, *places(np.arange(60, 260, 20), 12 - 30))) == 0


def test_a_period_too_far_is_seen_from_the_other_picture_where_the_right_place_is_outside(rng):
    # The match of the left border is 12 px outside the right picture.
    repeated = np.tile(textured(rng, 30), (1, 14, 1))
    assert len(find_negative_disparities(*apart(repeated, 12), *places(np.arange(0, 10, 2), 12 - 30))) == 0


def test_a_near_card_before_a_wall_is_in_order_and_swapped_it_is_not(rng):
    left, right = apart(textured(rng, 400) // 2, 0)
    for photo, start in ((left, 160), (right, 140)):
        photo[60:180, start : start + 80] = 120 + textured(np.random.default_rng(1), 80)[60:180] // 2
    assert estimate_depth_order(left, right, (0, 20)) > 0.2
    assert estimate_depth_order(right, left, (-20, 0)) < -0.2
