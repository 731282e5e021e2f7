import numpy as np
import pytest

from stereoweave.rendering.fine_layouts import compose_fine, to_16_bits
from stereoweave.rendering.layouts import LAYOUTS, LayoutOptions
from stereoweave.rendering.renderer import Renderer
from stereoweave.stereo import Estimate, StereoPair


def wall(height=24, width=64, disparity_px=3.0):
    """Return fine pictures of a wall that rises by a quarter of a level a column, and their renderer."""
    columns = np.broadcast_to(np.arange(width, dtype=np.float32) / 4 + 100, (height, width))
    left = np.dstack([columns, columns + 40, columns - 20]).astype(np.float32)
    right = left + np.float32(disparity_px / 4)
    px = np.full((height, width), disparity_px, np.float32)
    estimate = Estimate(
        disparity_px=px, right_disparity_px=px, confidence=np.ones_like(px), occluded=np.zeros(px.shape, bool)
    )
    pair = StereoPair(left=np.rint(left).astype(np.uint8), right=np.rint(right).astype(np.uint8))
    return left, right, lambda **options: Renderer(pair, estimate, threads=1, **options)


def test_a_view_between_the_cameras_keeps_a_quarter_of_a_level():
    left, right, renderer = wall()
    view = renderer(fine=(left, right)).fine_view(0.5)
    # A column of the view from the middle shows what the left picture shows 1.5 columns to its right.
    np.testing.assert_allclose(view[4:-4, 8:-8], left[4:-4, 8:-8] + 1.5 / 4, atol=0.05)


@pytest.mark.parametrize("position", [0.0, 0.3, 1.0, 1.4])
def test_a_fine_view_of_whole_levels_is_the_rounded_one(position):
    _, _, renderer = wall()
    coarse = renderer()
    fine = renderer(fine=(coarse.pair.left.astype(np.float32), coarse.pair.right.astype(np.float32)))
    off_levels = fine.fine_view(position) - coarse.view(position).image
    # Where holes are filled, a mean is rounded twice.
    assert np.abs(off_levels).max() <= 1.01
    assert np.quantile(np.abs(off_levels), 0.9) <= 0.51


def test_filled_holes_of_an_even_scene_keep_its_level():
    # An object 9 px nearer than the wall; beyond the right camera, neither picture shows 3 columns beside it.
    px = np.full((2, 24, 64), 3.0, np.float32)
    px[0, :, 30:40], px[1, :, 18:28] = 12, 12
    seen_by_one = np.zeros((24, 64), bool)
    estimate = Estimate(
        disparity_px=px[0], right_disparity_px=px[1], confidence=np.ones_like(px[0]), occluded=seen_by_one
    )
    fine = np.full((24, 64, 3), 100.25, np.float32)
    pair = StereoPair(left=fine.astype(np.uint8), right=fine.astype(np.uint8))
    assert not Renderer(pair, estimate, threads=1).view(1.4).drawn.all()
    view = Renderer(pair, estimate, threads=1, fine=(fine, fine)).fine_view(1.4)
    np.testing.assert_allclose(view, 100.25, atol=1e-4)


@pytest.mark.parametrize("name", [name for name, layout in LAYOUTS.items() if layout.join])
def test_fine_layouts_are_arranged_as_the_others(name):
    left, right, renderer = wall()
    fine = compose_fine(renderer(fine=(left, right), strength=0.8), LAYOUTS[name].join)
    coarse = LAYOUTS[name].compose(renderer(strength=0.8), LayoutOptions())
    assert (fine.dtype, fine.shape) == (np.uint16, coarse.shape)
    assert np.abs(fine / 256 - coarse).mean() < 0.5


def test_white_of_16_bits_is_that_of_ffmpeg():
    picture = np.array([[[0, 255, 1], [-3, 300, 127.5]]], np.float32)
    assert to_16_bits(picture).tolist() == [[[0, 65280, 256], [0, 65280, 32640]]]
