"""Numba kernels of `refine`, in the order in which they are called; `pick` is for bench/classical alone.

The plain reference implementation is tests/helpers/plain_refining.py. Candidate i is the disparity
first_px + i. `Search` says which candidates of a pixel are searched; a volume holds those of one pixel after
the other. For a left view, the columns of the other image's `Cues` are reversed, so that the candidates of
column x, at W - 1 - x + i, are contiguous in memory; for a right view they are at x + i.
"""

import typing

import numpy as np

from stereoweave.system.jit import inlined, kernel

TILE_PX = 32
"""Side of the square tiles whose pixels have the same candidates."""
SUBSTEPS = 8
"""Number of steps per px in which a candidate's distance to the network's disparity is measured."""
DOUBTLESS, FARTHEST = np.uint16(SUBSTEPS), np.uint16(8 * SUBSTEPS)
"""The cost is 0 up to the first distance from the network's disparity, and grows over the second."""
MOST_TRUST = 12
"""Greatest cost of the distance to the network's disparity, reached at confidence 1."""
MOST_DIFFERENCE = np.uint8(40)
"""Upper limit of a channel's difference, because any greater difference means a different surface."""
SMALL_STEP = 20
"""Penalty for a disparity step of one candidate between two pixels of a path."""
PRECISE_PX = 1.0
"""Within this distance of the matched disparity, the network's disparity is more precise."""
CERTAIN = 0.85
"""Above this confidence, replacing the network's disparities does more harm than good."""
AGREED_PX = 1.0
"""Greatest difference at which the two views' disparities agree."""
RELIABLE_RUN = 8
SLACK_PX = 2
LARGEST_MOVE_PX = 24
"""Border disparities that differ from the surface's by more than this belong to another surface."""
_CENSUS_RADIUS = 2
_COLOURS = 3
_NOTHING, _NEVER, _HIGHEST = np.uint16(0), np.uint16(30000), np.uint16(65535)
_SIX = np.uint16(6)
# Numba widens sums to 64 bits unless both operands are narrow; wide sums would halve the vectors' length.
_ONE, _TWO, _FOUR, _HALF, _TOP, _WORD = (np.uint32(bits) for bits in (1, 2, 4, 16, 24, 32))
_LOW, _LARGEST = np.uint32(0xFFFF), np.uint32(0xFFFFFFFF)
_PAIRS, _FOURS, _EIGHTS, _SUM = (np.uint32(mask) for mask in (0x55555555, 0x33333333, 0x0F0F0F0F, 0x01010101))


class Cues(typing.NamedTuple):
    """Inputs to the matching cost for each pixel of an image; C-contiguous arrays [H, W].

    Attributes:
        grey: uint8, grey levels, which determine the penalty for large disparity steps.
        census: uint32, one bit for each of the 24 surrounding pixels, set if that pixel is darker.
        levels: uint8 [H, C, W], the three colours, or the grey levels.
        darkest: uint8 [H, C, W], least level within half a pixel to either side.
        brightest: uint8 [H, C, W], greatest level within half a pixel to either side.
        prior: uint16, the network's disparity minus first_px in 1/SUBSTEPS px, up to 8191 px.
        trust: uint16, weight of the prior, 0..MOST_TRUST.
    """

    grey: np.ndarray
    census: np.ndarray
    levels: np.ndarray
    darkest: np.ndarray
    brightest: np.ndarray
    prior: np.ndarray
    trust: np.ndarray


class Search(typing.NamedTuple):
    """The candidates that are searched: those of each pixel from its tile's first one on.

    Attributes:
        places: int64 [H, W], start of each pixel's candidates in the volumes; -1 where the network's
            disparity is not searched.
        firsts: int32, first candidate of each tile.
    """

    places: np.ndarray
    firsts: np.ndarray


@kernel
@typing.no_type_check
def census(grey, codes):
    """Write each pixel's 5x5 census code into codes: one bit per neighbour, set if it is darker."""
    height, width = grey.shape
    # A row with copies of its ends, so that the innermost loop can be vectorised.
    row = np.empty(width + 2 * _CENSUS_RADIUS, np.uint8)
    for y in range(height):
        codes[y] = 0
        for dy in range(-_CENSUS_RADIUS, _CENSUS_RADIUS + 1):
            around = grey[min(max(y + dy, 0), height - 1)]
            for x in range(_CENSUS_RADIUS):
                row[x], row[width + _CENSUS_RADIUS + x] = around[0], around[width - 1]
            for x in range(width):
                row[_CENSUS_RADIUS + x] = around[x]
            for i in range(2 * _CENSUS_RADIUS + 1):
                if dy != 0 or i != _CENSUS_RADIUS:
                    for x in range(width):
                        darker = np.uint32(row[x + i] < grey[y, x])
                        codes[y, x] = np.uint32((codes[y, x] << _ONE) | darker)


