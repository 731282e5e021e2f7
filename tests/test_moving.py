import numpy as np
import pytest

from stereoweave.rendering import Renderer
from stereoweave.stereo import Estimate, StereoCamera, StereoPair


def estimate_of(disparity_px, right_disparity_px):
    return Estimate(
        disparity_px=np.ascontiguousarray(disparity_px, np.float32),
        right_disparity_px=np.ascontiguousarray(right_disparity_px, np.float32),
        confidence=np.ones(disparity_px.shape, np.float32),
        occluded=np.zeros(disparity_px.shape, bool),
    )


def flat(rng, disparity_px, camera=None, height=60, width=90):
    """A wall at one disparity, of soft noise, whose right photograph is the left one moved."""
    coarse = rng.integers(0, 256, (height // 6, width // 6, 3)).astype(np.float32)
    left = np.repeat(np.repeat(coarse, 6, axis=0), 6, axis=1).astype(np.uint8)
    right = np.roll(left, -disparity_px, axis=1)
    map_px = np.full((height, width), disparity_px)
    return Renderer(StereoPair(left=left, right=right, camera=camera), estimate_of(map_px, map_px))


def test_from_above_everything_lies_lower_by_its_disparity(rng):
    renderer = flat(rng, 8)
    level, above = renderer.view(0.5), renderer.view(0.5, up=0.5)
    np.testing.assert_array_equal(above.image[4:], level.image[:-4])
    assert not above.drawn[:4].any()
    np.testing.assert_array_equal(above.drawn[4:], level.drawn[:-4])


def test_from_below_what_is_near_covers_what_is_far(rng):
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
    # The wall that was hidden below row 25 comes from the object's lower border, 8 rows.
    invented = ~view.drawn
    assert invented[15:23, 26:34].all()
    assert not invented[5:15].any()


def test_forward_everything_grows_about_the_centre_by_its_depth():
    # At a depth of 80 / 8 = 10 baselines; one baseline nearer everything is 10 / 9 as large.
    camera = StereoCamera(focal_px=80.0, baseline_m=0.1, cx_px=45.0, cy_px=30.0)
    columns, rows = np.meshgrid(np.arange(90), np.arange(60))
    left = np.stack([2 * columns, 3 * rows, columns + rows], axis=2).astype(np.uint8)
    pair = StereoPair(left=left, right=np.roll(left, -8, axis=1), camera=camera)
    view = Renderer(pair, estimate_of(*np.full((2, 60, 90), 8.0))).view(0.0, forward=1.0)
    x, y = 45 + (columns - 45) * 0.9, 30 + (rows - 30) * 0.9
    expected = np.stack([2 * x, 3 * y, x + y], axis=2)
    assert np.abs(view.image - expected)[2:-2, 2:-2].max() <= 1
    assert view.drawn.all()


def test_backward_is_forward_undone_where_both_can_be_seen(rng):
    camera = StereoCamera(focal_px=80.0, baseline_m=0.1, cx_px=45.0, cy_px=30.0)
    renderer = flat(rng, 8, camera)
    far = renderer.view(0.5, forward=-1.0)
    # 10 / 11 as large: 60 rows fill 54.5 of the picture.
    assert far.drawn[:, 45].sum() == pytest.approx(60 * 10 / 11, abs=1)


def test_an_offset_between_the_principal_points_counts_as_depth(rng):
    camera = StereoCamera(focal_px=80.0, baseline_m=0.1, cx_px=45.0, cy_px=30.0, doffs_px=4.0)
    level, above = (flat(np.random.default_rng(1), 8, camera).view(0.5, up=up) for up in (0.0, 0.5))
    # Of depth 80 / (8 + 4) baselines: half a baseline moves it by 6 rows.
    np.testing.assert_array_equal(above.image[6:], level.image[:-6])


@pytest.mark.parametrize("move", [{"up": 1.1}, {"forward": -1.1}, {"up": float("nan")}])
def test_a_move_out_of_range_is_refused(rng, move):
    (name, value), *_ = move.items()
    with pytest.raises(ValueError, match=rf"^{name}: expected -1 to 1 \(baselines\), got {value}$"):
        flat(rng, 8).view(0.5, **move)


def test_a_camera_moved_up_and_forward_keeps_the_order_of_depth(rng):
    left = rng.integers(0, 256, (30, 40, 3), dtype=np.uint8)
    disparity_px = np.repeat(np.linspace(12, 1, 30)[:, None], 40, axis=1)
    view = Renderer(StereoPair(left=left, right=left), estimate_of(disparity_px, disparity_px)).view(
        0.0, up=0.3, forward=0.3
    )
    assert view.image.shape == left.shape
    assert view.drawn.any()
