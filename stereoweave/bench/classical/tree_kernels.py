"""Numba kernels of `trees`; the plain reference is tests/helpers/plain_trees.py.

Pixels are numbered row by row. An edge joins two neighbours.
"""

import typing

import numpy as np

from stereoweave.system.jit import compiled, kernel


@compiled
@typing.no_type_check
def _find_root(owners, pixel):
    """Return the pixel that stands for a pixel's tree."""
    while owners[pixel] != pixel:
        owners[pixel] = owners[owners[pixel]]
        pixel = owners[pixel]
    return pixel


@kernel
@typing.no_type_check
def grow_trees(ends, weights, spread, least_pixels, most_pixels, pixels, chosen):
    """Mark the edges of the trees.

    The first round joins two trees (Felzenszwalb and Huttenlocher 2004) if the edge between them weighs no
    more than the heaviest edge within either of them, plus spread / its pixels, and if together they have
    most_pixels at most. The second round joins trees of fewer than least_pixels to a neighbour.

    Args:
        ends: int32 [E, 2], the pixels of each edge; edges are in ascending order of weight.
        weights: uint8 [E].
        spread: See above.
        least_pixels: See above.
        most_pixels: See above.
        pixels: Number of pixels.
        chosen: bool [E].
    """
    owners, sizes, heaviest = np.arange(pixels), np.ones(pixels, np.int64), np.zeros(pixels)
    for second in range(2):
        for i in range(weights.shape[0]):
            one, other = _find_root(owners, ends[i, 0]), _find_root(owners, ends[i, 1])
            if one == other:
                continue
            weight = np.float64(weights[i])
            limit = min(heaviest[one] + spread / sizes[one], heaviest[other] + spread / sizes[other])
            alike = weight <= limit and sizes[one] + sizes[other] <= most_pixels
            if alike or (second and min(sizes[one], sizes[other]) < least_pixels):
                chosen[i] = True
                if sizes[one] < sizes[other]:
                    one, other = other, one
                owners[other] = one
                sizes[one] += sizes[other]
                heaviest[one] = max(max(heaviest[one], heaviest[other]), weight)


@kernel
@typing.no_type_check
def order_trees(ends, weights, chosen, order, parents, to_parent):
    """Write the pixels tree by tree, each after its parent.

    Args:
        ends: int32 [E, 2], the pixels of each edge.
        weights: uint8 [E].
        chosen: bool [E], mask of the trees' edges.
        order: int32 [N], the pixel at each place.
        parents: int32 [N], the place of the parent of the pixel at each place; -1 for a root.
        to_parent: uint8 [N], weight of the edge to the parent; 0 for a root.
    """
    pixels = order.shape[0]
    counts = np.zeros(pixels, np.int64)
    beside, between = np.empty((pixels, 4), np.int64), np.empty((pixels, 4), np.uint8)
    for i in range(weights.shape[0]):
        if chosen[i]:
            for end in range(2):
                pixel = ends[i, end]
                beside[pixel, counts[pixel]], between[pixel, counts[pixel]] = ends[i, 1 - end], weights[i]
                counts[pixel] += 1
    seen = np.zeros(pixels, np.bool_)
    done = found = 0
    for root in range(pixels):
        if seen[root]:
            continue
        seen[root], order[found], parents[found], to_parent[found] = True, root, -1, 0
        found += 1
        while done < found:
            pixel = order[done]
            for i in range(counts[pixel]):
                child = beside[pixel, i]
                if not seen[child]:
                    seen[child], order[found], parents[found] = True, child, done
                    to_parent[found] = between[pixel, i]
                    found += 1
            done += 1