@inlined
@typing.no_type_check
def bits(code):
    """Return the number of set bits in a 32-bit code."""
    pairs = np.uint32(code - ((code >> _ONE) & _PAIRS))
    fours = np.uint32((pairs & _FOURS) + ((pairs >> _TWO) & _FOURS))
    count = np.uint32(np.uint32(((fours + (fours >> _FOUR)) & _EIGHTS) * _SUM) >> _TOP)
    # The limit is never exceeded. It keeps LLVM from joining this shift with the caller's arithmetic, so that
    # LLVM recognises a count of bits, for which recent processors have an instruction.
    return np.int32(min(count, _WORD))


@inlined
@typing.no_type_check
def _outside(level, dark, bright):
    """Return the distance between a level and the interval dark..bright."""
    return max(np.uint8(max(level, bright) - bright), np.uint8(dark - min(level, dark)))


@inlined
@typing.no_type_check
def _difference(level, dark, bright, there, dark_there, bright_there):
    """Return the truncated, sampling-insensitive difference of a channel (Birchfield and Tomasi 1998)."""
    nearest = min(_outside(level, dark_there, bright_there), _outside(there, dark, bright))
    return min(nearest, MOST_DIFFERENCE)


@inlined
@typing.no_type_check
def _add_differences(level, dark, bright, levels, darks, brights, kept, costs):
    """Add a channel's difference to each candidate's cost, of which the bits in the mask `kept` count.

    With a mask of 0 costs are overwritten, so they need not be initialised.
    """
    for i in range(costs.shape[0]):
        difference = _difference(level, dark, bright, levels[i], darks[i], brights[i])
        costs[i] = np.uint8(np.uint8(costs[i] & kept) + difference)


@inlined
@typing.no_type_check
def _pull(prior, trust, candidate):
    """Return the cost of a candidate's distance to the network's disparity.

    The cost is 0 up to a distance of 1 px and constant from 9 px.
    """
    away = np.uint16(max(prior, candidate) - min(prior, candidate))
    beyond = np.uint16(max(away, DOUBTLESS) - DOUBTLESS)
    return np.uint16(np.uint16(min(beyond, FARTHEST) * trust) >> _SIX)


@inlined
@typing.no_type_check
def _complete(weight, code, prior, trust, codes, priors, trusts, first, costs):
    """Multiply each candidate's cost by half the weight, and add what does not depend on colours.

    This is twice the Hamming distance between the census codes, and the cost of the candidate's distance to
    the network's disparities in both views.
    """
    for i in range(costs.shape[0]):
        difference = np.uint8(np.uint8(costs[i] * weight) >> np.uint8(1))
        candidate = np.uint16(SUBSTEPS * (first + i))
        pulls = _pull(prior, trust, candidate) + _pull(priors[i], trusts[i], candidate)
        costs[i] = np.uint8(difference + 2 * bits(code ^ codes[i]) + pulls)


@kernel
@typing.no_type_check
def find_least_priors(prior, least):
    """Write the least prior of each tile."""
    height, width = prior.shape
    least[:] = _HIGHEST
    for y in range(height):
        for x in range(width):
            tile = y // TILE_PX, x // TILE_PX
            least[tile] = min(least[tile], prior[y, x])


