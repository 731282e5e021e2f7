"""The common part of views of a wall, by hand."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from stereoweave.errors import StereoweaveError
from stereoweave.rendering.cropping import find_common_part
from stereoweave.rendering.renderer import Renderer
from stereoweave.stereo import Estimate, StereoPair

HEIGHT, WIDTH, WALL_PX = 48, 96, 8


@pytest.fixture
def pair(rng) -> tuple[StereoPair, Estimate]:
    """Return a pair that shows a wall of disparity 8, and its estimate."""
    coarse = Image.fromarray(rng.integers(0, 256, (12, 26, 3), dtype=np.uint8))
    wall = np.asarray(coarse.resize((WIDTH + WALL_PX, HEIGHT), Image.BICUBIC))
    disparity_px = np.full((HEIGHT, WIDTH), WALL_PX, np.float32)
    estimate = Estimate(
        disparity_px=disparity_px,
        right_disparity_px=disparity_px,
        confidence=np.ones_like(disparity_px),
        occluded=np.zeros(disparity_px.shape, bool),
    )
    return StereoPair(left=wall[:, :WIDTH].copy(), right=wall[:, WALL_PX:].copy()), estimate


@pytest.mark.parametrize(
    ("convergence_px", "positions", "start", "stop"),
    [
        (0, (0.0, 1.0), 0, WIDTH),  # the images themselves
        (0, (1.5,), 0, WIDTH - 4),  # half a baseline beyond the right camera: 4 px that it does not see
        (0, (-0.5,), 4, WIDTH),
        (0, (-0.5, 1.5), 4, WIDTH - 4),
        (8, (0.0, 1.0), 0, WIDTH),  # both shifted by 4 px, into what the other camera sees
        # Shifted by 10 px to the left and to the right; the other camera fills 8 of them.
        (20, (0.0, 1.0), 2, WIDTH - 2),
    ],
)
def test_borders_that_no_camera_saw_are_cut_off(pair, convergence_px, positions, start, stop):
    renderer = Renderer(*pair, convergence_px=convergence_px, threads=1)
    assert find_common_part(renderer, positions) == (slice(0, HEIGHT), slice(start, stop))


def test_from_above_the_upper_rows_are_cut_off(pair):
    renderer = Renderer(*pair, threads=1)
    rows, columns = find_common_part(renderer, [0.5], up=0.5)
    assert (rows, columns) == (slice(4, HEIGHT), slice(0, WIDTH))  # 0.5 baselines at a disparity of 8


def test_slanted_borders_without_content_are_cut_off(pair):
    # A border as a rotation leaves it: one column narrower in every fourth row.
    rows, columns = np.indices((HEIGHT, WIDTH))
    images, estimate = pair
    slanted = replace(images, left_seen=columns >= 12 - rows // 4, right_seen=columns < WIDTH - 20)
    renderer = Renderer(slanted, estimate, threads=1)
    # At 0.5, the wall of disparity 8 moves by 4 px: the left border to the left, the right one to the right.
    assert find_common_part(renderer, [0.0, 0.5, 1.0]) == (slice(0, HEIGHT), slice(12, WIDTH - 20))


def test_views_with_too_little_in_common_are_refused(pair):
    renderer = Renderer(*pair, convergence_px=90, threads=1)
    # The left image is shifted by 45 px to the left, of which the right image fills 8, and vice versa.
    with pytest.raises(StereoweaveError) as error:
        find_common_part(renderer, [0.0, 1.0])
    assert str(error.value) == (
        "crop: expected views that have at least 32x32 px in common, found 22x48; take viewpoints nearer to "
        "the cameras (position, strength)"
    )
