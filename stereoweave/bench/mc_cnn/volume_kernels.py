"""Numba kernels that fill a volume of matching costs, and choose from it.

The plain reference implementation is tests/helpers/plain_mc_cnn.py. A volume is float32 [H, W, D].
Candidate d of column x is column x - d of the right view; where that lies outside, the cost is OUTSIDE. All
kernels process a left view; the right view is processed as the left view of the mirrored pair.
"""

import typing

import numpy as np

from stereoweave.system.jit import kernel

OUTSIDE = np.float32(1000)
"""Cost of a candidate outside the right view: above every other cost, and finite, as kernels need it."""


@kernel
@typing.no_type_check
def compare(left, right, costs):
    """Write each candidate's cost, minus the dot product of the vectors left and right [H, W, C]."""
    height, width, channels = left.shape
    count = costs.shape[2]
    for y in range(height):
        for x in range(width):
            inside = min(x + 1, count)
            for d in range(inside):
                similarity = np.float32(0)
                for c in range(channels):
                    similarity += left[y, x, c] * right[y, x - d, c]
                costs[y, x, d] = -similarity
            costs[y, x, inside:] = OUTSIDE


@kernel
@typing.no_type_check
def pick(costs, disparity_px):
    """Write the candidate of least cost into disparity_px, int32 [H, W]; of equal ones, the first."""
    height, width, count = costs.shape
    for y in range(height):
        for x in range(width):
            best = 0
            for d in range(1, min(x + 1, count)):
                if costs[y, x, d] < costs[y, x, best]:
                    best = d
            disparity_px[y, x] = best