@kernel
@typing.no_type_check
def lay_out(searched, levels, search, total):
    """Write the places of the `searched` pixels' candidates, one pixel after the other, and their number."""
    height, width = searched.shape
    place = 0
    for y in range(height):
        for x in range(width):
            search.places[y, x] = place if searched[y, x] else -1
            if searched[y, x]:
                place += levels - search.firsts[y // TILE_PX, x // TILE_PX]
    total[0] = place


@kernel
@typing.no_type_check
def match(own, other, search, towards, levels, first, last, costs):
    """Write the matching costs (uint8) of the searched pixels of the image's rows first..last.

    towards is -1 for a left view, whose matches are to the left, and 1 for a right view. levels is the number
    of all candidates.
    """
    places, firsts = search
    width, channels = places.shape[1], own.levels.shape[1]
    weight = np.uint8(_COLOURS // channels)
    for y in range(first, last):
        for x in range(width):
            place = places[y, x]
            if place < 0:
                continue
            skipped = firsts[y // TILE_PX, x // TILE_PX]
            count = levels - skipped
            start = skipped + (x if towards > 0 else width - 1 - x)
            end = start + count
            out = costs[place : place + count]
            for i in range(channels):
                _add_differences(
                    own.levels[y, i, x],
                    own.darkest[y, i, x],
                    own.brightest[y, i, x],
                    other.levels[y, i, start:end],
                    other.darkest[y, i, start:end],
                    other.brightest[y, i, start:end],
                    np.uint8(255 if i else 0),
                    out,
                )
            _complete(
                weight,
                own.census[y, x],
                own.prior[y, x],
                own.trust[y, x],
                other.census[y, start:end],
                other.prior[y, start:end],
                other.trust[y, start:end],
                skipped,
                out,
            )


@inlined
@typing.no_type_check
def _start(prior, path):
    """Write a path's costs at a pixel that is not searched: 0 within 1 px (DOUBTLESS) of it, else _NEVER."""
    for i in range(path.shape[0] - 2):
        candidate = np.uint16(SUBSTEPS * i)
        away = np.uint16(max(prior, candidate) - min(prior, candidate))
        path[i + 1] = np.uint16(0) if away <= DOUBTLESS else _NEVER


@inlined
@typing.no_type_check
def _close(path, first):
    """Write _NEVER to a path's costs of the candidates before `first`."""
    for i in range(first + 1):
        path[i] = _NEVER


@inlined
@typing.no_type_check
def _step(before, least, costs, large_step, after, kept, sums):
    """Advance a path by one pixel: write its costs into after, and return the least one.

    They are added to sums, of which the bits in the mask `kept` count. With a mask of 0 sums are overwritten,
    so they need not be initialised.
    """
    limit = np.uint16(least + large_step)
    lowest = _NEVER
    after[0] = _NEVER
    for i in range(costs.shape[0]):
        beside = np.uint16(min(before[i], before[i + 2]) + np.uint16(SMALL_STEP))
        cost = np.uint16(min(min(before[i + 1], beside), limit) - least + np.uint16(costs[i]))
        after[i + 1] = cost
        sums[i] = np.uint16(np.uint16(sums[i] & kept) + cost)
        lowest = min(lowest, cost)
    return lowest


@kernel
@typing.no_type_check
def along_rows(costs, own, search, large_step, levels, first, last, sums):
    """Write the summed costs of the paths from the left and the right along the image's rows first..last.

    large_step [H, W] is the penalty for a large step from the previous pixel to each pixel. levels is the
    number of all candidates.
    """
    places, firsts = search
    width, size = places.shape[1], levels + 2
    # Both paths of a row advance in turn, so that the processor computes them at once.
    paths, leasts = np.empty((2, 2, size), np.uint16), np.empty(2, np.uint16)
    for y in range(first, last):
        paths[:] = 0
        paths[:, :, 0] = paths[:, :, levels + 1] = _NEVER
        leasts[:] = 0
        for i in range(width):
            for backwards in range(2):
                x = width - 1 - i if backwards else i
                place = places[y, x]
                if place < 0:
                    continue
                skipped = firsts[y // TILE_PX, x // TILE_PX]
                before, after = paths[backwards, i & 1], paths[backwards, 1 - (i & 1)]
                x_before = x - 1 + 2 * backwards
                if i > 0 and places[y, x_before] < 0:
                    _start(own.prior[y, x_before], before)
                    leasts[backwards] = 0
                elif i > 0 and x_before // TILE_PX != x // TILE_PX:
                    _close(before, firsts[y // TILE_PX, x_before // TILE_PX])
                end = place + levels - skipped
                is_first = 2 * i + backwards < width  # of the two paths here
                leasts[backwards] = _step(
                    before[skipped:],
                    leasts[backwards],
                    costs[place:end],
                    large_step[y, min(x + backwards, width - 1)],
                    after[skipped:],
                    _NOTHING if is_first else _HIGHEST,
                    sums[place:end],
                )


@inlined
@typing.no_type_check
def _between(before, here, after):
    """Return the offset, -0.5..0.5 px, at which two lines of opposite slope through three costs meet."""
    rise = max(np.int32(before), np.int32(after)) - np.int32(here)
    return 0.5 * (np.int32(before) - np.int32(after)) / rise if rise > 0 else 0.0


@inlined
@typing.no_type_check
def _find_least(costs):
    """Return the candidate of least cost (uint16), with a subpixel offset."""
    count = costs.shape[0]
    # Cost and candidate in one number, so that a single loop, which can be vectorised, finds both.
    least = _LARGEST
    for i in range(count):
        least = min(least, np.uint32((np.uint32(costs[i]) << _HALF) | np.uint32(i)))
    i = np.int64(least & _LOW)
    return i + (_between(costs[i - 1], costs[i], costs[i + 1]) if 0 < i < count - 1 else 0.0)


@kernel
@typing.no_type_check
def pick(sums, first_px, first, last, found_px):
    """Write the disparities of least cost, with subpixel offsets, into rows first..last of found_px."""
    for y in range(first, last):
        for x in range(sums.shape[1]):
            found_px[y, x] = first_px + _find_least(sums[y, x])


@kernel
@typing.no_type_check
def along_columns(costs, own, search, large_step, levels, first_px, first, last, sums, found_px):
    """Add the paths from above and below along the image's columns first..last to sums.

    The disparities of least cost are written to the searched pixels of found_px.
    """
    places, firsts = search
    height, width, size = len(places), last - first, levels + 2
    # All paths are in one flat array, because Numba would count references to its rows, at every pixel.
    paths = np.empty(2 * width * size, np.uint16)
    least = np.empty(width, np.uint16)
    for backwards in range(2):
        for j in range(2 * width):
            paths[j * size : (j + 1) * size] = 0
            paths[j * size] = paths[(j + 1) * size - 1] = _NEVER
        least[:] = 0
        for i in range(height):
            y = height - 1 - i if backwards else i
            y_before = y - 1 + 2 * backwards
            y_step = min(y + backwards, height - 1)
            for j in range(width):
                x = first + j
                place = places[y, x]
                if place < 0:
                    continue
                skipped = firsts[y // TILE_PX, x // TILE_PX]
                before, after = ((i & 1) * width + j) * size, ((1 - (i & 1)) * width + j) * size
                if i > 0 and places[y_before, x] < 0:
                    _start(own.prior[y_before, x], paths[before : before + size])
                    least[j] = 0
                elif i > 0 and y_before // TILE_PX != y // TILE_PX:
                    _close(paths[before : before + size], firsts[y_before // TILE_PX, x // TILE_PX])
                end = place + levels - skipped
                least[j] = _step(
                    paths[before + skipped : before + size],
                    least[j],
                    costs[place:end],
                    large_step[y_step, x],
                    paths[after + skipped : after + size],
                    _HIGHEST,
                    sums[place:end],
                )
                if backwards:
                    found_px[y, x] = first_px + skipped + _find_least(sums[place:end])


@kernel
@typing.no_type_check
def mark_matches(disparity_px, found_px, matched):
    """Mark the right pixels that match left ones whose found disparity differs by more than PRECISE_PX."""
    height, width = found_px.shape
    for y in range(height):
        for x in range(width):
            found = found_px[y, x]
            if abs(found - disparity_px[y, x]) > PRECISE_PX:
                column = np.int64(np.rint(x - found))
                if 0 <= column < width:
                    matched[y, column] = True


@kernel
@typing.no_type_check
def settle(found_px, other_px, trust, towards, disparity_px, agreed):
    """Write to agreed the mask of pixels at which both views agree, and replace their disparities.

    The network's disparity is kept if its confidence `trust` is at least CERTAIN, or if it differs by at
    most PRECISE_PX. towards is -1 if the match of column x is at x - disparity, and 1 if it is at
    x + disparity.
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
    """Extend each row's first surface to the image border, over pixels that the other camera does not see.

    A surface is a run of RELIABLE_RUN pixels at which both views agree. It is extended if the matches of all
    pixels between the surface and the border are outside the other image. Disparities that are certain, or
    that differ from the surface by more than LARGEST_MOVE_PX, are kept.
    """
    height, width = agreed.shape
    for y in range(height):
        run, i = 0, 0
        while i < width and run < RELIABLE_RUN:
            run = run + 1 if agreed[y, i if towards < 0 else width - 1 - i] else 0
            i += 1
        margin = i - RELIABLE_RUN
        if run == RELIABLE_RUN:
            surface_px = disparity_px[y, margin if towards < 0 else width - 1 - margin]
            if margin <= surface_px + SLACK_PX:
                for i in range(margin):
                    x = i if towards < 0 else width - 1 - i
                    if trust[y, x] < CERTAIN and abs(surface_px - disparity_px[y, x]) <= LARGEST_MOVE_PX:
                        disparity_px[y, x] = surface_px
