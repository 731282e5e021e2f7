"""Written-out references of GA-Net's two layers, one cost at a time."""

import numpy as np

# Directions of the paths, (row, column), in the order of the weights.
DIRECTIONS = ((1, 0), (-1, 0), (0, 1), (0, -1))


def plain_semi_global(costs, weights):
    """Aggregate costs [C, D, H, W] with weights [4, C, 5, H, W], whose magnitudes add up to 1."""
    channels, levels, height, width = costs.shape
    found = np.full((len(DIRECTIONS), *costs.shape), np.nan)
    for direction, (down, right) in enumerate(DIRECTIONS):
        rows = range(height) if down >= 0 else range(height)[::-1]
        columns = range(width) if right >= 0 else range(width)[::-1]
        for c in range(channels):
            for y in rows:
                for x in columns:
                    before = y - down, x - right
                    inside = 0 <= before[0] < height and 0 <= before[1] < width
                    for d in range(levels):
                        own = costs[c, d, y, x]
                        path = found[direction, c, :, *before] if inside else None
                        terms = (
                            own,
                            own if path is None else path[d],
                            own if path is None or d == 0 else path[d - 1],
                            own if path is None or d == levels - 1 else path[d + 1],
                            own if path is None else max(path),
                        )
                        shares = weights[direction, c, :, y, x]
                        found[direction, c, d, y, x] = sum(
                            share * term for share, term in zip(shares, terms, strict=True)
                        )
    return found.max(0)


def plain_local(costs, weights):
    """Filter costs [D, H, W] with weights [3, 5, 5, H, W], whose magnitudes add up to 1."""
    levels, height, width = costs.shape
    found = np.zeros_like(costs)
    for d, y, x in np.ndindex(costs.shape):
        for k, i, j in np.ndindex(3, 5, 5):
            place = d + k - 1, y + i - 2, x + j - 2
            inside = all(0 <= at < size for at, size in zip(place, (levels, height, width), strict=True))
            found[d, y, x] += weights[k, i, j, y, x] * costs[place if inside else (d, y, x)]
    return found
