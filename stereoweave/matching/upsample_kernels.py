"""Numba kernels of `upsample.enlarge`, in the order in which they are called.

The plain reference implementation is tests/helpers/plain_enlarging.py. All kernels process a left view; the
right view is processed as the left view of the mirrored pair. A pixel has two bands of BAND candidates,
around the farthest and the nearest surface in its neighbourhood in the smaller images. Candidate i of band b
is the disparity first_candidate[y, x, b] + i. Volumes are [H, W, 2 * BAND], where H is the height of a strip.
"""

import typing

import numpy as np

from stereoweave.matching.refine_kernels import bits
from stereoweave.system.jit import inlined, kernel

BAND = 16
MIDDLE = 8
"""Index of the candidate with the disparity of the band's surface."""
SMALL_STEP = 12
"""Penalty for a disparity step of one candidate between two pixels of a path."""
MOST_DIFFERENCE = np.uint8(40)
"""Upper limit of the grey difference, because any greater difference means a different surface."""
AGREED_PX = 1.0
"""Greatest difference at which the two views' disparities agree."""
FILL_PX = 8.0
"""A gap is filled only with disparities within this distance of the surfaces around it."""
# Padding of a path: the previous pixel's band may start up to this many candidates before or after the
# current pixel's band. Candidates in the padding have cost NEVER.
_BESIDE = BAND + 2
_ROOM = BAND + 2 * _BESIDE
PATH = 2 * _ROOM
"""Number of costs that a path carries from pixel to pixel."""
NEVER = np.uint16(30000)


@inlined
@typing.no_type_check
def _compare(code, level, codes, levels, pull, costs):
    """Write the costs of a band's candidates, given census codes, grey levels and position costs."""
    for i in range(BAND):
        apart = np.uint8(max(level, levels[i]) - min(level, levels[i]))
        apart = np.uint8(min(apart, MOST_DIFFERENCE) >> np.uint8(1))
        costs[i] = np.uint8(3 * bits(code ^ codes[i]) + apart + pull[i])


@kernel
@typing.no_type_check
def match(own, other, first_candidate, pull, rows, costs):
    """Write the matching cost of each candidate into the given rows of costs, uint8.

    own and other are the census codes and grey levels of both images; the columns of other are reversed and
    padded by BAND at both ends. pull [BAND] is the cost of each position in a band.
    """
    codes, levels = own
    other_codes, other_levels = other
    _, width, _ = costs.shape
    for y in range(rows[0], rows[1]):
        for x in range(width):
            for band in range(2):
                start = min(max(width - 1 - x + first_candidate[y, x, band], -BAND), width) + BAND
                end = start + BAND
                out = costs[y, x, band * BAND : (band + 1) * BAND]
                there, levels_there = other_codes[y, start:end], other_levels[y, start:end]
                _compare(codes[y, x], levels[y, x], there, levels_there, pull, out)


@inlined
@typing.no_type_check
def _step(before, least, moved, costs, large_step, after, sums):
    """Advance a band's path by one pixel, and return the least cost.

    The costs are written into after and added to sums. moved is the first candidate of this pixel's band
    minus the first candidate of the previous pixel's band.
    """
    limit = np.uint16(least + large_step)
    at = _BESIDE + min(max(moved, -BAND - 1), BAND + 1)
    same, nearer, farther = before[at : at + BAND], before[at - 1 : at + BAND], before[at + 1 : at + BAND + 1]
    into = after[_BESIDE : _BESIDE + BAND]
    lowest = NEVER
    for i in range(BAND):
        beside = np.uint16(min(nearer[i], farther[i]) + np.uint16(SMALL_STEP))
        cost = np.uint16(min(min(same[i], beside), limit) - least + np.uint16(costs[i]))
        into[i] = cost
        sums[i] = np.uint16(sums[i] + cost)
        lowest = min(lowest, cost)
    return lowest


@inlined
@typing.no_type_check
def _step_both(before, least, first, first_before, costs, large_step, after, sums):
    """Advance the paths of both bands by one pixel, and return the least cost."""
    lowest = NEVER
    for band in range(2):
        room = slice(band * _ROOM, (band + 1) * _ROOM)
        part = slice(band * BAND, (band + 1) * BAND)
        moved = first[band] - first_before[band]
        cost = _step(before[room], least, moved, costs[part], large_step, after[room], sums[part])
        lowest = min(lowest, cost)
    return lowest


