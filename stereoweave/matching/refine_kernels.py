"""The refinement's loops over pixels and disparities, compiled by Numba; `refine` calls them in this order.

A plain version of all this is in tests/plain_refining.py, and has to agree. All is for a left view: the right
one is the left one of the mirrored pair. Volumes are [H, W, D]: candidate i is the disparity first_px + i,
and the match of column x is then column W - 1 - x + i of the other photograph's `Cues`, whose columns run
backwards, so that candidates lie side by side in memory.
"""

import typing

import numpy as np

from stereoweave.system.jit import inlined, kernel

SUBSTEPS = 8
"""A network's disparity is compared with candidates in steps of 1/8 px."""
DOUBTLESS, FARTHEST = np.uint16(SUBSTEPS), np.uint16(8 * SUBSTEPS)
"""A candidate so near to it costs nothing by that, and one so much farther away the most."""
MOST_TRUST = 12
"""What the most is, for a disparity of full confidence."""
MOST_DIFFERENCE = np.uint8(40)
"""Levels of a channel that differ by more belong to different surfaces, however much more that is."""
SMALL_STEP = 20
"""What a change by one candidate between two pixels of a path costs."""
PRECISE_PX = 1.5
"""So near to a whole candidate the network is the more precise of the two."""
CERTAIN = 0.85
"""Of a network's disparities of this confidence more would be spoilt than mended."""
AGREED_PX = 1.0
"""The most by which two views' disparities of one point differ."""
RELIABLE_RUN = 8
SLACK_PX = 2
LARGEST_MOVE_PX = 24
"""A network that is off by more than this beside the border sees something else there than the surface."""
_CENSUS_RADIUS = 2
_NEVER = np.uint16(30000)
_SIX = np.uint16(6)
# Numba makes 64 bits of every sum unless both its parts are narrow: half as many in a vector.
_ONE, _TWO, _FOUR, _TOP = (np.uint32(bits) for bits in (1, 2, 4, 24))
_PAIRS, _FOURS, _EIGHTS, _SUM = (np.uint32(mask) for mask in (0x55555555, 0x33333333, 0x0F0F0F0F, 0x01010101))


class Cues(typing.NamedTuple):
    """What the cost of a match is made of, for each pixel of a photograph; arrays [H, W], C-contiguous.

    Attributes:
        grey: uint8; where it changes little, neighbours are on one surface.
        census: uint32, which of the 24 pixels around are darker.
        colour: uint8 [H, 3, W].
        darkest: uint8 [H, 3, W], of the levels up to half a pixel to either side.
        brightest: uint8 [H, 3, W], likewise.
        prior: uint16, the network's disparity less first_px, in 1/SUBSTEPS px: up to 8191 px.
        trust: uint16, 0..MOST_TRUST, its weight.
    """

    grey: np.ndarray
    census: np.ndarray
    colour: np.ndarray
    darkest: np.ndarray
    brightest: np.ndarray
    prior: np.ndarray
    trust: np.ndarray


@kernel
@typing.no_type_check
def census(grey, codes):
    """Write into codes one bit for each of the 24 pixels around: whether it is darker."""
    height, width = grey.shape
    for y in range(height):
        for x in range(width):
            code = np.uint32(0)
            for dy in range(-_CENSUS_RADIUS, _CENSUS_RADIUS + 1):
                row = min(max(y + dy, 0), height - 1)
                for dx in range(-_CENSUS_RADIUS, _CENSUS_RADIUS + 1):
                    if dy != 0 or dx != 0:
                        column = min(max(x + dx, 0), width - 1)
                        code = np.uint32((code << _ONE) | np.uint32(grey[row, column] < grey[y, x]))
            codes[y, x] = code


@inlined
@typing.no_type_check
def bits(code):
    """How many of 32 bits are set."""
    pairs = np.uint32(code - ((code >> _ONE) & _PAIRS))
    fours = np.uint32((pairs & _FOURS) + ((pairs >> _TWO) & _FOURS))
    return np.int32(np.uint32(((fours + (fours >> _FOUR)) & _EIGHTS) * _SUM) >> _TOP)


@inlined
@typing.no_type_check
def _outside(level, dark, bright):
    """How far a level is outside of dark..bright."""
    return max(np.uint8(max(level, bright) - bright), np.uint8(dark - min(level, dark)))


