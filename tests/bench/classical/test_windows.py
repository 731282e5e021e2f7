import numpy as np
import pytest
from plain_windows import plain_best_windows, plain_window_costs

from stereoweave.bench.classical import window_kernels as kernels
from stereoweave.bench.classical.windows import find_window_costs


@pytest.fixture
def costs(rng):
    return rng.integers(0, 109, (13, 17, 5), dtype=np.uint8)


@pytest.mark.parametrize("radius", [1, 3, 8])
def test_the_fast_window_costs_equal_the_plain_ones(costs, radius):
    found = np.empty(costs.shape, np.uint16)
    kernels.rate_windows(costs, radius, 0.05, 1.5, found)
    np.testing.assert_allclose(found, plain_window_costs(costs, radius, 0.05, 1.5), atol=1.01)


@pytest.mark.parametrize("radius", [1, 3, 20])
def test_the_fast_shifts_equal_the_plain_ones(rng, radius):
    windows = rng.integers(0, 5000, (13, 17, 5), dtype=np.uint16)
    least = np.full(windows.shape, 65535, np.uint16)
    kernels.shift_windows(windows, radius, least)
    np.testing.assert_array_equal(least, plain_best_windows(windows, radius))


def test_windows_stop_at_an_edge_of_depth():
    # Left of column 40 the first candidate matches everywhere, right of it the second one.
    costs = np.zeros((60, 80, 2), np.uint8)
    costs[:, 40:, 0] = costs[:, :40, 1] = 64
    found = find_window_costs(costs)
    np.testing.assert_array_equal(found.argmin(-1), np.broadcast_to(np.arange(80) >= 40, (60, 80)))
    # A window of 25x25 fits on either side of the edge, beside it too: its penalty is 10 / (25 - 2).
    assert (found.min(-1) == int(32 * 10 / 23)).all()


def test_a_large_window_wins_on_a_plain_surface_and_a_small_one_at_a_detail():
    costs = np.full((61, 61, 1), 30, np.uint8)
    costs[28:33, 28:33] = 0
    found = find_window_costs(costs)
    # 30 + 10 / 23 far away; 0 + 10 / 3 for the window of 5x5 that is the detail.
    assert found[5, 5, 0] == int(32 * (30 + 10 / 23))
    assert found[30, 30, 0] == int(32 * 10 / 3)
