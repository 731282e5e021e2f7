"""Plain NumPy reference of `stereoweave/bench/mc_cnn`: one pixel or candidate at a time.

Candidates outside the right view have a cost of infinity.
"""

import numpy as np


def plain_costs(left, right, candidates):
    """Return minus the dot products of the vectors [H, W, C] of both views, as costs [H, W, D]."""
    height, width, _ = left.shape
    costs = np.full((height, width, candidates), np.inf)
    for y, x, d in np.ndindex(costs.shape):
        if d <= x:
            costs[y, x, d] = -sum(left[y, x].astype(float) * right[y, x - d])
    return costs


def plain_region(grey, y, x, distance, intensity):
    """Return the pixels of the cross-shaped region of (y, x)."""
    return {
        place
        for middle in _arm(grey, (y, x), (1, 0), distance, intensity)
        for place in _arm(grey, middle, (0, 1), distance, intensity)
    }


def _arm(grey, start, direction, distance, intensity):
    reached = [start]
    for sign in (-1, 1):
        for step in range(1, distance):
            place = tuple(np.add(start, np.multiply(direction, sign * step)))
            inside = 0 <= place[0] < grey.shape[0] and 0 <= place[1] < grey.shape[1]
            if not inside or (step > 1 and abs(grey[place] - grey[start]) >= intensity):
                break
            reached.append(place)
    return reached


def plain_aggregated(costs, left, right, distance, intensity):
    """Return the mean costs over {q in the left region of p with q - d in the right region of p - d}."""
    averaged = costs.copy()
    regions = [
        {(y, x): plain_region(grey, y, x, distance, intensity) for y, x in np.ndindex(grey.shape)}
        for grey in (left, right)
    ]
    for y, x, d in np.ndindex(costs.shape):
        if d <= x:
            there = {(row, column + d) for row, column in regions[1][y, x - d]}
            shared = regions[0][y, x] & there
            averaged[y, x, d] = np.mean([costs[row, column, d] for row, column in shared])
    return averaged


def plain_paths(costs, left, right, settings):
    """Return the mean of the four paths' costs, by the paper's recursion."""
    total = np.zeros(costs.shape)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        total += _path(costs, left, right, settings, dy, dx)
    return total / 4


def _path(costs, left, right, settings, dy, dx):
    height, width, count = costs.shape
    path = np.full(costs.shape, np.inf)
    for y in range(height) if dy >= 0 else range(height - 1, -1, -1):
        for x in range(width) if dx >= 0 else range(width - 1, -1, -1):
            row, column = y - dy, x - dx
            if not (0 <= row < height and 0 <= column < width):
                path[y, x] = costs[y, x]
                continue
            before = path[row, column]
            for d in range(min(count, x + 1)):
                edge = abs(left[y, x] - left[row, column]) >= settings.gradient
                other = column < d or abs(right[y, x - d] - right[row, column - d]) >= settings.gradient
                divisor = (1, settings.one_edge, settings.two_edges)[int(edge) + int(other)]
                step = settings.small_penalty / divisor / (settings.vertical if dy else 1)
                ways = [before[d], before.min() + settings.large_penalty / divisor]
                ways += [before[beside] + step for beside in (d - 1, d + 1) if 0 <= beside < count]
                path[y, x, d] = costs[y, x, d] - before.min() + min(ways)
    return path


def plain_replaced(left_px, right_px, candidates):
    """Return the disparities, with those that fail the left-right check taken from correct ones."""
    height, width = left_px.shape
    labels, filled_px = np.zeros(left_px.shape, int), left_px.copy()
    for y, x in np.ndindex(left_px.shape):
        agreeing = [d for d in range(min(candidates, x + 1)) if abs(d - right_px[y, x - d]) <= 1]
        labels[y, x] = 0 if left_px[y, x] in agreeing else 2 if agreeing else 1
    for y, x in zip(*labels.nonzero(), strict=True):
        if labels[y, x] == 1:
            columns = [c for c in (*range(x - 1, -1, -1), *range(x + 1, width)) if labels[y, c] == 0]
            found = [left_px[y, columns[0]]] if columns else []
        else:
            found = [value for angle in range(16) for value in _look(left_px, labels, y, x, angle)]
        if found:
            filled_px[y, x] = sorted(found)[len(found) // 2]
    return filled_px


def _look(left_px, labels, y, x, angle):
    """Return the first correct disparity in one of 16 directions, as a list; [] if there is none."""
    around = [0, 0.5, 1, 1, 1, 1, 1, 0.5, 0, -0.5, -1, -1, -1, -1, -1, -0.5]
    dy, dx = around[angle], around[(angle + 4) % 16]
    for step in range(1, sum(labels.shape)):
        row, column = int(np.floor(y + step * dy + 0.5)), int(np.floor(x + step * dx + 0.5))
        if not (0 <= row < labels.shape[0] and 0 <= column < labels.shape[1]):
            return []
        if labels[row, column] == 0:
            return [left_px[row, column]]
    return []


def plain_smoothed(disparity_px, sigma_px, threshold_px):
    """Return Gaussian-weighted means of the disparities within the threshold."""
    smoothed_px, radius = disparity_px.astype(float), int(np.ceil(3 * sigma_px))
    for y, x in np.ndindex(disparity_px.shape):
        total = share = 0.0
        for row, column in np.ndindex(disparity_px.shape):
            near = max(abs(row - y), abs(column - x)) <= radius
            if near and abs(disparity_px[row, column] - disparity_px[y, x]) < threshold_px:
                weight = np.exp(-((row - y) ** 2 + (column - x) ** 2) / (2 * sigma_px**2))
                total, share = total + weight * disparity_px[row, column], share + weight
        smoothed_px[y, x] = total / share
    return smoothed_px
