import numpy as np
import pytest

from experiments.sphere_windows.distances import find_weights, make_nine_windows, measure_distances
from stereoweave.cameras.spherical import Projection


def test_nine_windows_show_all_directions_up_to_75_degrees_aside():
    rays = Projection.named("half_equirectangular").rays((64, 64))
    seen = sum(
        find_weights(*window.find(rays), window.size_px) > 0 for window in make_nine_windows((128, 128))
    )
    aside_deg = np.degrees(np.abs(np.arcsin(rays[0] / np.linalg.norm(rays, axis=0))))
    assert (seen[aside_deg < 75] > 0).all()
    assert (seen[32, 32], seen[32, 63]) == (1, 0)


def test_weights_rise_over_a_tenth_of_the_window():
    columns = np.array([[-1.0, 0.0, 5.0, 10.0, 50.0, np.nan]])
    weights = find_weights(columns, np.full_like(columns, 50.0), (100, 100))
    np.testing.assert_allclose(weights, [[0, 1e-3, 0.5, 1, 1, 0]], atol=1e-6)


def test_both_ways_find_the_distances_of_the_room_straight_ahead():
    one, nine = measure_distances(128)
    assert (one.windows, nine.windows, one.eye_px) == (1, 9, 128)
    # As many pixels as the picture, which is equirectangular too.
    assert one.matched_megapixels == pytest.approx(128 * 128 / 1e6)
    assert nine.matched_megapixels > 5 * one.matched_megapixels
    assert max(one.error_0_percent, nine.error_0_percent) < 10
