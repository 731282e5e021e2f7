from dataclasses import replace

import numpy as np
import pytest
from plain_moving import plain_move

from stereoweave.rendering.camera_motion_kernels import move
from stereoweave.rendering.canvas_kernels import Canvas, empty_canvas
from stereoweave.rendering.renderer import Renderer, render
from stereoweave.stereo import Estimate, StereoCamera, StereoPair


def estimate_of(disparity_px, right_disparity_px):
    return Estimate(
        disparity_px=np.ascontiguousarray(disparity_px, np.float32),
        right_disparity_px=np.ascontiguousarray(right_disparity_px, np.float32),
        confidence=np.ones(disparity_px.shape, np.float32),
        occluded=np.zeros(disparity_px.shape, bool),
    )


def flat(rng, disparity_px, camera=None, height=60, width=90):
    """Return a renderer of a wall of soft noise at one disparity; the right image is the left one shifted."""
    coarse = rng.integers(0, 256, (height // 6, width // 6, 3)).astype(np.float32)
    left = np.repeat(np.repeat(coarse, 6, axis=0), 6, axis=1).astype(np.uint8)
    right = np.roll(left, -disparity_px, axis=1)
    map_px = np.full((height, width), disparity_px)
    return Renderer(StereoPair(left=left, right=right, camera=camera), estimate_of(map_px, map_px))


def test_from_above_every_pixel_moves_down_by_its_disparity(rng):
    renderer = flat(rng, 8)
    level, above = renderer.view(0.5), renderer.view(0.5, up=0.5)
    np.testing.assert_array_equal(above.image[4:], level.image[:-4])
    assert not above.drawn[:4].any()
    np.testing.assert_array_equal(above.drawn[4:], level.drawn[:-4])


def test_from_below_near_surfaces_cover_far_ones(rng):
    height, width = 40, 60
    left, right = np.full((2, height, width, 3), 50, np.uint8)
    maps = np.full((2, height, width), 2.0)
    left[15:25, 30:40], right[15:25, 20:30] = 200, 200
    maps[0, 15:25, 30:40], maps[1, 15:25, 20:30] = 10, 10
    view = Renderer(StereoPair(left=left, right=right), estimate_of(*maps)).view(0.5, up=-1.0)
    # The object, at columns 25..34 of the level view, rises by 10 rows, and the wall by 2.
    expected = np.full((height, width), 50)
    expected[5:15, 25:35] = 200
    np.testing.assert_array_equal(view.image[..., 0], expected)
    # The 8 rows of wall that were hidden below row 25 continue from the object's lower border.
    invented = ~view.drawn
    assert invented[15:23, 26:34].all()
    assert not invented[5:15].any()


def test_forward_everything_grows_about_the_centre_by_its_depth():
    # The depth is 80 / 8 = 10 baselines; one baseline nearer, everything is 10 / 9 times as large.
    camera = StereoCamera(focal_px=80.0, baseline_m=0.1, cx_px=45.0, cy_px=30.0)
    columns, rows = np.meshgrid(np.arange(90), np.arange(60))
    left = np.stack([2 * columns, 3 * rows, columns + rows], axis=2).astype(np.uint8)
    pair = StereoPair(left=left, right=np.roll(left, -8, axis=1), camera=camera)
    view = Renderer(pair, estimate_of(*np.full((2, 60, 90), 8.0))).view(0.0, forward=1.0)
    x, y = 45 + (columns - 45) * 0.9, 30 + (rows - 30) * 0.9
    expected = np.stack([2 * x, 3 * y, x + y], axis=2)
    assert np.abs(view.image - expected)[2:-2, 2:-2].max() <= 1
    assert view.drawn.all()


def test_moving_backward_undoes_moving_forward_where_both_views_are_valid():
    # From 10 baselines to 11, where the disparity is 80 / 11, and back to 10.
    camera = StereoCamera(focal_px=80.0, baseline_m=0.1, cx_px=45.0, cy_px=30.0)
    columns, rows = np.meshgrid(np.arange(90), np.arange(60))
    left = np.stack([2 * columns, 3 * rows, columns + rows], axis=2).astype(np.uint8)
    near = Renderer(
        StereoPair(left=left, right=np.roll(left, -8, axis=1), camera=camera),
        estimate_of(*np.full((2, 60, 90), 8.0)),
    )
    far_left, far_right = (near.view(position, forward=-1.0) for position in (0.0, 1.0))
    # At 10 / 11 of the size, 60 rows fill 54.5 rows of the image.
    assert far_left.drawn[:, 45].sum() == pytest.approx(60 * 10 / 11, abs=1)
    far = Renderer(
        StereoPair(left=far_left.image, right=far_right.image, camera=camera),
        estimate_of(*np.full((2, 60, 90), 80 / 11)),
    )
    again = far.view(0.0, forward=1.0)
    # Each of the two views rounds to whole levels.
    assert np.abs(again.image.astype(int) - left)[2:-2, 2:-2].max() <= 2


def test_an_offset_between_the_principal_points_counts_as_depth(rng):
    camera = StereoCamera(focal_px=80.0, baseline_m=0.1, cx_px=45.0, cy_px=30.0, doffs_px=4.0)
    level, above = (flat(np.random.default_rng(1), 8, camera).view(0.5, up=up) for up in (0.0, 0.5))
    # The depth is 80 / (8 + 4) baselines: half a baseline moves the wall by 6 rows.
    np.testing.assert_array_equal(above.image[6:], level.image[:-6])


def test_without_a_camera_the_focal_length_is_the_width_and_the_principal_point_central():
    camera = StereoCamera(focal_px=90.0, baseline_m=1.0, cx_px=44.5, cy_px=29.5)
    assumed, known = (flat(np.random.default_rng(1), 8, given) for given in (None, camera))
    view, expected = (renderer.view(0.5, up=0.25, forward=0.5) for renderer in (assumed, known))
    np.testing.assert_array_equal(view.image, expected.image)
    np.testing.assert_array_equal(view.drawn, expected.drawn)


def test_an_estimates_pair_is_rendered_with_its_camera(rng):
    camera = StereoCamera(focal_px=80.0, baseline_m=0.1, cx_px=45.0, cy_px=30.0, doffs_px=4.0)
    renderer = flat(rng, 8, camera)
    found = replace(renderer.estimate, pair=renderer.pair)
    view = render(renderer.pair.left, renderer.pair.right, found, 0.5, up=0.5)
    np.testing.assert_array_equal(view.image, renderer.view(0.5, up=0.5).image)


def test_without_a_camera_the_farthest_surface_of_a_converged_pair_is_infinitely_far(rng):
    renderer = flat(rng, -8)
    level, above = renderer.view(0.5), renderer.view(0.5, up=0.5)
    np.testing.assert_array_equal(above.image, level.image)


def test_convergence_only_shifts_a_view_from_above_and_in_front_sideways(rng):
    straight = flat(rng, 8)
    converged = Renderer(straight.pair, straight.estimate, convergence_px=8.0)
    # The shift to the right is (0.25 - 0.5) * 8 px.
    view, expected = (renderer.view(0.25, up=0.5, forward=0.5) for renderer in (converged, straight))
    apart = np.abs(view.image[:, 4:80].astype(int) - expected.image[:, 6:82])
    assert apart.max() <= 1


@pytest.mark.parametrize(("name", "value"), [("up", 1.1), ("forward", -1.1), ("up", float("nan"))])
def test_a_move_out_of_range_is_refused(rng, name, value):
    with pytest.raises(ValueError, match=rf"^{name}: expected -1 to 1 baselines, got {value}$"):
        flat(rng, 8).view(0.5, **{name: value})


@pytest.mark.parametrize("rows", [slice(None), slice(None, None, -1)])
def test_a_camera_moved_up_and_forward_keeps_the_order_of_depth(rows):
    # Upside down and seen from below, the near box is drawn after the other one instead of before it.
    camera = StereoCamera(focal_px=100.0, baseline_m=0.1, cx_px=45.0, cy_px=29.5)
    photos, maps = np.full((2, 60, 90, 3), 50, np.uint8), np.zeros((2, 60, 90))
    for side in (0, 1):
        for level, disparity_px, top in ((200, 20, 10), (120, 10, 20)):
            columns = slice(37 - side * disparity_px, 53 - side * disparity_px)
            photos[side, top : top + 10, columns], maps[side, top : top + 10, columns] = level, disparity_px
    left, right = (np.ascontiguousarray(photo[rows]) for photo in photos)
    renderer = Renderer(StereoPair(left=left, right=right, camera=camera), estimate_of(*maps[:, rows]))
    up = 0.6 if rows.step is None else -0.6
    image = renderer.view(0.0, up=up, forward=1.0).image[rows, :, 0]
    # The near box grows by 5 / 4 and falls by 0.6 * 25 to rows 20 to 31; the other one by 10 / 9 and
    # 0.6 * 100 / 9 to rows 26 to 36.
    assert (image[20:32, 35:55] == 200).all()
    assert (image[32:37, 36:54] == 120).all()
    assert (image == 200).sum() == 12 * 20


def random_move(rng, rate):
    """Return a view of noise with slants and jumps, and its pixels' disparities and targets, with folds."""
    height, width = 30, 50
    jumps = rng.choice([0.0, 8.0, -6.0, 12.0], (height, width), p=[0.85, 0.05, 0.05, 0.05])
    surface_px = np.cumsum(jumps + rng.normal(0, 0.8, (height, width)), axis=1).astype(np.float32)
    view = Canvas(
        surface_px=surface_px,
        image=rng.integers(0, 256, (height, width, 3), dtype=np.uint8),
        pure=np.ones((height, width), bool),
        drawn=rng.random((height, width)) < 0.8,
    )
    columns = (np.arange(width) - width / 2) * rate + width / 2
    targets = columns + 0.3 * surface_px + rng.normal(0, 0.7, (height, width))
    disparity_px = surface_px + rng.normal(0, 1, (height, width))
    return view, targets.astype(np.float32), disparity_px.astype(np.float32)


@pytest.mark.parametrize("rate", [0.6, 1.0, 2.7])
@pytest.mark.parametrize("halves", [False, True])
def test_the_fast_move_equals_the_plain_one(rng, rate, halves):
    view, targets, disparity_px = random_move(rng, rate)
    if halves:  # pixel borders fall on the centres of other pixels
        targets = np.rint(2 * targets) / 2
    canvas = empty_canvas(255 - view.image)
    expected = plain_move(view, targets, disparity_px, canvas)
    move(view.image, view.surface_px, view.drawn, targets, disparity_px, canvas)
    np.testing.assert_array_equal(canvas.pure, expected.pure)
    np.testing.assert_allclose(canvas.surface_px, expected.surface_px, rtol=0, atol=1e-4)
    np.testing.assert_array_equal(canvas.drawn, expected.drawn)
    assert np.abs(canvas.image - expected.image).max() <= 1
    assert 0.3 < canvas.pure.mean() < 1
