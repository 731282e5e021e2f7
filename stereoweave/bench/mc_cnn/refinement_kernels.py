"""Numba kernels for fractions of a pixel and for smoothing (sections 4.3.2 and 4.3.3).

The plain reference implementation is tests/helpers/plain_mc_cnn.py.
"""

import typing

import numpy as np

from stereoweave.system.jit import kernel

# Below this curvature of three costs, the place of their minimum is not known.
_LEAST_CURVATURE = np.float32(1e-5)


@kernel
@typing.no_type_check
def fit_parabolas(costs, whole_px, disparity_px):
    """Write the places of the minima of parabolas through three costs, at most 1 px from whole_px, int32."""
    height, width, count = costs.shape
    for y in range(height):
        for x in range(width):
            d = whole_px[y, x]
            disparity_px[y, x] = d
            if d < 1 or d + 1 >= min(x + 1, count):
                continue
            below, here, above = costs[y, x, d - 1], costs[y, x, d], costs[y, x, d + 1]
            curvature = 2 * (above - 2 * here + below)
            if curvature > _LEAST_CURVATURE:
                disparity_px[y, x] = d - min(max((above - below) / curvature, -1), 1)


@kernel
@typing.no_type_check
def smooth(disparity_px, weights, threshold_px, smoothed_px):
    """Write weighted means of the disparities that differ from the pixel's by less than threshold_px.

    weights, float32 [2 R + 1, 2 R + 1], are those of the pixels around.
    """
    height, width = disparity_px.shape
    radius = weights.shape[0] // 2
    for y in range(height):
        for x in range(width):
            total = share = np.float32(0)
            here = disparity_px[y, x]
            first, last = max(x - radius, 0), min(x + radius + 1, width)
            for row in range(max(y - radius, 0), min(y + radius + 1, height)):
                near = disparity_px[row, first:last]
                factors = weights[row - y + radius, first - x + radius : last - x + radius]
                for i in range(last - first):
                    weight = factors[i] if abs(near[i] - here) < threshold_px else np.float32(0)
                    total += weight * near[i]
                    share += weight
            smoothed_px[y, x] = total / share
