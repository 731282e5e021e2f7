"""Numba kernels of `subpixel`; the plain reference is tests/helpers/plain_subpixel.py."""

import typing

import numpy as np

from stereoweave.system.jit import inlined, kernel

# Horizontal derivative without the blur of a Sobel filter.
_INNER_SLOPE, _OUTER_SLOPE = np.float32(8 / 12), np.float32(1 / 12)
_NONE, _QUARTER, _ONE, _TWO, _THREE = map(np.float32, (0, 0.25, 1, 2, 3))
# Weights of the nearer and the farther neighbour in interpolation to twice the size.
_NEAR, _FAR = np.float32(0.75), np.float32(0.25)
# (1 - x / n)^n is almost exp(-x); n is a power of two, reached by squaring.
_SQUARINGS, _POWER = 4, np.float32(16)
# Slope of the interpolation at a pixel, per difference of its two neighbours; at 0.5, errors are 1 % larger.
_STEEPNESS = np.float32(0.75)


@kernel
@typing.no_type_check
def smooth(padded_px, nearness, same_px, smooth_px):
    """Write the mean of the disparities around each pixel, weighted by nearness and similarity.

    Similarity is (1 - px^2 / (32 same_px^2))^16: within 0.02 of a Gaussian function, and faster.

    Args:
        padded_px: float32 [H + V - 1, W + U - 1], disparities with a margin.
        nearness: float32 [V, U], weights of the neighbours; V and U are odd.
        same_px: Standard deviation of similar disparities.
        smooth_px: float32 [H, W], receives the means.
    """
    height, width = smooth_px.shape
    rows, columns = nearness.shape
    narrow = _ONE / (_POWER * _TWO * np.float32(same_px) * np.float32(same_px))
    weights, sums_px = np.empty(width, np.float32), np.empty(width, np.float32)
    for y in range(height):
        own_px = padded_px[y + rows // 2, columns // 2 : columns // 2 + width]
        weights[:], sums_px[:] = _NONE, _NONE
        for v in range(rows):
            for u in range(columns):
                other_px = padded_px[y + v, u : u + width]
                _add_neighbours(own_px, other_px, nearness[v, u], narrow, weights, sums_px)
        for x in range(width):
            smooth_px[y, x] = own_px[x] + sums_px[x] / weights[x]


@inlined
@typing.no_type_check
def _add_neighbours(own_px, other_px, near, narrow, weights, sums_px):
    """Add each pixel's neighbour in one direction: its weight, and its weighted difference in disparity."""
    for x in range(own_px.shape[0]):
        away_px = other_px[x] - own_px[x]
        alike = max(_ONE - narrow * away_px * away_px, _NONE)
        for _ in range(_SQUARINGS):
            alike *= alike
        weight = near * alike
        weights[x] += weight
        sums_px[x] += weight * away_px


@kernel
@typing.no_type_check
def compare(here, there, given_px, smooth_px, same_px, gain, start_px, means):
    """Choose the disparities from which to start, and compare the images at these.

    The smooth disparity is chosen where it differs by less than same_px from the given one. The difference of
    the images is that of the warped right one, times gain, to the left one.

    Args:
        here: uint8 [H, W], grey left image; H and W are even.
        there: uint8 [H, W], grey right image.
        given_px: float32 [H, W], disparities.
        smooth_px: float32 [H / 2, W / 2], smooth disparities.
        same_px: Greatest difference.
        gain: Ratio of left to right contrast.
        start_px: float32 [H, W], receives the chosen disparities.
        means: float32 [H / 2, 4, W / 2], receives the means of slope, difference, slope * difference and
            slope^2 over blocks of 2x2 pixels.
    """
    height, width = given_px.shape
    coarse_px, fine_px = np.empty(width // 2 + 2, np.float32), np.empty(width, np.float32)
    levels, warped = np.empty(width + 4, np.float32), np.empty(width, np.float32)
    taps, slopes = np.empty((4, width), np.float32), np.empty(width, np.float32)
    means[:] = _NONE
    for y in range(height):
        _enlarge(smooth_px, y, coarse_px, fine_px)
        _choose(given_px[y], fine_px, np.float32(same_px), start_px[y])
        _widen(there[y], levels)
        _pick(levels, start_px[y], taps, warped)
        _interpolate(taps, np.float32(gain), warped)
        _widen(here[y], levels)
        _differentiate(levels, warped, slopes)
        _add_means(slopes, warped, means[y // 2])


@inlined
@typing.no_type_check
def _enlarge(values, y, row, fine):
    """Write row y of twice the size, by linear interpolation; `row` is a buffer with a margin of 1 pixel."""
    height, width = values.shape
    own = values[y // 2]
    other = values[min(max(y // 2 - 1 + 2 * (y % 2), 0), height - 1)]
    for x in range(width):
        row[x + 1] = _NEAR * own[x] + _FAR * other[x]
    row[0], row[width + 1] = row[1], row[width]
    for x in range(width):
        fine[2 * x] = _FAR * row[x] + _NEAR * row[x + 1]
        fine[2 * x + 1] = _NEAR * row[x + 1] + _FAR * row[x + 2]


@inlined
@typing.no_type_check
def _choose(given_px, smooth_px, same_px, start_px):
    """Write the smooth disparities where they differ by less than same_px from the given ones."""
    for x in range(given_px.shape[0]):
        start_px[x] = smooth_px[x] if abs(smooth_px[x] - given_px[x]) < same_px else given_px[x]


@inlined
@typing.no_type_check
def _widen(levels, wide):
    """Write a row of grey levels with two copies of its ends on each side."""
    width = levels.shape[0]
    for x in range(width):
        wide[x + 2] = levels[x]
    wide[0] = wide[1] = levels[0]
    wide[width + 2] = wide[width + 3] = levels[width - 1]


@inlined
@typing.no_type_check
def _pick(levels, disparity_px, taps, fractions):
    """Write the levels of the four pixels around each match, and its place between the inner two."""
    width = disparity_px.shape[0]
    for x in range(width):
        column = min(max(np.float32(x) - disparity_px[x], _NONE), np.float32(width - 1))
        first = np.int32(column)
        for i in range(4):
            # Numba need not check an unsigned index for being negative.
            taps[i, x] = levels[np.uint32(first + i + 1)]
        fractions[x] = column - np.float32(first)


@inlined
@typing.no_type_check
def _interpolate(taps, gain, values):
    """Replace the places in `values` by the levels there, times gain (cubic convolution)."""
    for x in range(values.shape[0]):
        a, b, c, d, t = taps[0, x], taps[1, x], taps[2, x], taps[3, x], values[x]
        start, end, step = _STEEPNESS * (c - a), _STEEPNESS * (d - b), c - b
        square, cube = _THREE * step - _TWO * start - end, start + end - _TWO * step
        values[x] = gain * (b + t * (start + t * (square + t * cube)))


@inlined
@typing.no_type_check
def _differentiate(levels, warped, slopes):
    """Write the slope of the left image's levels, and subtract them from those of the warped right one."""
    for x in range(warped.shape[0]):
        inner, outer = levels[x + 3] - levels[x + 1], levels[x + 4] - levels[x]
        slopes[x] = _INNER_SLOPE * inner - _OUTER_SLOPE * outer
        warped[x] -= levels[x + 2]


@inlined
@typing.no_type_check
def _add_means(slopes, differences, means):
    """Add the parts of two pixels each of a row to the means."""
    for i in range(means.shape[1]):
        slope, next_slope = slopes[2 * i], slopes[2 * i + 1]
        difference, next_difference = differences[2 * i], differences[2 * i + 1]
        means[0, i] += _QUARTER * (slope + next_slope)
        means[1, i] += _QUARTER * (difference + next_difference)
        means[2, i] += _QUARTER * (slope * difference + next_slope * next_difference)
        means[3, i] += _QUARTER * (slope * slope + next_slope * next_slope)


@kernel
@typing.no_type_check
def change(given_px, start_px, change_px, occluded, largest_px, least_px, first, end, found_px):
    """Write the changed disparities of rows first..end.

    Args:
        given_px: float32 [H, W], disparities, which are kept where they are occluded.
        start_px: float32 [H, W], disparities to change.
        change_px: float32 [H / 2, W / 2], their changes.
        occluded: uint8 [H, W], 1 for occluded pixels, else 0.
        largest_px: Greatest difference to the given disparities.
        least_px: Least disparity.
        first: First row.
        end: Row after the last.
        found_px: float32 [H, W], receives the disparities.
    """
    width = given_px.shape[1]
    coarse_px, fine_px = np.empty(width // 2 + 2, np.float32), np.empty(width, np.float32)
    largest, least = np.float32(largest_px), np.float32(least_px)
    for y in range(first, end):
        _enlarge(change_px, y, coarse_px, fine_px)
        for x in range(width):
            given = given_px[y, x]
            found = min(max(start_px[y, x] + fine_px[x], given - largest), given + largest)
            found_px[y, x] = given if occluded[y, x] else max(found, least)
