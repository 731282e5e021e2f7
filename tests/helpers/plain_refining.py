"""Plain NumPy reference of `refine_kernels`: one candidate, direction and row at a time."""

import numpy as np

OUTSIDE = 65535


def plain_costs(own, other, first_px, count):
    """Return each candidate's matching cost [H, W, D]; `own` and `other` are `Cues`."""
    height, width = own.grey.shape
    volume = np.empty((height, width, count), int)
    here = type(own)(*(cue.astype(int) for cue in own))
    for i in range(count):
        columns = np.clip(np.arange(width) - first_px - i, 0, width - 1)
        there = type(own)(*(cue[..., columns].astype(int) for cue in other))
        one = np.maximum(here.levels - there.brightest, there.darkest - here.levels)
        two = np.maximum(there.levels - here.brightest, here.darkest - there.levels)
        differences = np.clip(np.minimum(one, two), 0, 40).sum(1) * (3 // one.shape[1])
        bits = np.bitwise_count(here.census ^ there.census)
        pulls = (np.clip(abs(view.prior - 8 * i) - 8, 0, 64) * view.trust // 64 for view in (here, there))
        volume[..., i] = 2 * bits + differences // 2 + sum(pulls)
    return volume


def plain_census(grey):
    """Return each pixel's census code: one bit per neighbour (24), set if the neighbour is darker."""
    around = np.pad(grey, 2, mode="edge")
    height, width = grey.shape
    codes = np.zeros(grey.shape, int)
    for place in range(25):
        if place != 12:
            dy, dx = divmod(place, 5)
            codes = 2 * codes + (around[dy : dy + height, dx : dx + width] < grey)
    return codes


def plain_candidates(prior, count):
    """Return the mask [H, W, D] of the candidates that are searched, given priors in eighths of a pixel.

    They begin at the least disparity of the tile of 32x32 pixels and of the eight around it.
    """
    height, width = prior.shape
    candidates = np.zeros((height, width, count), bool)
    for y in range(0, height, 32):
        for x in range(0, width, 32):
            around = prior[max(y - 32, 0) : y + 64, max(x - 32, 0) : x + 64].astype(int)
            first = max(around.min() // 8 - 4, 0) // 16 * 16
            candidates[y : y + 32, x : x + 32, first:] = True
    return candidates


def plain_sums(costs, own, searched):
    """Return each candidate's aggregated cost, the sum over paths from left, right, above and below.

    Candidates that are not searched have OUTSIDE or more. A path that comes from a pixel that is not
    `searched` begins there, at the prior, without a cost. `own` are `Cues`.
    """
    total = np.zeros(costs.shape, int)
    away = abs(own.prior[..., None].astype(int) - 8 * np.arange(costs.shape[2]))
    known = np.where(away <= 8, 0, OUTSIDE)
    closed = ~plain_candidates(own.prior, costs.shape[2])
    for axis in (0, 1):
        for backwards in (False, True):
            volumes = (costs, own.grey.astype(int), searched, known, closed, total)
            lines = [np.swapaxes(values, 0, axis) for values in volumes]
            if backwards:
                lines = [line[::-1] for line in lines]
            _add_path(*lines)
    return total


def _add_path(costs, grey, searched, known, closed, total):
    """Add the path down the first axis, all columns at once."""
    path = np.where(closed[0], OUTSIDE, costs[0])
    total[0] += path
    for y in range(1, len(costs)):
        path = np.where(searched[y - 1, :, None], path, known[y - 1])
        jump = np.maximum((125 / (1 + abs(grey[y] - grey[y - 1]).astype(np.float32) / 30)).astype(int), 30)
        least = path.min(1, keepdims=True)
        beside = np.pad(path, ((0, 0), (1, 1)), constant_values=OUTSIDE)
        ways = [
            path,
            beside[:, :-2] + 20,
            beside[:, 2:] + 20,
            np.broadcast_to(least + jump[:, None], path.shape),
        ]
        path = np.where(closed[y], OUTSIDE, costs[y] + np.min(ways, 0) - least)
        total[y] += path


def plain_pick(sums, first_px):
    """Return the disparities of least cost."""
    count = sums.shape[2]
    best = sums.argmin(2)
    inner = np.clip(best, 1, count - 2)
    before, here, after = (
        np.take_along_axis(sums, inner[..., None] + step, 2)[..., 0] for step in (-1, 0, 1)
    )
    rise = np.maximum(before, after) - here
    between = (inner == best) & (rise > 0) & (np.maximum(before, after) < OUTSIDE)
    part = np.where(between, 0.5 * (before - after) / np.maximum(rise, 1), 0)
    return first_px + best + part


def plain_settled(disparity_px, found_px, other_px, trust, towards):
    """Settle one view's disparity where both views agree, and extend it to the border."""
    width = disparity_px.shape[1]
    match = np.rint(np.arange(width) + towards * found_px).astype(int)
    there_px = np.take_along_axis(other_px, np.clip(match, 0, width - 1), axis=1)
    agreed = (match >= 0) & (match < width) & (abs(there_px - found_px) <= 1)
    change = agreed & (abs(disparity_px - found_px) > 1) & (trust < 0.85)
    settled_px = np.where(change, found_px, disparity_px)
    for y in range(len(settled_px)):
        row_px, known, sure = (values[y, ::-towards] for values in (settled_px, agreed, trust >= 0.85))
        runs = np.flatnonzero(np.convolve(known, np.ones(8), "valid") == 8)
        if len(runs) and runs[0] <= row_px[runs[0]] + 2:
            near = abs(row_px - row_px[runs[0]]) <= 24
            row_px[(np.arange(width) < runs[0]) & near & ~sure] = row_px[runs[0]]
    return settled_px