@inlined
@typing.no_type_check
def _difference(level, dark, bright, there, dark_there, bright_there):
    """How much a channel differs, half a pixel to either side of one allowed (Birchfield and Tomasi 1998)."""
    nearest = min(_outside(level, dark_there, bright_there), _outside(there, dark, bright))
    return min(nearest, MOST_DIFFERENCE)


@inlined
@typing.no_type_check
def _differences(level, dark, bright, levels, darks, brights, costs):
    """Write half of how much the candidates' colours differ; each argument is three channels'."""
    for i in range(costs.shape[0]):
        red = _difference(level[0], dark[0], bright[0], levels[0][i], darks[0][i], brights[0][i])
        green = _difference(level[1], dark[1], bright[1], levels[1][i], darks[1][i], brights[1][i])
        blue = _difference(level[2], dark[2], bright[2], levels[2][i], darks[2][i], brights[2][i])
        costs[i] = np.uint8(np.uint8(red + green + blue) >> np.uint8(1))


@inlined
@typing.no_type_check
def _at(channels, y, x):
    """A pixel's three levels; `channels` is [H, 3, W]."""
    return channels[y, 0, x], channels[y, 1, x], channels[y, 2, x]


@inlined
@typing.no_type_check
def _along(channels, y, start, end):
    """The three channels of some columns of a row."""
    return channels[y, 0, start:end], channels[y, 1, start:end], channels[y, 2, start:end]


@inlined
@typing.no_type_check
def _add_census(code, codes, costs):
    """Add how many bits of the census differ, twice."""
    for i in range(costs.shape[0]):
        costs[i] = np.uint8(costs[i] + 2 * bits(code ^ codes[i]))


@inlined
@typing.no_type_check
def _pull(prior, trust, candidate):
    """What a candidate costs by its distance to the network's disparity, beyond 1 px and up to 9."""
    away = np.uint16(max(prior, candidate) - min(prior, candidate))
    beyond = np.uint16(max(away, DOUBTLESS) - DOUBTLESS)
    return np.uint16(np.uint16(min(beyond, FARTHEST) * trust) >> _SIX)


@inlined
@typing.no_type_check
def _add_pulls(prior, trust, priors, trusts, costs):
    """Add the pull of both views' networks."""
    for i in range(costs.shape[0]):
        candidate = np.uint16(SUBSTEPS * i)
        pulls = _pull(prior, trust, candidate) + _pull(priors[i], trusts[i], candidate)
        costs[i] = np.uint8(costs[i] + pulls)


@kernel
@typing.no_type_check
def match(own, other, first, last, costs):
    """Write into rows first..last of costs, uint8, what each candidate costs."""
    _, width, count = costs.shape
    for y in range(first, last):
        for x in range(width):
            start = width - 1 - x
            end = start + count
            out = costs[y, x]
            _differences(
                _at(own.colour, y, x),
                _at(own.darkest, y, x),
                _at(own.brightest, y, x),
                _along(other.colour, y, start, end),
                _along(other.darkest, y, start, end),
                _along(other.brightest, y, start, end),
                out,
            )
            _add_census(own.census[y, x], other.census[y, start:end], out)
            priors, trusts = other.prior[y, start:end], other.trust[y, start:end]
            _add_pulls(own.prior[y, x], own.trust[y, x], priors, trusts, out)


@inlined
@typing.no_type_check
def _step(before, least, costs, large_step, after, sums):
    """One step of a path: writes its costs into after and adds them to sums; the least of them."""
    limit = np.uint16(least + large_step)
    lowest = _NEVER
    for i in range(costs.shape[0]):
        beside = np.uint16(min(before[i], before[i + 2]) + np.uint16(SMALL_STEP))
        cost = np.uint16(min(min(before[i + 1], beside), limit) - least + np.uint16(costs[i]))
        after[i + 1] = cost
        sums[i] = np.uint16(sums[i] + cost)
        lowest = min(lowest, cost)
    return lowest


