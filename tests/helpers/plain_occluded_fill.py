"""Plain reference of `occlusion_fill`, pixel by pixel."""

import numpy as np


def plain_fill(disparity_px, confidence, occluded, seen):
    """Return filled disparity and confidence [H, W]."""
    visible = ~occluded & seen
    row_px, beside = disparity_px.copy(), confidence.copy()
    for y, x in np.argwhere(~visible):
        ends = [_end(disparity_px[y], confidence[y], visible[y], x, step) for step in (-1, 1)]
        known = [end for end in ends if end is not None]
        if known:
            row_px[y, x], beside[y, x] = min(known, key=lambda end: end[0])
    found_px, believed = disparity_px.copy(), confidence.copy()
    around = np.pad(row_px, 2, mode="edge")
    for y, x in np.argwhere(occluded):
        smooth_px = np.median(around[y : y + 5, x : x + 5])
        if abs(smooth_px - disparity_px[y, x]) <= 10 or not _is_between(disparity_px, visible, y, x):
            found_px[y, x] = smooth_px
            if confidence[y, x] > 0:
                believed[y, x] = 0.6 * confidence[y, x] + 0.4 * beside[y, x]
    return found_px, believed


def _end(row_px, confidence, visible, x, step):
    """Return lower medians of disparity and confidence over the visible ones of 7 pixels at a run's end."""
    while 0 <= x < len(row_px) and not visible[x]:
        x += step
    columns = [column for column in range(x, x + 7 * step, step) if 0 <= column < len(row_px)]
    known = [column for column in columns if visible[column]]
    if not known:
        return None
    return tuple(sorted(values[known])[(len(known) - 1) // 2] for values in (row_px, confidence))


def _is_between(disparity_px, visible, y, x):
    """Return whether a disparity is in the range of the visible ones on an 11x11 grid, 4 px apart."""
    rows, columns = (
        4 * np.arange(max(at // 4 - 5, 0), min(at // 4 + 6, -(-size // 4)))
        for at, size in zip((y, x), disparity_px.shape, strict=True)
    )
    places = np.ix_(rows, columns)
    near_px = disparity_px[places][visible[places]]
    return near_px.size > 0 and near_px.min() <= disparity_px[y, x] <= near_px.max()
