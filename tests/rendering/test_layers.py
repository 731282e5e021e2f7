"""The layers of a box before a wall, by hand."""

import numpy as np
import pytest

from stereoweave.rendering.layers import Layers, Reach, make_layers
from stereoweave.stereo import Estimate, StereoPair

HEIGHT, WIDTH = 100, 200
WALL_PX, BOX_PX = 6, 30
ROWS, COLUMNS = slice(30, 70), slice(90, 150)
# Away from the box's corners, which the layers round off.
INNER_ROWS, INNER_COLUMNS = slice(36, 64), slice(96, 120)
MARGIN_PX = (10, 4)


@pytest.fixture
def wall(rng) -> np.ndarray:
    """Return the wall as the left camera would see it, and 6 columns more, which the right camera sees."""
    return rng.integers(100, 256, (HEIGHT, WIDTH + WALL_PX, 3), dtype=np.uint8)


@pytest.fixture
def layers(wall) -> Layers:
    """Return the layers of a black box of disparity 30 before the wall of disparity 6."""
    left, right = wall[:, :WIDTH].copy(), wall[:, WALL_PX:].copy()
    left_px, right_px = (np.full((HEIGHT, WIDTH), WALL_PX, np.float32) for _ in range(2))
    left[ROWS, COLUMNS], left_px[ROWS, COLUMNS] = 0, BOX_PX
    moved = slice(COLUMNS.start - BOX_PX, COLUMNS.stop - BOX_PX)
    right[ROWS, moved], right_px[ROWS, moved] = 0, BOX_PX
    estimate = Estimate(
        disparity_px=left_px,
        right_disparity_px=right_px,
        confidence=np.ones_like(left_px),
        occluded=np.zeros(left_px.shape, bool),
    )
    reach = Reach(first=-0.1, last=1.1, up=0.2)
    return make_layers(StereoPair(left=left, right=right), estimate, reach, MARGIN_PX, threads=1)


def behind(layers: Layers, values: np.ndarray) -> np.ndarray:
    """Return values of the layer behind on the grid of the left image."""
    columns, rows = layers.margin_px
    return values[rows:-rows, columns:-columns]


def test_the_front_layer_is_the_left_image(layers, wall):
    assert (layers.front[ROWS, COLUMNS] == 0).all()
    np.testing.assert_array_equal(layers.front[:, :90], wall[:, :90])
    assert layers.front_px[50, 120] == BOX_PX


def test_behind_the_box_is_the_wall_that_the_right_camera_sees(layers, wall):
    # The right camera sees the wall from its column 120 on, which is column 126 of the left image. The pixel
    # beside the box may carry the box's colour.
    seen = INNER_ROWS, slice(127, 150)
    np.testing.assert_array_equal(behind(layers, layers.behind)[seen], wall[seen])
    assert (behind(layers, layers.behind_px)[seen] == WALL_PX).all()
    assert behind(layers, layers.drawn)[seen].all()


def test_where_neither_camera_sees_it_the_wall_goes_on_as_far_as_the_viewpoints_reach(layers):
    disparity_px, colours = (behind(layers, x) for x in (layers.behind_px, layers.behind))
    # 24 px apart: a viewpoint 0.1 left of the left camera uncovers 2.4 columns, one 0.2 above it 4.8 rows.
    for uncovered in (
        (INNER_ROWS, slice(90, 93)),
        (slice(30, 35), INNER_COLUMNS),
        (slice(65, 70), INNER_COLUMNS),
    ):
        np.testing.assert_allclose(disparity_px[uncovered], WALL_PX)
        assert colours[uncovered].min() >= 100
        assert not behind(layers, layers.drawn)[uncovered].any()
    assert disparity_px[50, 108] == BOX_PX  # no viewpoint sees behind it


def test_beyond_the_right_border_is_what_the_right_camera_sees(layers, wall):
    columns, rows = layers.margin_px
    beyond = layers.behind[rows:-rows, columns + WIDTH : columns + WIDTH + WALL_PX]
    np.testing.assert_array_equal(beyond, wall[:, WIDTH:])
    assert (layers.behind_px[:, columns + WIDTH :] == WALL_PX).all()


def test_margins_have_colours_and_disparities_everywhere(layers):
    assert layers.behind.shape == (HEIGHT + 8, WIDTH + 20, 3)
    assert layers.behind_px.shape == (HEIGHT + 8, WIDTH + 20)
    assert layers.behind[:, :10].min() >= 100
    assert layers.behind_px.min() == pytest.approx(WALL_PX)
