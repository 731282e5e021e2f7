"""The fill of occluded pixels once more, pixel by pixel."""

import numpy as np


def plain_fill(disparity_px, occluded, seen):
    """The filled disparity [H, W], and where it was filled."""
    height, width = disparity_px.shape
    visible = ~occluded & seen
    row_px = disparity_px.copy()
    for y in range(height):
        for x in np.flatnonzero(~visible[y]):
            ends_px = [_end_px(disparity_px[y], visible[y], x, step) for step in (-1, 1)]
            row_px[y, x] = np.nanmin([*ends_px, np.inf])
            if np.isinf(row_px[y, x]):
                row_px[y, x] = disparity_px[y, x]
    found_px, filled = disparity_px.copy(), np.zeros(occluded.shape, bool)
    around = np.pad(row_px, 2, mode="edge")
    for y, x in np.argwhere(occluded):
        smooth_px = np.median(around[y : y + 5, x : x + 5])
        if abs(smooth_px - disparity_px[y, x]) <= 10 or not _is_between(disparity_px, visible, y, x):
            found_px[y, x], filled[y, x] = smooth_px, True
    return found_px, filled


def _end_px(row_px, visible, x, step):
    """The lower median of the visible ones among the 7 pixels at an end of the run around x, or NaN."""
    while 0 <= x < len(row_px) and not visible[x]:
        x += step
    columns = [column for column in range(x, x + 7 * step, step) if 0 <= column < len(row_px)]
    known_px = sorted(row_px[column] for column in columns if visible[column])
    return known_px[(len(known_px) - 1) // 2] if known_px else np.nan


def _is_between(disparity_px, visible, y, x):
    """Whether a disparity is between those visible at 11x11 places around, of every fourth row and column."""
    rows, columns = (
        4 * np.arange(max(at // 4 - 5, 0), min(at // 4 + 6, -(-size // 4)))
        for at, size in zip((y, x), disparity_px.shape, strict=True)
    )
    places = np.ix_(rows, columns)
    near_px = disparity_px[places][visible[places]]
    return near_px.size > 0 and near_px.min() <= disparity_px[y, x] <= near_px.max()
