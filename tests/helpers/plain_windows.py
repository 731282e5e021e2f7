"""Plain reference of `bench.classical.window_kernels`: one window and one shift at a time."""

import numpy as np


def plain_window_costs(costs, radius, variance_weight, penalty):
    """Return 32 * (mean + variance_weight * variance + penalty) of the window at each pixel [H, W, D]."""
    padded = np.pad(costs.astype(float), ((radius, radius), (radius, radius), (0, 0)), mode="edge")
    found = np.empty(costs.shape)
    for y, x in np.ndindex(costs.shape[:2]):
        window = padded[y : y + 2 * radius + 1, x : x + 2 * radius + 1]
        found[y, x] = window.mean((0, 1)) + variance_weight * window.var((0, 1)) + penalty
    return 32 * found


def plain_best_windows(windows, radius):
    """Return the least cost of the nine windows that contain each pixel [H, W, D]."""
    height, width, _ = windows.shape
    found = np.empty_like(windows)
    for y, x in np.ndindex(height, width):
        rows = np.clip([y - radius, y, y + radius], 0, height - 1)
        columns = np.clip([x - radius, x, x + radius], 0, width - 1)
        found[y, x] = windows[np.ix_(rows, columns)].min((0, 1))
    return found
