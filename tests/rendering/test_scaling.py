"""A scaled pair has the same depth."""

import numpy as np
import pytest

from stereoweave.rendering.scaling import fit_size, scale_down
from stereoweave.stereo import Estimate, StereoCamera, StereoPair


@pytest.fixture
def pair(rng) -> tuple[StereoPair, Estimate]:
    left, right = (rng.integers(0, 256, (40, 80, 3), dtype=np.uint8) for _ in range(2))
    disparity_px = np.tile(np.repeat([4.0, 20.0], 40).astype(np.float32), (40, 1))
    seen = np.ones((40, 80), bool)
    seen[:10] = False
    estimate = Estimate(
        disparity_px=disparity_px,
        right_disparity_px=disparity_px,
        confidence=disparity_px / 20,
        occluded=disparity_px > 10,
    )
    camera = StereoCamera(focal_px=100, baseline_m=0.1, cx_px=39.5, cy_px=19.5, doffs_px=6)
    return StereoPair(left=left, right=right, camera=camera, left_seen=seen, right_seen=seen), estimate


@pytest.mark.parametrize(
    ("largest_px", "size_px"),
    [((40, 40), (40, 20)), ((800, 10), (20, 10)), ((800, 800), (80, 40)), ((80, 40), (80, 40))],
)
def test_a_picture_is_scaled_down_in_its_proportions_and_never_up(largest_px, size_px):
    assert fit_size((40, 80, 3), largest_px) == size_px


def test_half_the_size_has_half_the_disparity_and_the_same_depth(pair):
    small, estimate = scale_down(*pair, (40, 20))
    assert small.left.shape == (20, 40, 3)
    assert estimate.disparity_px.tolist() == [[2.0] * 20 + [10.0] * 20] * 20  # no mean of both surfaces
    assert estimate.occluded.tolist() == [[False] * 20 + [True] * 20] * 20
    assert small.left_seen.tolist() == [[False] * 40] * 5 + [[True] * 40] * 15
    assert (small.camera.focal_px, small.camera.cx_px, small.camera.cy_px) == (50, 19.5, 9.5)
    depth_m = small.camera.depth_m(estimate.disparity_px)
    np.testing.assert_allclose(depth_m, pair[0].camera.depth_m(pair[1].disparity_px)[::2, ::2])


def test_a_pixel_is_the_mean_of_the_pixels_that_it_covers(pair):
    small, _ = scale_down(*pair, (40, 20))
    means = pair[0].right.reshape(20, 2, 40, 2, 3).mean((1, 3))
    assert np.abs(small.right - means).max() <= 0.5


def test_at_the_same_size_nothing_changes(pair):
    assert scale_down(*pair, (80, 40)) == pair
