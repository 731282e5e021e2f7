import numpy as np
import pytest
from plain_moving import plain_lay

from stereoweave.rendering.background_kernels import uncover
from stereoweave.rendering.canvas_kernels import NOTHING, Canvas, empty_canvas
from stereoweave.rendering.hole_filling_kernels import paint_background
from stereoweave.rendering.renderer import Renderer
from stereoweave.stereo import Estimate, StereoPair

WALL_PX, OBJECT_PX = 2, 10
OBJECT = np.array([250, 30, 10], np.uint8)


def wall_with_object(wall):
    """Return a pair that shows the texture `wall` [H, 60, 3] at disparity 2 and an object at 10 before it."""
    left, right = wall.copy(), np.roll(wall, -WALL_PX, axis=1)
    maps = np.full((2, *wall.shape[:2]), WALL_PX, np.float32)
    left[:, 20:46], right[:, 10:36] = OBJECT, OBJECT
    maps[0, :, 20:46], maps[1, :, 10:36] = OBJECT_PX, OBJECT_PX
    return left, right, maps


def uncovered(photo, disparity_px, other_px, side):
    nearer_px = np.zeros_like(disparity_px)
    edge = np.abs(np.diff(disparity_px, axis=1)) > 1
    beside = np.pad(edge, ((0, 0), (0, 1))) | np.pad(edge, ((0, 0), (1, 0)))
    nearer_px[beside & (disparity_px == WALL_PX)] = OBJECT_PX - WALL_PX
    hidden_px, colours = np.empty_like(disparity_px), np.zeros_like(photo)
    uncover(photo, disparity_px, nearer_px, other_px, side, hidden_px, colours, 0, len(photo))
    return hidden_px, colours


def stripes(period, height=8):
    """Return vertical stripes one column wide, in `period` shades."""
    shades = np.tile(40 * np.arange(period, dtype=np.uint8), 60)[:60]
    return np.repeat(np.tile(shades, (height, 1))[..., None], 3, axis=2)


def test_the_wall_continues_behind_the_object_as_far_as_a_camera_one_baseline_away_sees():
    left, _, maps = wall_with_object(stripes(4))
    hidden_px, _ = uncovered(left, *maps, -1)
    # From the object's rim, 19, to 9 px behind its border. The right camera sees the columns from 38 on.
    expected = np.full((8, 60), NOTHING)
    expected[:, 19:29] = WALL_PX
    np.testing.assert_array_equal(hidden_px, expected)


def test_what_the_other_camera_sees_is_not_hidden():
    left, _, maps = wall_with_object(stripes(4))
    maps[1, :, 22 - WALL_PX] = WALL_PX  # the right camera looks through a slit
    hidden_px, _ = uncovered(left, *maps, -1)
    assert (hidden_px[:, 22] == NOTHING).all()
    assert (hidden_px[:, [21, 23]] == WALL_PX).all()


@pytest.mark.parametrize("period", [3, 4, 5])
def test_hidden_stripes_continue_in_phase(period):
    wall = stripes(period)
    left, _, maps = wall_with_object(wall)
    hidden_px, colours = uncovered(left, *maps, -1)
    hidden = hidden_px > NOTHING
    # The first row has no row above to continue.
    np.testing.assert_array_equal(colours[1:][hidden[1:]], wall[1:][hidden[1:]])


def test_rows_of_one_colour_continue(rng):
    wall = np.tile(rng.integers(0, 200, (8, 1, 3), dtype=np.uint8), (1, 60, 1))
    left, _, maps = wall_with_object(wall)
    hidden_px, colours = uncovered(left, *maps, -1)
    np.testing.assert_array_equal(colours[hidden_px > NOTHING], wall[hidden_px > NOTHING])


def test_hidden_colours_come_from_the_wall_and_never_from_the_object(rng):
    wall = rng.integers(0, 200, (12, 60, 3), dtype=np.uint8)
    left, right, maps = wall_with_object(wall)
    for photo, own, other, side in ((left, 0, 1, -1), (right, 1, 0, 1)):
        hidden_px, colours = uncovered(photo, maps[own], maps[other], side)
        seen = {tuple(colour) for colour in photo[maps[own] == WALL_PX]}
        assert (hidden_px > NOTHING).sum() == 120
        assert {tuple(colour) for colour in colours[hidden_px > NOTHING]} <= seen


def test_the_mirrored_right_image_gives_the_mirrored_result_of_the_left_one(rng):
    wall = rng.integers(0, 200, (9, 60, 3), dtype=np.uint8)
    left, _, maps = wall_with_object(wall)
    expected = uncovered(left, *maps, -1)[0]
    found = uncovered(*(np.ascontiguousarray(x[:, ::-1]) for x in (left, *maps)), 1)[0]
    np.testing.assert_array_equal(found[:, ::-1], expected)


