import numpy as np
import pytest

from stereoweave.learn.data.paint_kernels import REACH_PX
from stereoweave.learn.data.silhouettes import (
    SHAPES,
    Placement,
    cover_below,
    cover_canvas,
    draw_board,
    draw_pillar,
    draw_polygon,
    draw_post,
    draw_rods,
    soften,
)


@pytest.mark.parametrize("draw", [*SHAPES.values(), draw_rods, draw_board, draw_pillar])
def test_a_silhouette_stays_on_the_canvas_wherever_it_is_put(draw):
    rng = np.random.default_rng(0)
    for x, y, radius_px in [(50, 40, 20), (0, 0, 30), (99, 79, 5), (50, 40, 300), (-50, -50, 10)]:
        patch = draw(rng, Placement(x, y, radius_px, 100, 80))
        height, width = patch.field.shape
        assert 0 <= patch.left <= patch.left + width <= 100
        assert 0 <= patch.top <= patch.top + height <= 80
        assert patch.field.dtype == np.float32
        assert np.abs(patch.field).max(initial=0) <= REACH_PX


@pytest.mark.parametrize("draw", [*SHAPES.values(), draw_rods])
def test_a_silhouette_in_the_middle_of_the_canvas_is_visible_and_ends_within_its_patch(draw):
    for seed in range(10):
        patch = draw(np.random.default_rng(seed), Placement(100, 100, 40, 200, 200))
        assert (patch.field >= 0).sum() > 10
        border = [patch.field[0], patch.field[-1], patch.field[:, 0], patch.field[:, -1]]
        assert max(edge.max() for edge in border) < 0


def test_a_canvas_patch_covers_everything_and_a_floor_the_area_below_its_line():
    assert (cover_canvas(30, 20).field == REACH_PX).all()
    floor = cover_below(10, 0.5, 30, 20)
    # In column 4 the line is at row 12.
    assert floor.field[11:14, 4].tolist() == [-1, 0, 1]


def test_a_board_is_about_as_wide_as_its_placement_and_a_pillar_extends_from_border_to_border(rng):
    place = Placement(100, 90, 30, 200, 180)
    for _ in range(10):
        assert 0.35 * 60 * 60 < (draw_board(rng, place).field >= 0).sum() < 1.2 * 60 * 60
        inside = draw_pillar(rng, place).field >= 0
        assert (inside[0].any() and inside[-1].any()) or (inside[:, 0].any() and inside[:, -1].any())


def test_a_post_ends_at_its_foot_and_a_polygon_at_its_corners():
    # The post extends from row 10 to row 60, and 2 px to either side of column 50.
    patch = draw_post(Placement(50, 40, 30, 100, 80), 2.0, 60.0)
    rows, columns = np.nonzero(patch.field >= 0)
    assert (columns.min() + patch.left, columns.max() + patch.left) == (48, 52)
    assert (rows.min() + patch.top, rows.max() + patch.top) == (8, 62)
    square = draw_polygon(
        np.array([[9.5, 9.5], [20.5, 9.5], [20.5, 15.5], [9.5, 15.5]]), Placement(50, 40, 30, 100, 80)
    )
    assert (square.field >= 0).sum() == 11 * 6


def test_a_softened_patch_stays_opaque_inside_and_clear_outside():
    patch = soften(
        draw_polygon(np.array([[10, 10], [30, 10], [30, 30], [10, 30]], float), Placement(20, 20, 20, 40, 40))
    )
    coverage = np.clip(patch.field + 0.5, 0, 1)[20 - patch.top]
    # The left edge is at column 10: coverage is half there, full 2 px further in, and 0 2 px further out.
    assert coverage[np.array([7, 8, 9, 10, 11, 12, 13]) - patch.left].tolist() == [
        0,
        0,
        0.25,
        0.5,
        0.75,
        1,
        1,
    ]
