"""Numba kernels of semi-global matching (section 4.2; Hirschmueller, 2008).

The plain reference implementation is tests/helpers/plain_mc_cnn.py. A path's penalty for a change of the
disparity depends on how many of the two views have a strong gradient between its last two pixels: none, one
or both. Penalties are float32 [3] for these three cases.
"""

import typing

import numpy as np

from stereoweave.bench.mc_cnn.volume_kernels import OUTSIDE
from stereoweave.system.jit import inlined, kernel


@inlined
@typing.no_type_check
def _start(costs, path, totals):
    """Begin a path with the costs of its first pixel, and return the least one."""
    least = OUTSIDE
    for d in range(len(costs)):
        path[d + 1] = costs[d]
        totals[d] += costs[d]
        least = min(least, costs[d])
    return least


@inlined
@typing.no_type_check
def _advance(before, least, costs, strong, others_strong, small, large, after, totals):
    """Advance a path by one pixel to candidates inside the right view, and return the least cost.

    before and after hold the path's costs, from index 1 on, with OUTSIDE beside them. others_strong tells for
    each candidate whether the other view has a strong gradient, strong whether this view has.
    """
    small_weak, small_strong = small[strong], small[strong + 1]
    large_weak, large_strong = least + large[strong], least + large[strong + 1]
    lowest = OUTSIDE
    for d in range(len(costs)):
        step = small_strong if others_strong[d] else small_weak
        jump = large_strong if others_strong[d] else large_weak
        best = min(min(before[d + 1], jump), min(before[d], before[d + 2]) + step)
        cost = costs[d] + best - least
        after[d + 1] = cost
        totals[d] += cost
        lowest = min(lowest, cost)
    return lowest


@kernel
@typing.no_type_check
def along_rows(costs, strong, others_strong, small, large, totals):
    """Add the costs of the paths from the left and from the right to totals.

    strong, uint8 [H, W], is 1 where the level differs strongly from the left neighbour's. others_strong is
    the same of the right view, with its columns reversed.
    """
    height, width, count = costs.shape
    paths = np.empty((2, count + 2), np.float32)
    for y in range(height):
        paths[:] = OUTSIDE
        least = _start(costs[y, 0, :1], paths[0], totals[y, 0, :1])
        for x in range(1, width):
            inside = min(x + 1, count)
            others = others_strong[y, width - 1 - x : width - 1 - x + inside]
            before, after = paths[(x - 1) % 2], paths[x % 2]
            out, here = totals[y, x, :inside], costs[y, x, :inside]
            least = _advance(before, least, here, strong[y, x], others, small, large, after, out)
        paths[:] = OUTSIDE
        inside = min(width, count)
        last = width - 1
        least = _start(costs[y, last, :inside], paths[last % 2], totals[y, last, :inside])
        for x in range(width - 2, -1, -1):
            inside = min(x + 1, count)
            others = others_strong[y, width - 2 - x : width - 2 - x + inside]
            before, after = paths[(x + 1) % 2], paths[x % 2]
            out, here = totals[y, x, :inside], costs[y, x, :inside]
            least = _advance(before, least, here, strong[y, x + 1], others, small, large, after, out)


@kernel
@typing.no_type_check
def along_columns(costs, strong, others_strong, small, large, totals):
    """Add the costs of the paths from the top and from the bottom to totals.

    strong, uint8 [H, W], is 1 where the level differs strongly from the upper neighbour's. others_strong is
    the same of the right view, with its columns reversed.
    """
    height, width, count = costs.shape
    paths, least = np.empty((2, width, count + 2), np.float32), np.empty(width, np.float32)
    for upwards in range(2):
        paths[:] = OUTSIDE
        for i in range(height):
            y = height - 1 - i if upwards else i
            for x in range(width):
                inside = min(x + 1, count)
                out, here, after = totals[y, x, :inside], costs[y, x, :inside], paths[i % 2, x]
                if i == 0:
                    least[x] = _start(here, after, out)
                    continue
                edge = y + upwards
                others = others_strong[edge, width - 1 - x : width - 1 - x + inside]
                before = paths[(i - 1) % 2, x]
                least[x] = _advance(before, least[x], here, strong[edge, x], others, small, large, after, out)
