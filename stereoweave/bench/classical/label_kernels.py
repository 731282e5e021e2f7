"""Numba kernels of `spanning_trees`; the plain reference is tests/helpers/plain_labels.py.

Pixels are in the places of a `trees.Forest`. A label (a, b, c) is the plane of disparity a * x + b * y + c.
"""

import typing

import numpy as np

from stereoweave.system.jit import compiled, inlined, kernel

OUTSIDE = np.float32(120)
"""Matching cost of a disparity outside the range, above that of any other."""
FROM_PLANES = 4
"""Proposals per sweep that are planes through the disparities of three of the tree's pixels."""
FROM_NEARBY = 8
"""Proposals per sweep that are the labels of pixels nearby."""
SHIFTS_PX = 8.0
"""Greatest change of disparity of the first changed label; each next one changes half as much."""
SLOPES = 0.5
"""Greatest change of slope of the first changed label."""
NEARBY_PX = 24
"""Farthest that a label comes from, along each axis."""
DRAWS = 4
"""Random numbers for each proposal."""


@kernel
@typing.no_type_check
def label_fronts(costs, parents, similarity, starts, labels, least):
    """Write the best label without slant, of whole px, and its aggregated cost, for each place.

    The aggregated cost is the sum of the matching costs over the tree, each times the similarities of all
    edges on the way (Yang 2012): once up to the root, once down again.

    Args:
        costs: uint8 [N, D], matching costs.
        parents: int32 [N], as the next two in `trees.Forest`.
        similarity: float32 [N].
        starts: int64 [T + 1].
        labels: float32 [N, 3].
        least: float32 [N].
    """
    count = costs.shape[1]
    longest = 0
    for tree in range(starts.shape[0] - 1):
        longest = max(longest, starts[tree + 1] - starts[tree])
    sums = np.empty((longest, count), np.float32)
    for tree in range(starts.shape[0] - 1):
        start, pixels = starts[tree], starts[tree + 1] - starts[tree]
        for i in range(pixels):
            for candidate in range(count):
                sums[i, candidate] = costs[start + i, candidate]
        for i in range(pixels - 1, 0, -1):
            _add_scaled(sums[i], similarity[start + i], sums[parents[start + i] - start])
        for i in range(pixels):
            if i > 0:
                _come_down(sums[parents[start + i] - start], similarity[start + i], sums[i])
            best = 0
            for candidate in range(1, count):
                if sums[i, candidate] < sums[i, best]:
                    best = candidate
            labels[start + i, 0] = labels[start + i, 1] = 0
            labels[start + i, 2], least[start + i] = best, sums[i, best]


@inlined
@typing.no_type_check
def _add_scaled(child, similarity, parent):
    """Add a child's sums to its parent's."""
    for i in range(child.shape[0]):
        parent[i] += similarity * child[i]


@inlined
@typing.no_type_check
def _come_down(parent, similarity, child):
    """Turn a child's sums over what is below it into sums over the tree, given its parent's."""
    rest = np.float32(1) - similarity * similarity
    for i in range(child.shape[0]):
        child[i] = similarity * parent[i] + rest * child[i]


@compiled
@typing.no_type_check
def _disparity_px(label, place):
    return label[0] * place[1] + label[1] * place[0] + label[2]


@compiled
@typing.no_type_check
def _copy_nearby(labels, places, at_pixel, middle, draw, proposal):
    """Propose the label of a random pixel near place `middle`."""
    height, width = at_pixel.shape
    y = np.int64(places[middle, 0] + (2 * draw[1] - 1) * NEARBY_PX)
    x = np.int64(places[middle, 1] + (2 * draw[2] - 1) * NEARBY_PX)
    there = at_pixel[min(max(y, 0), height - 1), min(max(x, 0), width - 1)]
    for i in range(3):
        proposal[i] = labels[there, i]


@compiled
@typing.no_type_check
def _change(labels, places, middle, step, draw, proposal):
    """Propose the label of place `middle`, moved and turned there by up to 1 / 2**step of the range."""
    scale = 1.0 / (1 << step)
    disparity_px = _disparity_px(labels[middle], places[middle]) + (2 * draw[1] - 1) * SHIFTS_PX * scale
    proposal[0] = labels[middle, 0] + (2 * draw[2] - 1) * SLOPES * scale
    proposal[1] = labels[middle, 1] + (2 * draw[3] - 1) * SLOPES * scale
    proposal[2] = disparity_px - proposal[0] * places[middle, 1] - proposal[1] * places[middle, 0]


