"""Numba kernels of cross-based cost aggregation (section 4.1; Zhang, Lu and Lafruit, 2009).

The plain reference implementation is tests/helpers/plain_mc_cnn.py. A pixel's region is the rows of the
pixels in its column that its vertical arms reach, each as far as that pixel's horizontal arms reach. Costs
are averaged over what the region shares with that of the match: its arms are the shorter ones of both.
"""

import typing

import numpy as np

from stereoweave.system.jit import inlined, kernel

_LEFT, _RIGHT, _UP, _DOWN = 0, 1, 2, 3


@inlined
@typing.no_type_check
def _reach(grey, y, x, dy, dx, distance, intensity):
    """Return the number of pixels of an arm from (y, x) in the direction (dy, dx).

    The next pixel always belongs to it, as in the authors' program.
    """
    height, width = grey.shape
    reach = 0
    for step in range(1, distance):
        row, column = y + step * dy, x + step * dx
        if row < 0 or row >= height or column < 0 or column >= width:
            break
        if step > 1 and abs(grey[row, column] - grey[y, x]) >= intensity:
            break
        reach = step
    return reach


@kernel
@typing.no_type_check
def find_arms(grey, distance, intensity, arms):
    """Write the arms' lengths in px to the left, right, top and bottom into arms, int32 [4, H, W].

    An arm is shorter than distance, and its levels differ from the pixel's by less than intensity.
    """
    height, width = grey.shape
    for y in range(height):
        for x in range(width):
            arms[_LEFT, y, x] = _reach(grey, y, x, 0, -1, distance, intensity)
            arms[_RIGHT, y, x] = _reach(grey, y, x, 0, 1, distance, intensity)
            arms[_UP, y, x] = _reach(grey, y, x, -1, 0, distance, intensity)
            arms[_DOWN, y, x] = _reach(grey, y, x, 1, 0, distance, intensity)


@kernel
@typing.no_type_check
def sum_rows(costs, own, other, sums):
    """Write the sum of the costs along the horizontal arms that both views share.

    own and other are the arms of both views.
    """
    height, width, count = costs.shape
    before = np.zeros((width + 1, count))
    for y in range(height):
        for x in range(width):
            inside = min(x + 1, count)
            for d in range(inside):
                before[x + 1, d] = before[x, d] + costs[y, x, d]
        for x in range(width):
            for d in range(min(x + 1, count)):
                first = x - min(own[_LEFT, y, x], other[_LEFT, y, x - d])
                last = x + min(own[_RIGHT, y, x], other[_RIGHT, y, x - d])
                sums[y, x, d] = before[last + 1, d] - before[first, d]


@kernel
@typing.no_type_check
def average_columns(sums, own, other, costs):
    """Write the mean cost over the shared region, given the sums of its rows. Costs outside stay."""
    height, width, count = costs.shape
    before, sizes = np.zeros((height + 1, count)), np.zeros((height + 1, count), np.int32)
    for x in range(width):
        inside = min(x + 1, count)
        for y in range(height):
            for d in range(inside):
                left = min(own[_LEFT, y, x], other[_LEFT, y, x - d])
                right = min(own[_RIGHT, y, x], other[_RIGHT, y, x - d])
                before[y + 1, d] = before[y, d] + sums[y, x, d]
                sizes[y + 1, d] = sizes[y, d] + left + 1 + right
        for y in range(height):
            for d in range(inside):
                first = y - min(own[_UP, y, x], other[_UP, y, x - d])
                last = y + min(own[_DOWN, y, x], other[_DOWN, y, x - d])
                area = sizes[last + 1, d] - sizes[first, d]
                costs[y, x, d] = (before[last + 1, d] - before[first, d]) / area
