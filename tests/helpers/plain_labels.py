"""Plain reference of `bench.classical.label_kernels`: sums by their definition, one label at a time."""

import numpy as np
from plain_trees import plain_similarities

OUTSIDE = 120


def plain_fronts(costs, parents, similarity, starts):
    """Return the best whole disparity at each place, and its aggregated cost."""
    sums = [
        plain_similarities(parents, similarity, start, end) @ costs[start:end].astype(float)
        for start, end in zip(starts[:-1], starts[1:], strict=True)
    ]
    whole = np.concatenate(sums)
    return whole.argmin(1), whole.min(1)


def plain_search(costs, places, at_pixel, forest, draws, labels, least):
    """Improve the labels [N, 3] and their aggregated costs [N] as `search_labels` does."""
    _, parents, similarity, starts = forest
    for tree, (start, end) in enumerate(zip(starts[:-1], starts[1:], strict=True)):
        alike = plain_similarities(parents, similarity, start, end)
        for k in range(draws.shape[1]):
            label = _propose(k, draws[tree, k], (start, end), places, at_pixel, labels)
            disparity_px = _on(label, places[start:end])
            sums = alike @ [_cost(*each) for each in zip(costs[start:end], disparity_px, strict=True)]
            better = start + np.flatnonzero(sums < least[start:end])
            least[better], labels[better] = sums[better - start], label


def _propose(k, draw, tree, places, at_pixel, labels):
    start, end = tree
    one, other, third = (start + int(number * (end - start)) for number in draw[:3])
    if k < 8:
        y, x = (int(at + (2 * number - 1) * 24) for at, number in zip(places[one], draw[1:3], strict=True))
        height, width = at_pixel.shape
        return labels[at_pixel[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]].copy()
    if k < 12:
        corners = [one, other, third]
        heights = [_on(labels[corner], places[corner]) for corner in corners]
        points = np.column_stack([places[corners][:, ::-1], np.ones(3)])
        if abs(np.linalg.det(points)) < 0.5:
            return np.array([0, 0, heights[0]])
        return np.linalg.solve(points, heights)
    scale = 1 / 2 ** (k - 12)
    y, x = places[one]
    a, b = labels[one, :2] + (2 * draw[2:4] - 1) * 0.5 * scale
    disparity_px = _on(labels[one], places[one]) + (2 * draw[1] - 1) * 8 * scale
    return np.array([a, b, disparity_px - a * x - b * y])


def _on(label, places):
    return label[0] * places[..., 1] + label[1] * places[..., 0] + label[2]


def _cost(costs, disparity_px):
    if not 0 <= disparity_px <= len(costs) - 1:
        return OUTSIDE
    return np.interp(disparity_px, np.arange(len(costs)), costs)
