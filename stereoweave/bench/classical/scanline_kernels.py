"""Numba kernel of `scanlines`; the plain reference is tests/helpers/plain_scanlines.py."""

import typing

import numpy as np

from stereoweave.system.jit import kernel

_MATCHED, _OCCLUDED, _SKIPPED = np.uint8(0), np.uint8(1), np.uint8(2)


@kernel
@typing.no_type_check
def align_rows(costs, occlusion_cost, found_px):
    """Write the disparities of the cheapest alignment of each row with the right row; -1 for occluded pixels.

    A path visits the columns of both rows from left to right. A step matches two pixels, at their cost, or
    passes over a pixel of one row, which the other camera does not see, at occlusion_cost. The path may begin
    and end at any disparity. Of equal paths, the one with more matches wins, then the one that passes over
    the left row.

    Args:
        costs: uint16 [H, W, D], cost of a match; candidate i is a disparity of i px.
        occlusion_cost: Cost of a pixel without a match, in the same unit.
        found_px: float32 [H, W].
    """
    height, width, count = costs.shape
    steps = np.empty((width, count), np.uint8)
    sums = np.empty((2, count), np.int32)
    price = np.int32(occlusion_cost)
    for y in range(height):
        sums[:] = 0
        for x in range(width):
            before, after = sums[x & 1], sums[1 - (x & 1)]
            after[0] = before[0] + costs[y, x, 0]
            steps[x, 0] = _MATCHED
            # The left pixel is passed over: the right column stays, so that the disparity grows by one.
            for i in range(1, count):
                matched, occluded = before[i] + np.int32(costs[y, x, i]), before[i - 1] + price
                after[i] = min(matched, occluded)
                steps[x, i] = _OCCLUDED if occluded < matched else _MATCHED
            # A right pixel is passed over: the left column stays, so that the disparity falls by one.
            for i in range(count - 2, -1, -1):
                if after[i + 1] + price < after[i]:
                    after[i] = after[i + 1] + price
                    steps[x, i] = _SKIPPED
        last = sums[width & 1]
        i = 0
        for candidate in range(1, count):
            if last[candidate] < last[i]:
                i = candidate
        x = width - 1
        while x >= 0:
            if steps[x, i] == _SKIPPED:
                i += 1
                continue
            found_px[y, x] = i if steps[x, i] == _MATCHED else -1
            i -= steps[x, i]
            x -= 1
