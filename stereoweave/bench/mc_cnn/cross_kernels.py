"""Numba kernels of cross-based cost aggregation (section 4.1; Zhang, Lu and Lafruit, 2009).

The plain reference implementation is tests/helpers/plain_mc_cnn.py. A pixel's region is the rows of the
pixels in its column that its vertical arms reach, each as far as that pixel's horizontal arms reach. Costs
are averaged over what the region shares with that of the match: its arms are the shorter ones of both. Sums
along an arm are differences of sums from the border.
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
def sum_rows(costs, own, other, before, sums):
    """Write the sum of the costs along the horizontal arms that both views share.

    own and other are the arms of both views; the columns of other are reversed. before, float64 [(W + 1) D],
    is overwritten.
    """
    height, width, count = costs.shape
    for d in range(count):
        before[d] = 0
    for y in range(height):
        for x in range(width):
            inside, start = min(x + 1, count), x * count
            for d in range(count):
                cost = costs[y, x, d] if d < inside else 0
                before[start + count + d] = before[start + d] + cost
        for x in range(width):
            inside, match = min(x + 1, count), width - 1 - x
            left, right = own[_LEFT, y, x], own[_RIGHT, y, x]
            lefts, rights = other[_LEFT, y, match : match + inside], other[_RIGHT, y, match : match + inside]
            out = sums[y, x, :inside]
            for d in range(inside):
                first, end = x - min(left, lefts[d]), x + min(right, rights[d]) + 1
                out[d] = before[np.uint32(end * count + d)] - before[np.uint32(first * count + d)]


@kernel
@typing.no_type_check
def sum_columns(sums, own, other, before, costs):
    """Write the sum over the shared region, given the sums of its rows. Costs outside stay.

    before, float64 [(H + 1) D], is overwritten.
    """
    height, width, count = costs.shape
    for d in range(count):
        before[d] = 0
    for x in range(width):
        inside, match = min(x + 1, count), width - 1 - x
        for y in range(height):
            here, start = sums[y, x, :inside], y * count
            for d in range(inside):
                before[start + count + d] = before[start + d] + here[d]
        for y in range(height):
            up, down = own[_UP, y, x], own[_DOWN, y, x]
            ups, downs = other[_UP, y, match : match + inside], other[_DOWN, y, match : match + inside]
            out = costs[y, x, :inside]
            for d in range(inside):
                first, end = y - min(up, ups[d]), y + min(down, downs[d]) + 1
                out[d] = before[np.uint32(end * count + d)] - before[np.uint32(first * count + d)]
