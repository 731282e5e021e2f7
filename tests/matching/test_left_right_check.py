import numpy as np
import pytest
from plain_enlarging import plain_hidden

from stereoweave.matching.left_right_check import at_match, find_contradicted, find_occluded


@pytest.mark.parametrize("height", [30, 256, 700])
def test_the_check_equals_the_plain_loops_for_any_number_of_rows(rng, height):
    disparity_px, right_disparity_px = rng.uniform(-2, 7, (2, height, 40)).astype(np.float32)
    found = find_occluded(disparity_px, right_disparity_px)
    np.testing.assert_array_equal(found, plain_hidden(disparity_px, right_disparity_px))


def test_beyond_a_border_the_last_column_is_taken_and_the_match_is_outside():
    values = np.array([[10, 20, 30, 40]], np.float32)
    seen, inside = at_match(values, np.full((1, 4), 2, np.float32), -1)
    assert seen.tolist() == [[10, 10, 10, 20]]
    assert inside.tolist() == [[False, False, True, True]]
    seen, inside = at_match(values, np.full((1, 4), 2, np.float32), 1)
    assert seen.tolist() == [[30, 40, 40, 40]]
    assert inside.tolist() == [[True, True, False, False]]


def test_a_farther_match_contradicts_unless_a_surface_within_four_columns_is_as_near():
    left_px = np.full((1, 40), 8, np.float32)
    right_px = np.full((1, 40), 5, np.float32)
    right_px[0, 10] = 7  # up to 1 px farther is near enough
    expected = np.ones((1, 40), bool)
    expected[0, :8] = False  # the match is outside the right image
    expected[0, 14:23] = False  # the match is in columns 6 to 14
    np.testing.assert_array_equal(find_contradicted(left_px, right_px), expected)