@kernel
@typing.no_type_check
def along_rows(costs, large_step, first, last, sums):
    """Write into rows first..last of sums the costs of the paths from the left and from the right.

    large_step [H, W] is what a jump between a pixel and the one before it costs.
    """
    _, width, count = costs.shape
    paths = np.empty((2, count + 2), np.uint16)
    for y in range(first, last):
        sums[y] = 0
        for backwards in range(2):
            paths[:] = 0
            paths[:, 0] = paths[:, count + 1] = _NEVER
            least = np.uint16(0)
            for i in range(width):
                x = width - 1 - i if backwards else i
                jump = large_step[y, min(x + backwards, width - 1)]
                least = _step(paths[i & 1], least, costs[y, x], jump, paths[1 - (i & 1)], sums[y, x])


@kernel
@typing.no_type_check
def along_columns(costs, large_step, first, last, sums):
    """Add to columns first..last of sums the costs of the paths from above and from below."""
    height, _, count = costs.shape
    width = last - first
    paths = np.empty((2, width, count + 2), np.uint16)
    least = np.empty(width, np.uint16)
    for backwards in range(2):
        paths[:] = 0
        paths[:, :, 0] = paths[:, :, count + 1] = _NEVER
        least[:] = 0
        for i in range(height):
            y = height - 1 - i if backwards else i
            jumps = large_step[min(y + backwards, height - 1)]
            before, after = paths[i & 1], paths[1 - (i & 1)]
            for j in range(width):
                x = first + j
                least[j] = _step(before[j], least[j], costs[y, x], jumps[x], after[j], sums[y, x])


@inlined
@typing.no_type_check
def _between(before, here, after):
    """Where between the candidates, -0.5..0.5, two lines of opposite slope meet through three costs."""
    rise = max(np.int32(before), np.int32(after)) - np.int32(here)
    return 0.5 * (np.int32(before) - np.int32(after)) / rise if rise > 0 else 0.0


@kernel
@typing.no_type_check
def pick(sums, first_px, first, last, found_px):
    """Write into rows first..last of found_px the disparities of least cost."""
    _, width, count = sums.shape
    for y in range(first, last):
        for x in range(width):
            costs = sums[y, x]
            lowest = costs[0]
            for i in range(count):
                lowest = min(lowest, costs[i])
            i = 0
            while costs[i] != lowest:
                i += 1
            found_px[y, x] = first_px + i
            if 0 < i < count - 1:
                found_px[y, x] += _between(costs[i - 1], lowest, costs[i + 1])


@kernel
@typing.no_type_check
def settle(found_px, other_px, trust, towards, disparity_px, agreed):
    """Put what both views found alike into disparity_px, which holds the network's, and mark it in agreed.

    A disparity that is certain, or off by no more than PRECISE_PX, stays: `trust` is its confidence. towards
    is -1 if the match of column x is at x - disparity, 1 if it is at x + disparity.
    """
    height, width = found_px.shape
    for y in range(height):
        for x in range(width):
            found = found_px[y, x]
            column = np.int64(np.rint(x + towards * found))
            agreed[y, x] = 0 <= column < width and abs(other_px[y, column] - found) <= AGREED_PX
            imprecise = abs(disparity_px[y, x] - found) > PRECISE_PX
            if agreed[y, x] and imprecise and trust[y, x] < CERTAIN:
                disparity_px[y, x] = found


@kernel
@typing.no_type_check
def extend(agreed, trust, towards, disparity_px):
    """Continue the first surface of each row to the border that the other picture does not reach.

    A surface is RELIABLE_RUN agreed pixels; it is continued where all between it and the border lies beyond
    the other picture. What is certain stays, and what is farther from it than LARGEST_MOVE_PX.
    """
    height, width = agreed.shape
    for y in range(height):
        run, i = 0, 0
        while i < width and run < RELIABLE_RUN:
            run = run + 1 if agreed[y, i if towards < 0 else width - 1 - i] else 0
            i += 1
        hidden = i - RELIABLE_RUN
        if run == RELIABLE_RUN:
            surface_px = disparity_px[y, hidden if towards < 0 else width - 1 - hidden]
            if hidden <= surface_px + SLACK_PX:
                for i in range(hidden):
                    x = i if towards < 0 else width - 1 - i
                    if trust[y, x] < CERTAIN and abs(surface_px - disparity_px[y, x]) <= LARGEST_MOVE_PX:
                        disparity_px[y, x] = surface_px
