"""Numba kernels of `fill_occluded`; the plain reference is tests/helpers/plain_occluded_fill.py."""

import typing

import numpy as np

from stereoweave.matching.median_kernels import make_median
from stereoweave.system.jit import inlined, kernel

END_PX = 7
"""The median of the visible ones of this many pixels represents one end of a run, because the first pixel
alone often mixes two surfaces."""
FAR_OFF_PX = np.float32(10.0)
"""The network's disparity is kept where it differs from the fill by more than this and lies within the range
of the surrounding visible disparities, because the fill is less accurate in this case."""
SPACING_PX = 4
"""The surroundings are points of a grid with this spacing."""
NO_PX = np.float32(3e38)
"""Stands for a missing disparity; none is farther from 0. The compiler assumes that there is no infinity."""
_move_median_first = make_median(END_PX, 1)


@kernel
@typing.no_type_check
def fill_rows(disparity_px, confidence, visible, row_px, beside):
    """Replace the values of invisible pixels by those of the background.

    The background is the farther of the two surfaces at the ends of the pixel's run of invisible pixels. In a
    row without visible pixels, each pixel keeps its own values.

    Args:
        disparity_px: float32 [H, W].
        confidence: float32 [H, W].
        visible: bool [H, W].
        row_px: float32 [H, W], a copy of the disparity, which is changed.
        beside: float32 [H, W], a copy of the confidence, which is changed.
    """
    height, width = visible.shape
    room = np.zeros(END_PX, np.float32)
    for y in range(height):
        start = _find(visible, False, y, 0)
        while start < width:
            end = _find(visible, True, y, start)
            px = _find_median(disparity_px, visible, y, start - 1, -1, room)
            other_px = _find_median(disparity_px, visible, y, end, 1, room)
            first, step = start - 1, -1
            if other_px < px:
                px, first, step = other_px, end, 1
            if px < NO_PX:
                trust = _find_median(confidence, visible, y, first, step, room)
                row_px[y, start:end], beside[y, start:end] = px, trust
            start = _find(visible, False, y, end)


@inlined
@typing.no_type_check
def _find(visible, wanted, y, x):
    """Return the first column from x on that is visible or not, as wanted; the width if there is none."""
    while x < visible.shape[1] and visible[y, x] != wanted:
        x += 1
    return x


@inlined
@typing.no_type_check
def _find_median(values, visible, y, first, step, room):
    """Return the lower median of the visible ones of END_PX pixels; NO_PX if the first is outside the image.

    The pixels are those at column `first`, `first` + step and so on. `room` holds END_PX values.
    """
    width = visible.shape[1]
    # The others count alternately as less and as greater than all, so that they do not move the median.
    other = -NO_PX
    for i in range(END_PX):
        x = first + i * step
        if 0 <= x < width and visible[y, x]:
            room[i] = values[y, x]
        else:
            room[i] = other
            other = -other
    _move_median_first(room)
    return room[0] if 0 <= first < width else NO_PX


@kernel
@typing.no_type_check
def settle(disparity_px, confidence, smooth_px, visible, occluded, range_px, filled_px, believed):
    """Smooth the fill of occluded pixels, or restore their disparity; restore all that is not occluded.

    Args:
        disparity_px: float32 [H, W], disparity before the fill.
        confidence: float32 [H, W], confidence before the fill.
        smooth_px: float32 [H, W], the smoothed fill.
        visible: bool [H, W], mask of the pixels that were not filled.
        occluded: bool [H, W].
        range_px: Least and greatest visible disparity around each point of the grid, float32.
        filled_px: float32 [H, W], disparity of the fill, changed in place.
        believed: float32 [H, W], its confidence, changed in place; confidences of 0 are restored.
    """
    farthest_px, nearest_px = range_px
    height, width = visible.shape
    for y in range(height):
        for x in range(width):
            if visible[y, x]:
                continue
            kept, own_px = not occluded[y, x], disparity_px[y, x]
            if abs(smooth_px[y, x] - own_px) > FAR_OFF_PX:
                cell = y // SPACING_PX, x // SPACING_PX
                kept |= farthest_px[cell] <= own_px <= nearest_px[cell]
            filled_px[y, x] = own_px if kept else smooth_px[y, x]
            if kept or confidence[y, x] == 0:
                believed[y, x] = confidence[y, x]
