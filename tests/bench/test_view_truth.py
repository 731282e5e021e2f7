import numpy as np
import pytest
from view_examples import BOX_PX, WALL_PX, boxes_before_a_wall

from stereoweave.bench.view_truth import fill_unknown, find_view_truth, land_disparities


def columns(mask):
    """Return the columns where a mask is True; all of its rows must be equal."""
    assert (mask == mask[0]).all()
    return mask[0].nonzero()[0].tolist()


def test_half_way_a_box_has_moved_by_half_its_disparity_and_its_flanks_are_seen_by_one():
    truth = find_view_truth(boxes_before_a_wall((20, 28)), 0.5)
    assert columns(truth.disparity_px == BOX_PX) == [*range(16, 24)]
    assert columns(truth.disparity_px == WALL_PX) == [*range(16), *range(24, 40)]
    # The left camera sees the wall up to the view's column 18 and from 27 on, the right one up to 12 and
    # from 21 on. The outermost columns of the view lie outside one of the two pictures.
    assert columns(truth.one_sees) == [0, 13, 14, 15, 24, 25, 26, 39]
    assert columns(truth.none_sees) == []


def test_neither_camera_sees_the_wall_behind_a_slit_between_two_boxes():
    # In the view, the boxes are at columns 6 to 11 and 14 to 19. Through the slit, the left camera sees the
    # wall at 15 and 16, and the right one at 9 and 10: behind the boxes.
    truth = find_view_truth(boxes_before_a_wall((10, 16), (18, 24)), 0.5)
    assert columns(truth.none_sees) == columns(np.isnan(truth.disparity_px)) == [12, 13]
    assert columns(truth.one_sees) == [0, 3, 4, 5, 20, 21, 22, 39]


@pytest.mark.parametrize("position", [0, 1])
def test_a_camera_sees_all_of_its_own_view(position):
    sample = boxes_before_a_wall((20, 28))
    truth = find_view_truth(sample, position)
    own_px = sample.right_disparity_px if position else sample.disparity_px
    np.testing.assert_array_equal(truth.disparity_px, own_px)
    alone = sample.right_occluded if position else sample.occluded
    np.testing.assert_array_equal(truth.one_sees, alone)
    assert not truth.none_sees.any()


def test_beyond_the_left_camera_the_right_one_sees_less():
    truth = find_view_truth(boxes_before_a_wall((20, 28)), -0.5)
    # The box is at columns 24 to 31. The part of the wall left of the box that the left camera sees lands on
    # 1 to 20; the part that the right one sees, on 3 to 14 and, from behind the box, on 23 and beyond.
    assert columns(truth.disparity_px == BOX_PX) == [*range(24, 32)]
    assert columns(truth.one_sees) == [1, 2, *range(15, 21), 23]
    assert columns(truth.none_sees) == [0, 21, 22]


def test_unknown_pixels_do_not_count_as_occluded():
    sample = boxes_before_a_wall((20, 28))
    sample.disparity_px[:, 4:8] = sample.right_disparity_px[:, 2:6] = np.nan
    truth = find_view_truth(sample, 0.5)
    # The unknown part of the wall would land on columns 3 to 6 from both photographs.
    assert columns(np.isnan(truth.disparity_px)) == [3, 4, 5, 6]
    assert columns(truth.none_sees) == []
    assert columns(truth.one_sees) == [0, 13, 14, 15, 24, 25, 26, 39]


def test_a_slanted_surface_lands_where_geometry_says_without_cracks():
    # Column x lands at 1.75 x, so that column u of the view shows 1.5 u / 1.75.
    disparity_px = np.tile(1.5 * np.arange(40), (2, 1)).astype(np.float32)
    expected_px = 1.5 / 1.75 * np.arange(40)
    # The disparity is that of a place up to half a column away, where it differs by half of 1.5 / 1.75.
    np.testing.assert_allclose(land_disparities(disparity_px, 0.5), np.tile(expected_px, (2, 1)), atol=0.43)


def test_unknown_pixels_land_nowhere():
    disparity_px = np.array([[4.0, np.nan, 4.0, 4.0, np.inf]], np.float32)
    np.testing.assert_array_equal(land_disparities(disparity_px, 0.25), [[np.nan, 4, np.nan, 4, 4]])


def test_unknown_pixels_are_filled_from_their_farther_side_even_if_that_is_the_sky():
    disparity_px = np.array([[np.nan, 0, np.nan, 5, np.nan, -3, np.nan]], np.float32)
    np.testing.assert_array_equal(fill_unknown(disparity_px), [[0, 0, 0, 5, -3, -3, -3]])
