"""Floating windows are as wide as the parallax of what a border cuts off; values worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest
from view_examples import BOX_PX, WALL_PX

from stereoweave.rendering.floating_windows import cut_windows, find_windows_px
from stereoweave.rendering.layouts import LAYOUTS, LayoutOptions
from stereoweave.rendering.renderer import Renderer
from stereoweave.stereo import Estimate, StereoPair

WIDTH, HEIGHT = 200, 50
WHITE = np.full((4, 20, 3), 200, np.uint8)


def estimate_with_box(columns: slice, *, rows: slice = slice(None), box_px: float = BOX_PX) -> Estimate:
    """Return the estimate of a box in these columns of both images, before a wall of 2 px."""
    px = np.full((HEIGHT, WIDTH), WALL_PX, np.float32)
    px[rows, columns] = box_px
    one = np.ones_like(px)
    return Estimate(disparity_px=px, right_disparity_px=px, confidence=one, occluded=px < 0)


def test_a_near_box_at_the_left_border_needs_a_bar_of_its_parallax():
    found = find_windows_px(estimate_with_box(slice(0, 30)), strength=1.0, convergence_px=0.0)
    # The wall is 2 px in front of the screen, too, at the right border.
    assert found == (BOX_PX, WALL_PX)


def test_a_near_box_at_the_right_border_needs_a_bar_there():
    estimate = estimate_with_box(slice(170, 200))
    assert find_windows_px(estimate, strength=1.0, convergence_px=2.0) == (0.0, BOX_PX - 2.0)


def test_half_the_strength_needs_half_the_bar():
    # The left eye is a quarter of the baseline to the right: the box moves by 2 px out of the picture.
    estimate = estimate_with_box(slice(0, 30))
    assert find_windows_px(estimate, strength=0.5, convergence_px=2.0) == (0.5 * (BOX_PX - 2.0), 0.0)


def test_what_the_border_does_not_cut_off_or_what_is_behind_the_screen_needs_none():
    inside = estimate_with_box(slice(20, 60))
    assert find_windows_px(inside, strength=1.0, convergence_px=2.0) == (0.0, 0.0)
    cut_off = estimate_with_box(slice(0, 30))
    assert find_windows_px(cut_off, strength=1.0, convergence_px=8.0) == (0.0, 0.0)


def test_a_convergence_moves_the_content_to_the_border():
    # At a convergence of 6 px, the left eye's view is 3 px to the left: the box from column 3 on is cut off.
    estimate = estimate_with_box(slice(3, 30))
    assert find_windows_px(estimate, strength=1.0, convergence_px=6.0) == (2.0, 0.0)
    far = estimate_with_box(slice(6, 30))
    assert find_windows_px(far, strength=1.0, convergence_px=6.0) == (0.0, 0.0)


@pytest.mark.parametrize(("rows", "bar_px"), [(1, 8.0), (0, 0.0)])
def test_a_fiftieth_of_the_rows_is_enough(rows, bar_px):
    estimate = estimate_with_box(slice(0, 30), rows=slice(0, rows))
    assert find_windows_px(estimate, strength=1.0, convergence_px=0.0)[0] == max(bar_px, WALL_PX)


def test_the_bar_is_no_wider_than_the_nearest_confident_surface():
    estimate = estimate_with_box(slice(170, 200))
    unsure = replace(
        estimate, confidence=np.where(estimate.disparity_px == BOX_PX, 0.2, 1).astype(np.float32)
    )
    assert find_windows_px(unsure, strength=1.0, convergence_px=0.0) == (WALL_PX, WALL_PX)


def test_a_wrong_estimate_blackens_at_most_6_percent():
    estimate = estimate_with_box(slice(0, 30), box_px=90.0)
    assert find_windows_px(estimate, strength=1.0, convergence_px=0.0)[0] == 12.0


def test_bars_are_black_at_the_outer_borders_and_grey_where_half_covered():
    left, right = cut_windows((WHITE, WHITE), (3.5, 2.0))
    assert left[0, :5, 0].tolist() == [0, 0, 0, 100, 200]
    assert right[0, -4:, 0].tolist() == [200, 200, 0, 0]
    assert left[:, 4:].min() == 200
    assert WHITE.min() == 200


def test_layouts_of_two_views_show_the_bars_in_their_places():
    px = np.zeros((4, 20), np.float32)
    estimate = Estimate(disparity_px=px, right_disparity_px=px, confidence=px, occluded=px > 0)
    renderer = Renderer(StereoPair(left=WHITE, right=WHITE), estimate, threads=1)
    options = LayoutOptions(windows_px=(2.0, 3.0))
    beside = LAYOUTS["side_by_side"].compose(renderer, options)[0, :, 0]
    assert np.flatnonzero(beside == 0).tolist() == [0, 1, 37, 38, 39]
    crossed = LAYOUTS["crossed"].compose(renderer, options)[0, :, 0]
    assert np.flatnonzero(crossed == 0).tolist() == [17, 18, 19, 20, 21]
    anaglyph = LAYOUTS["anaglyph_colour"].compose(renderer, options)[0]
    assert anaglyph[0].tolist() == [0, 200, 200]  # only the right eye sees it
    assert anaglyph[-1].tolist() == [200, 0, 0]
