"""Numba kernels of GA-Net's two layers and of their gradients; guided_aggregation.py describes the layers.

Their plain twins are `follow_in_torch` and `filter_in_torch` there. Every inner loop is over a row of
pixels, so that the compiler can vectorise it.
"""

import typing

import numpy as np

from stereoweave.system.jit import inlined, kernel


@inlined
@typing.no_type_check
def _find_most(path, most, place):
    """Write the largest cost of each pixel of a path [D, M] to most, and its candidate to place."""
    for x in range(path.shape[1]):
        most[x], place[x] = path[0, x], 0
    for d in range(1, len(path)):
        for x in range(path.shape[1]):
            place[x] = d if path[d, x] > most[x] else place[x]
            most[x] = max(most[x], path[d, x])


@kernel
@typing.no_type_check
def follow(costs, weights, backwards, aggregated):
    """Aggregate costs [D, N, M] with weights [5, N, M] along N, or against it if backwards is 1."""
    levels, length, width = costs.shape
    most, place = np.empty(width, np.float32), np.empty(width, np.int32)
    own, same, lower, higher, best = weights
    step = -1 if backwards else 1
    first = length - 1 if backwards else 0
    for d in range(levels):
        for x in range(width):
            share = own[first, x] + same[first, x] + lower[first, x] + higher[first, x] + best[first, x]
            aggregated[d, first, x] = share * costs[d, first, x]
    for i in range(1, length):
        y = first + step * i
        before, here = aggregated[:, y - step], costs[:, y]
        _find_most(before, most, place)
        for d in range(levels):
            # A candidate outside the range has this pixel's own cost.
            below = before[d - 1] if d > 0 else here[d]
            above = before[d + 1] if d + 1 < levels else here[d]
            for x in range(width):
                kept = own[y, x] * here[d, x] + same[y, x] * before[d, x]
                moved = lower[y, x] * below[x] + higher[y, x] * above[x]
                aggregated[d, y, x] = kept + moved + best[y, x] * most[x]


@kernel
@typing.no_type_check
def follow_gradients(costs, weights, backwards, aggregated, gradient, costs_gradient, weights_gradient):
    """Write the gradients of `follow`, given that of its result. weights_gradient must be 0 before."""
    levels, length, width = costs.shape
    most, place = np.empty(width, np.float32), np.empty(width, np.int32)
    total, sums, carried = (
        np.empty((levels, width), np.float32),
        np.empty(width, np.float32),
        np.zeros((levels, width), np.float32),
    )
    own, same, lower, higher, best = weights
    to_own, to_same, to_lower, to_higher, to_best = weights_gradient
    step = -1 if backwards else 1
    first = length - 1 if backwards else 0
    for i in range(length - 1, -1, -1):
        y = first + step * i
        here = costs[:, y]
        sums[:] = 0
        for d in range(levels):
            for x in range(width):
                total[d, x] = gradient[d, y, x] + carried[d, x]
                sums[x] += total[d, x]
        if i == 0:
            break
        before = aggregated[:, y - step]
        _find_most(before, most, place)
        for d in range(levels):
            has_below, has_above = d > 0, d + 1 < levels
            below = before[d - 1] if has_below else here[d]
            above = before[d + 1] if has_above else here[d]
            from_above, from_below = total[min(d + 1, levels - 1)], total[max(d - 1, 0)]
            down, up = np.float32(has_above), np.float32(has_below)
            for x in range(width):
                own_share = own[y, x] + (1 - up) * lower[y, x] + (1 - down) * higher[y, x]
                costs_gradient[d, y, x] = own_share * total[d, x]
                moved = down * lower[y, x] * from_above[x] + up * higher[y, x] * from_below[x]
                carried[d, x] = same[y, x] * total[d, x] + moved
                to_own[y, x] += total[d, x] * here[d, x]
                to_same[y, x] += total[d, x] * before[d, x]
                to_lower[y, x] += total[d, x] * below[x]
                to_higher[y, x] += total[d, x] * above[x]
        for x in range(width):
            carried[place[x], x] += best[y, x] * sums[x]
            to_best[y, x] = most[x] * sums[x]
    for d in range(levels):
        for x in range(width):
            share = own[first, x] + same[first, x] + lower[first, x] + higher[first, x] + best[first, x]
            costs_gradient[d, first, x] = share * total[d, x]
            # All five shares are of the first pixel's own cost.
            for k in range(len(weights)):
                weights_gradient[k, first, x] += total[d, x] * costs[d, first, x]


@kernel
@typing.no_type_check
def filter_windows(padded, shares, filtered):
    """Sum costs [D + 2, H + 4, W + 4] over windows of 3x5x5 with shares [3, 5, 5, H, W]."""
    levels, height, width = filtered.shape
    for y in range(height):
        for d in range(levels):
            row = filtered[d, y]
            row[:] = 0
            for k in range(3):
                for i in range(5):
                    costs = padded[d + k, y + i]
                    for j in range(5):
                        share = shares[k, i, j, y]
                        for x in range(width):
                            row[x] += share[x] * costs[x + j]


@kernel
@typing.no_type_check
def filter_gradients(padded, shares, gradient, padded_gradient, shares_gradient):
    """Add the gradients of `filter_windows`, given that of its result."""
    levels, height, width = gradient.shape
    for y in range(height):
        for d in range(levels):
            given = gradient[d, y]
            for k in range(3):
                for i in range(5):
                    costs, to_costs = padded[d + k, y + i], padded_gradient[d + k, y + i]
                    for j in range(5):
                        share, to_share = shares[k, i, j, y], shares_gradient[k, i, j, y]
                        for x in range(width):
                            to_share[x] += given[x] * costs[x + j]
                        for x in range(width):
                            to_costs[x + j] += given[x] * share[x]