def test_filled_background_is_the_same_in_all_views(rng):
    wall = rng.integers(0, 200, (9, 60, 3), dtype=np.uint8)
    left, right, maps = wall_with_object(wall)
    estimate = Estimate(
        disparity_px=maps[0],
        right_disparity_px=maps[1],
        confidence=np.ones_like(maps[0]),
        occluded=np.zeros(maps[0].shape, bool),
    )
    renderer = Renderer(StereoPair(left=left, right=right), estimate)
    near, far = renderer.view(-0.5), renderer.view(-1.0)
    # In the two views, the wall is at x + 1 and x + 2, and the object's border at 25 and 30.
    assert not near.drawn[:, 21:25].any()
    assert not far.drawn[:, 22:30].any()
    np.testing.assert_array_equal(near.image[:, 21:25], far.image[:, 22:26])


@pytest.mark.parametrize(("position", "first"), [(-0.5, 21), (1.5, 31)])
def test_in_a_view_from_beyond_a_camera_hidden_stripes_continue_in_phase(position, first):
    wall = stripes(4)
    left, right, maps = wall_with_object(wall)
    estimate = Estimate(
        disparity_px=maps[0],
        right_disparity_px=maps[1],
        confidence=np.ones_like(maps[0]),
        occluded=np.zeros(maps[0].shape, bool),
    )
    view = Renderer(StereoPair(left=left, right=right), estimate).view(position)
    # The object is at 25..50 or at 5..30; beside it is background that neither camera saw.
    hidden = np.s_[1:, first : first + 4]
    assert not view.drawn[hidden].any()
    expected = np.roll(wall, round(-WALL_PX * position), axis=1)
    np.testing.assert_array_equal(view.image[hidden], expected[hidden])


def test_an_image_without_depth_edges_hides_nothing():
    flat = np.full((4, 60), WALL_PX, np.float32)
    hidden_px, _ = uncovered(stripes(4, 4), flat, flat, -1)
    assert (hidden_px == NOTHING).all()


def random_hidden(rng, height=40, width=50):
    """Return bands of hidden background at several depths, their colours, and a canvas with gaps and rims."""
    bands = np.repeat(rng.choice([NOTHING, 1.0, 3.0, 9.0, 14.0], (height, width // 5)), 5, axis=1)
    hidden_px = np.where(bands > NOTHING, bands + rng.normal(0, 0.4, (height, width)), NOTHING)
    drawn_on = np.repeat(rng.random((height, width // 5)) < 0.6, 5, axis=1)
    canvas = Canvas(
        surface_px=np.where(drawn_on, rng.uniform(0, 20, (height, width)), NOTHING).astype(np.float32),
        image=rng.integers(0, 256, (height, width, 3), dtype=np.uint8),
        pure=drawn_on & (rng.random((height, width)) < 0.5),
        drawn=np.ones((height, width), bool),
    )
    return hidden_px.astype(np.float32), rng.integers(0, 256, (height, width, 3), dtype=np.uint8), canvas


@pytest.mark.parametrize("shift", [1.0, 0.4, -0.4, -1.0])
@pytest.mark.parametrize("offset_px", [0.0, -2.3])
def test_the_fast_painting_of_background_equals_the_plain_one(rng, shift, offset_px):
    hidden_px, colours, canvas = random_hidden(rng)
    expected = plain_lay(hidden_px, colours, shift, offset_px, canvas)
    paint_background(hidden_px, colours, shift, offset_px, canvas)
    np.testing.assert_array_equal(canvas.surface_px, expected.surface_px)
    np.testing.assert_array_equal(canvas.pure, expected.pure)
    np.testing.assert_array_equal(canvas.drawn, expected.drawn)
    np.testing.assert_array_equal(canvas.image, expected.image)


@pytest.mark.parametrize(("shift", "near_at", "far_at"), [(1.0, 12, 20), (-1.0, 30, 22)])
def test_hidden_background_is_painted_only_where_nothing_is_nearer(shift, near_at, far_at):
    # At disparity 10 and at 2, both land on column 22 from the left, or on 20 from the right.
    hidden_px, colours = np.full((1, 40), NOTHING), np.zeros((1, 40, 3), np.uint8)
    hidden_px[0, near_at], hidden_px[0, far_at] = 10, 2
    colours[0, near_at], colours[0, far_at] = 200, 100
    canvas = empty_canvas(np.zeros((1, 40, 3), np.uint8))
    paint_background(hidden_px, colours, shift, 0.0, canvas)
    (column,) = np.flatnonzero(canvas.pure[0])
    assert (canvas.surface_px[0, column], canvas.drawn[0, column]) == (10, False)
    assert (canvas.image[0, column] == 200).all()