@compiled
@typing.no_type_check
def _lay_plane(labels, places, corners, proposal):
    """Propose the plane through the disparities at three places; level if they lie on a line."""
    one, other, third = corners
    origin_px = _disparity_px(labels[one], places[one])
    x1, y1 = places[other, 1] - places[one, 1], places[other, 0] - places[one, 0]
    x2, y2 = places[third, 1] - places[one, 1], places[third, 0] - places[one, 0]
    d1 = _disparity_px(labels[other], places[other]) - origin_px
    d2 = _disparity_px(labels[third], places[third]) - origin_px
    area = x1 * y2 - x2 * y1
    proposal[0] = proposal[1] = np.float32(0)
    if area != 0:
        proposal[0] = (d1 * y2 - d2 * y1) / area
        proposal[1] = (x1 * d2 - x2 * d1) / area
    proposal[2] = origin_px - proposal[0] * places[one, 1] - proposal[1] * places[one, 0]


@inlined
@typing.no_type_check
def _cost(costs, at, disparity_px):
    """Return a place's matching cost at a disparity, between those of the two nearest whole ones."""
    last = costs.shape[1] - 1
    if not 0 <= disparity_px <= last:
        return OUTSIDE
    below = min(np.int64(disparity_px), last - 1)
    share = disparity_px - np.float32(below)
    lower, upper = np.float32(costs[at, below]), np.float32(costs[at, below + 1])
    return lower + share * (upper - lower)


@compiled
@typing.no_type_check
def _try_label(proposal, costs, places, parents, similarity, start, sums, labels, least):
    """Aggregate a label's costs over the tree of `sums`, and keep it wherever they are the least so far."""
    a, b, c = proposal[0], proposal[1], proposal[2]
    pixels = sums.shape[0]
    for i in range(pixels):
        sums[i] = 0
    for i in range(pixels - 1, -1, -1):
        at = start + i
        sums[i] += _cost(costs, at, a * places[at, 1] + b * places[at, 0] + c)
        if i > 0:
            sums[parents[at] - start] += similarity[at] * sums[i]
    for i in range(pixels):
        at = start + i
        if i > 0:
            alike = similarity[at]
            sums[i] = alike * sums[parents[at] - start] + (np.float32(1) - alike * alike) * sums[i]
        if sums[i] < least[at]:
            least[at] = sums[i]
            labels[at, 0], labels[at, 1], labels[at, 2] = a, b, c


@kernel
@typing.no_type_check
def search_labels(costs, places, at_pixel, parents, similarity, starts, draws, labels, least):
    """Try random labels on each tree, one tree after the other, and keep the better ones.

    Proposals are labels of pixels nearby, then planes through three of the tree's pixels, then labels of the
    tree that are changed, by half as much each time.

    Args:
        costs: uint8 [N, D], matching costs.
        places: float32 [N, 2], row and column of the pixel at each place.
        at_pixel: int64 [H, W], place of each pixel.
        parents: int32 [N], as the next two in `trees.Forest`.
        similarity: float32 [N].
        starts: int64 [T + 1].
        draws: float64 [T, K, DRAWS], random numbers in [0, 1) for K proposals to each tree.
        labels: float32 [N, 3], which improve.
        least: float32 [N], their aggregated costs.
    """
    proposal = np.empty(3, np.float32)
    sums = np.empty(costs.shape[0], np.float32)
    for tree in range(starts.shape[0] - 1):
        start, pixels = starts[tree], starts[tree + 1] - starts[tree]
        for k in range(draws.shape[1]):
            draw = draws[tree, k]
            middle = start + np.int64(draw[0] * pixels)
            if k < FROM_NEARBY:
                _copy_nearby(labels, places, at_pixel, middle, draw, proposal)
            elif k < FROM_NEARBY + FROM_PLANES:
                second, third = start + np.int64(draw[1] * pixels), start + np.int64(draw[2] * pixels)
                _lay_plane(labels, places, (middle, second, third), proposal)
            else:
                _change(labels, places, middle, k - FROM_NEARBY - FROM_PLANES, draw, proposal)
            _try_label(proposal, costs, places, parents, similarity, start, sums[:pixels], labels, least)
