import numpy as np
import pytest

from experiments.sphere_windows.room import cast, look_equirectangular
from stereoweave.cameras.sphere_nearness import MatchedWindow, spread_nearness
from stereoweave.cameras.sphere_windows import make_whole_window, make_window
from stereoweave.cameras.spherical import Projection

HALF = Projection.named("half_equirectangular")
FULL = Projection.named("equirectangular")


@pytest.mark.parametrize("look_deg", [(0, 0), (25, 0), (0, 25)])
def test_exact_distances_of_a_window_are_exact_in_all_its_directions(look_deg):
    window = make_window(HALF, (256, 256), look_deg, 60)
    rays = np.moveaxis(window.rays().astype(float), 0, -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    _, distance = cast(rays, np.array([-0.5, 0, 0]))
    certain = np.ones(distance.shape, np.float32)
    found = spread_nearness(
        MatchedWindow(window, (1 / distance).astype(np.float32), certain), HALF, (256, 256)
    )
    _, distance = cast(look_equirectangular((256, 256)), np.array([-0.5, 0, 0]))
    known = ~np.isnan(found.nearness)
    yaw, pitch = look_deg
    # 256 px are 180 degrees.
    middle = 128 - round(256 * pitch / 180), 128 + round(256 * yaw / 180)
    assert known[middle] and not known[middle[0], middle[1] - 60]
    np.testing.assert_allclose(1 / found.nearness[known], distance[known], rtol=0.03)


def test_both_ends_of_a_circle_are_weighted_by_confidence():
    window = make_whole_window(FULL, (256, 128))
    width_px, height_px = window.size_px
    left_end = np.broadcast_to(np.arange(width_px) < width_px / 2, (height_px, width_px))
    nearness, confidence = (np.where(left_end, *ends).astype(np.float32) for ends in ((0.1, 0.3), (0.9, 0.1)))
    found = spread_nearness(MatchedWindow(window, nearness, confidence), FULL, (256, 128))
    # Behind the camera, each pixel is 11 px from the border of its own end, and 10 px from the other end's.
    # So the first one's nearness is (11 * 0.9 * 0.1 + 10 * 0.1 * 0.3) / (11 * 0.9 + 10 * 0.1).
    assert found.nearness[64, [0, -1]] == pytest.approx([1.29 / 10.9, 1.23 / 10.1], abs=1e-5)
    assert found.confidence[64, [0, -1]] == pytest.approx([9.01 / 10.9, 8.21 / 10.1], abs=1e-5)


def test_what_the_pictures_do_not_cover_is_unknown():
    window = make_whole_window(FULL, (256, 128))
    flat = np.ones((window.size_px[1], window.size_px[0]), np.float32)
    seen = flat > 0
    seen[: window.size_px[1] // 2] = False
    found = spread_nearness(MatchedWindow(window, flat, flat, seen), FULL, (256, 128))
    assert np.isnan(found.nearness[:60]).all() and not np.isnan(found.nearness[68:110]).any()
