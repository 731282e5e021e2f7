"""Plain reference of `bench.classical.tree_kernels` and of aggregation over trees, by its definition."""

import numpy as np


def plain_growth(ends, weights, spread, least_pixels, most_pixels, pixels):
    """Return the mask of the edges of the trees; edges are in ascending order of weight."""
    trees = [{pixel} for pixel in range(pixels)]
    heaviest = {frozenset(tree): 0 for tree in trees}
    chosen = np.zeros(len(weights), bool)
    for second in (False, True):
        for edge, (one, other) in enumerate(ends):
            tree, neighbour = (next(tree for tree in trees if end in tree) for end in (one, other))
            if tree is neighbour:
                continue
            limits = [heaviest[frozenset(part)] + spread / len(part) for part in (tree, neighbour)]
            alike = weights[edge] <= min(limits) and len(tree) + len(neighbour) <= most_pixels
            if alike or (second and min(len(tree), len(neighbour)) < least_pixels):
                chosen[edge] = True
                most = max(heaviest[frozenset(tree)], heaviest[frozenset(neighbour)], weights[edge])
                trees.remove(tree)
                trees.remove(neighbour)
                trees.append(tree | neighbour)
                heaviest[frozenset(tree | neighbour)] = most
    return chosen


def plain_similarities(parents, similarity, start, end):
    """Return the product of the similarities along the way between any two places of a tree [n, n]."""
    found = np.eye(end - start)
    for i in range(start + 1, end):
        # The way to an earlier place goes through the parent.
        row = found[parents[i] - start, : i - start] * similarity[i]
        found[i - start, : i - start] = found[: i - start, i - start] = row
    return found
