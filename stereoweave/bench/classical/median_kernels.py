"""Numba kernel of `spanning_trees.fill`; the plain reference is tests/helpers/plain_medians.py."""

import typing

import numpy as np

from stereoweave.system.jit import kernel

RADIUS_PX = 17
BINS_PER_PX = 4
"""Medians are multiples of 1/BINS_PER_PX."""


@kernel
@typing.no_type_check
def weigh_medians(image, disparity_px, filled, weights, found_px):
    """Write the weighted median of the disparities around each filled pixel into found_px.

    Args:
        image: uint8 [H, W, 3].
        disparity_px: float32 [H, W], 0 or above.
        filled: bool [H, W].
        weights: float32 [766], weight of a neighbour by the sum of its differences in the three channels.
        found_px: float32 [H, W].
    """
    height, width = disparity_px.shape
    highest = np.float32(0)
    for y in range(height):
        for x in range(width):
            highest = max(highest, disparity_px[y, x])
    bins = np.empty(np.int64(highest * BINS_PER_PX + 0.5) + 1, np.float32)
    for y in range(height):
        for x in range(width):
            if not filled[y, x]:
                continue
            bins[:] = 0
            total = np.float32(0)
            for v in range(max(y - RADIUS_PX, 0), min(y + RADIUS_PX + 1, height)):
                for u in range(max(x - RADIUS_PX, 0), min(x + RADIUS_PX + 1, width)):
                    unlike = 0
                    for channel in range(3):
                        unlike += abs(np.int64(image[v, u, channel]) - np.int64(image[y, x, channel]))
                    bins[np.int64(disparity_px[v, u] * BINS_PER_PX + 0.5)] += weights[unlike]
                    total += weights[unlike]
            at, below = 0, bins[0]
            while below < total / 2 and at < bins.shape[0] - 1:
                at += 1
                below += bins[at]
            found_px[y, x] = np.float32(at) / BINS_PER_PX