@kernel
@typing.no_type_check
def along_rows(costs, first_candidate, large_step, rows, sums):
    """Write the summed costs of the paths from the left and the right into the given rows of sums.

    large_step [H, W + 1] is the penalty for a large step from the previous column to each column; it is 0 at
    both ends.
    """
    _, width, _ = costs.shape
    paths = np.full((2, PATH), NEVER, np.uint16)
    for y in range(rows[0], rows[1]):
        sums[y] = 0
        for backwards in range(2):
            least = np.uint16(0)
            column = width - 1 if backwards else 0
            for i in range(width):
                x = width - 1 - i if backwards else i
                first, first_before = first_candidate[y, x], first_candidate[y, column]
                before, after = paths[i & 1], paths[1 - (i & 1)]
                jump = large_step[y, x + backwards]
                least = _step_both(before, least, first, first_before, costs[y, x], jump, after, sums[y, x])
                column = x


@kernel
@typing.no_type_check
def along_columns(costs, first_candidate, large_step, backwards, columns, paths, least, first_before, sums):
    """Add the costs of the path from above, or from below if backwards is 1, to the given columns of sums.

    large_step [H + 1, W] is the penalty for a large step from the previous row to each row; it is 0 at both
    ends of the image. paths [W, PATH], least [W] and first_before [W, 2] are the paths' state after the
    previous strip and are updated for the next strip.
    """
    height, _, _ = costs.shape
    before = np.empty(PATH, np.uint16)
    for i in range(height):
        y = height - 1 - i if backwards else i
        for x in range(columns[0], columns[1]):
            for k in range(PATH):  # not [:], which takes as long to compile as all the rest
                before[k] = paths[x, k]
            first = first_candidate[y, x]
            jump = large_step[y + backwards, x]
            least[x] = _step_both(
                before, least[x], first, first_before[x], costs[y, x], jump, paths[x], sums[y, x]
            )
            first_before[x, 0], first_before[x, 1] = first[0], first[1]


@kernel
@typing.no_type_check
def pick(sums, first_candidate, rows, found_px):
    """Write the least-cost disparities, with equiangular line fits, into the given rows of found_px."""
    _, width, _ = sums.shape
    for y in range(rows[0], rows[1]):
        for x in range(width):
            costs = sums[y, x]
            lowest = costs[0]
            for i in range(2 * BAND):
                lowest = min(lowest, costs[i])
            i = 0
            while costs[i] != lowest:
                i += 1
            place = i % BAND
            found_px[y, x] = first_candidate[y, x, i // BAND] + place
            if 0 < place < BAND - 1:
                before, after = np.int32(costs[i - 1]), np.int32(costs[i + 1])
                rise = max(before, after) - np.int32(lowest)
                if rise > 0:
                    found_px[y, x] += 0.5 * (before - after) / rise


@kernel
@typing.no_type_check
def agree(found_px, other_px, agreed):
    """Write into agreed whether each pixel's disparity agrees with the other view's at its match."""
    height, width = found_px.shape
    for y in range(height):
        for x in range(width):
            column = np.int64(np.rint(x - found_px[y, x]))
            inside = 0 <= column < width
            agreed[y, x] = inside and abs(other_px[y, column] - found_px[y, x]) <= AGREED_PX


@kernel
@typing.no_type_check
def fill(known, gap, farthest_px, nearest_px, disparity_px):
    """Fill each gap in a row with the farther of the known disparities at its two ends.

    A gap is occluded by a nearer surface, so it belongs to the farther one. A pixel is filled only if the
    disparity is close to the range of the surfaces around it, farthest_px to nearest_px.
    """
    height, width = known.shape
    for y in range(height):
        start = 0
        for x in range(width + 1):
            if (x == width or known[y, x]) and x - start < width:
                left = start - 1 if start > 0 else x
                right = x if x < width else start - 1
                beyond_px = min(disparity_px[y, left], disparity_px[y, right])
                for i in range(start, x):
                    fits = farthest_px[y, i] - FILL_PX <= beyond_px <= nearest_px[y, i] + FILL_PX
                    if gap[y, i] and fits:
                        disparity_px[y, i] = beyond_px
            if x < width and known[y, x]:
                start = x + 1
