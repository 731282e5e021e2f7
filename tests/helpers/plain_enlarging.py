"""Plain NumPy reference of `upsample_kernels`: one candidate, path and pixel at a time."""

import numpy as np

BAND, MIDDLE = 16, 8
NEVER = 30000


def plain_costs(codes, grey, other_codes, other_grey, first):
    """Return each candidate's cost [H, W, 2, BAND]; `first` [H, W, 2] is the least disparity of each band."""
    height, width = grey.shape
    disparity_px = first[..., None].astype(int) + np.arange(BAND)
    columns = np.clip(np.arange(width)[:, None, None] - disparity_px, 0, width - 1)
    rows = np.arange(height)[:, None, None, None]
    bits = np.bitwise_count(codes[..., None, None] ^ other_codes[rows, columns]).astype(int)
    apart = abs(grey[..., None, None].astype(int) - other_grey[rows, columns])
    away_px = abs(np.arange(BAND) - MIDDLE)
    return 3 * bits + np.minimum(apart, 40) // 2 + 2 * np.clip(away_px - 1, 0, 7)


def plain_sums(costs, first, grey):
    """Return each candidate's aggregated cost, the sum over paths from left, right, above and below."""
    total = np.zeros(costs.shape, int)
    for axis in (0, 1):
        for backwards in (False, True):
            lines = [np.swapaxes(values, 0, axis) for values in (costs, first, grey.astype(int), total)]
            if backwards:
                lines = [line[::-1] for line in lines]
            for column in range(lines[0].shape[1]):
                _add_path(*(line[:, column] for line in lines))
    return total


def _add_path(costs, first, grey, total):
    path = costs[0]
    total[0] += path
    for i in range(1, len(costs)):
        jump = max(int(np.float32(125) / (1 + np.float32(abs(grey[i] - grey[i - 1])) / 30)), 30)
        least = path.min()
        ways = np.full(path.shape, least + jump)
        for band in range(2):
            before = dict(zip(range(first[i - 1, band], first[i - 1, band] + BAND), path[band], strict=True))
            for candidate in range(BAND):
                disparity_px = first[i, band] + candidate
                stay = before.get(disparity_px, NEVER)
                beside = min(before.get(disparity_px - 1, NEVER), before.get(disparity_px + 1, NEVER)) + 12
                ways[band, candidate] = min(ways[band, candidate], stay, beside)
        path = costs[i] + ways - least
        total[i] += path


def plain_pick(sums, first):
    """Return the disparities of least cost."""
    found_px = np.empty(first.shape[:2])
    for y, x in np.ndindex(found_px.shape):
        band, candidate = np.unravel_index(sums[y, x].argmin(), sums[y, x].shape)
        costs = sums[y, x, band]
        found_px[y, x] = first[y, x, band] + candidate
        if 0 < candidate < BAND - 1:
            before, after = costs[candidate - 1], costs[candidate + 1]
            rise = max(before, after) - costs[candidate]
            found_px[y, x] += 0.5 * (before - after) / rise if rise > 0 else 0
    return found_px


def plain_agreed(found_px, other_px):
    """Return the mask of pixels whose disparity agrees with the other view's disparity at their match."""
    agreed = np.zeros(found_px.shape, bool)
    for y, x in np.ndindex(found_px.shape):
        column = round(x - found_px[y, x])
        if 0 <= column < found_px.shape[1]:
            agreed[y, x] = abs(other_px[y, column] - found_px[y, x]) <= 1
    return agreed


def plain_filled(known, gap, farthest_px, nearest_px, disparity_px):
    """Fill gaps with the farther of the known disparities beside them."""
    filled_px = disparity_px.copy()
    for y, x in np.argwhere(~known & gap):
        columns = np.flatnonzero(known[y])
        beside = [*columns[columns < x][-1:], *columns[columns > x][:1]]
        if beside:
            beyond_px = disparity_px[y, beside].min()
            if farthest_px[y, x] - 8 <= beyond_px <= nearest_px[y, x] + 8:
                filled_px[y, x] = beyond_px
    return filled_px


def plain_hidden(disparity_px, right_disparity_px):
    """Return the mask of pixels whose match is outside the right image or behind a nearer surface."""
    hidden = np.ones(disparity_px.shape, bool)
    for y, x in np.ndindex(disparity_px.shape):
        column = round(x - disparity_px[y, x])
        if 0 <= column < disparity_px.shape[1]:
            hidden[y, x] = right_disparity_px[y, column] - disparity_px[y, x] > 1
    return hidden
