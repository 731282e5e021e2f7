"""Numba kernels of `windows`; the plain reference is tests/helpers/plain_windows.py.

Volumes are [H, W, D]. Outside the image, the pixels of its border are repeated.
"""

import typing

import numpy as np

from stereoweave.system.jit import inlined, kernel

STEPS = 32
"""Window costs are whole multiples of 1/STEPS of the matching costs' unit."""
_HIGHEST = np.float32(65535)


@inlined
@typing.no_type_check
def _add(entering, leaving, sums, squares):
    """Add the costs that enter a sum, and subtract those that leave it, each and squared."""
    for i in range(sums.shape[0]):
        come, go = np.int32(entering[i]), np.int32(leaving[i])
        sums[i] += come - go
        squares[i] += come * come - go * go


@inlined
@typing.no_type_check
def _slide(entering, leaving, sums):
    """Add a column's sums that enter a window, and subtract those of the column that leaves it."""
    for i in range(sums.shape[0]):
        sums[i] += entering[i] - leaving[i]


@inlined
@typing.no_type_check
def _rate(sums, squares, share, variance_weight, penalty, found):
    """Write mean + variance_weight * variance + penalty of a window for each candidate."""
    for i in range(found.shape[0]):
        mean = np.float32(sums[i]) * share
        variance = np.float32(squares[i]) * share - mean * mean
        cost = np.float32(STEPS) * (mean + variance_weight * variance + penalty)
        found[i] = np.uint16(min(cost, _HIGHEST))


@kernel
@typing.no_type_check
def rate_windows(costs, radius, variance_weight, penalty, found):
    """Write the cost of the window centred at each pixel into found (uint16, in 1/STEPS).

    Args:
        costs: uint8 [H, W, D], matching costs.
        radius: The window has 2 * radius + 1 pixels on each side.
        variance_weight: Weight of the variance of the matching costs within the window.
        penalty: Added to the cost of each window of this size.
        found: uint16 [H, W, D].
    """
    height, width, count = costs.shape
    share = np.float32(1.0 / (2 * radius + 1) ** 2)
    weight, added = np.float32(variance_weight), np.float32(penalty)
    columns, column_squares = np.zeros((width, count), np.int32), np.zeros((width, count), np.int32)
    sums, squares = np.zeros(count, np.int32), np.zeros(count, np.int32)
    nothing = np.zeros(count, np.uint8)
    for y in range(height):
        for row in range(y + radius if y > 0 else -radius, y + radius + 1):
            entering = min(max(row, 0), height - 1)
            leaving = max(y - 1 - radius, 0)
            for x in range(width):
                gone = costs[leaving, x] if y > 0 else nothing
                _add(costs[entering, x], gone, columns[x], column_squares[x])
        sums[:] = 0
        squares[:] = 0
        for column in range(-radius, radius + 1):
            x = min(max(column, 0), width - 1)
            for i in range(count):
                sums[i] += columns[x, i]
                squares[i] += column_squares[x, i]
        for x in range(width):
            _rate(sums, squares, share, weight, added, found[y, x])
            entering, leaving = min(x + 1 + radius, width - 1), max(x - radius, 0)
            _slide(columns[entering], columns[leaving], sums)
            _slide(column_squares[entering], column_squares[leaving], squares)


@inlined
@typing.no_type_check
def _lower(costs, least):
    """Lower each candidate's least cost to its cost."""
    for i in range(least.shape[0]):
        least[i] = min(least[i], costs[i])


@kernel
@typing.no_type_check
def shift_windows(windows, radius, least):
    """Lower least [H, W, D] to the cost of the best of nine windows that contain the pixel.

    They are the window centred at the pixel, and those that have it in the middle of a side or in a corner.
    """
    height, width, _ = windows.shape
    for y in range(height):
        for x in range(width):
            for down in range(-1, 2):
                row = min(max(y + down * radius, 0), height - 1)
                for across in range(-1, 2):
                    _lower(windows[row, min(max(x + across * radius, 0), width - 1)], least[y, x])
