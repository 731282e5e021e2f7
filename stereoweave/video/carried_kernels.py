"""Kernel that takes each pixel of a frame from one of two other frames (`carried_frames`)."""

import typing

import numpy as np

from stereoweave.system.jit import inlined, kernel
from stereoweave.video.temporal_filter import SAME_PX, SAME_SHARE

RADIUS_PX = 3
"""Greatest distance of a window's pixels from its centre, along rows and columns."""
MOST_LEVELS = 40.0
"""A pixel of a window counts at most this difference, because it may lie on another surface."""


class Source(typing.NamedTuple):
    """View of a matched frame from which pixels are taken.

    Attributes:
        grey: uint8 [H, W].
        disparity_px, confidence: float32 [H, W].
        to_source_px: float32 [H2, W2, 2], offset from every second pixel to its position in this frame.
    """

    grey: np.ndarray
    disparity_px: np.ndarray
    confidence: np.ndarray
    to_source_px: np.ndarray


@kernel
@typing.no_type_check
def take_pixels(own, other, towards, before, after, share, weights, disparity_px, confidence):
    """Write the disparity and confidence of the view `own`, taken from two `Source` frames.

    Where both sources show the same surface, values are interpolated in time. Elsewhere, the source wins
    whose image and whose match in the other view resemble the window around the pixel more.

    `own` and `other` are both views of the frame, uint8 [H, W]; `towards` is -1 if `own` is the left one,
    else 1. `share` is the time of the frame between the sources, from 0 to 1. `weights` [256] is the weight
    of a window's pixel by its grey difference from the centre.
    """
    height, width = own.shape
    before_to_px, before_grey = before.to_source_px, before.grey
    before_disparity_px, before_confidence = before.disparity_px, before.confidence
    after_to_px, after_grey = after.to_source_px, after.grey
    after_disparity_px, after_confidence = after.disparity_px, after.confidence
    for y in range(height):
        for x in range(width):
            i, j = y // 2, x // 2
            row = min(max(int(round(y + before_to_px[i, j, 1])), 0), height - 1)
            column = min(max(int(round(x + before_to_px[i, j, 0])), 0), width - 1)
            later_row = min(max(int(round(y + after_to_px[i, j, 1])), 0), height - 1)
            later_column = min(max(int(round(x + after_to_px[i, j, 0])), 0), width - 1)
            from_px, to_px = before_disparity_px[row, column], after_disparity_px[later_row, later_column]
            certain, later = before_confidence[row, column], after_confidence[later_row, later_column]
            part = share
            if abs(to_px - from_px) > SAME_PX + SAME_SHARE * abs(from_px):
                apart = measure_unlikeness(own, before_grey, weights, y, x, row, column)
                apart += measure_mismatch(own, other, weights, y, x, towards * from_px)
                later_apart = measure_unlikeness(own, after_grey, weights, y, x, later_row, later_column)
                later_apart += measure_mismatch(own, other, weights, y, x, towards * to_px)
                part = 0.0 if apart <= later_apart else 1.0
            disparity_px[y, x] = from_px + part * (to_px - from_px)
            confidence[y, x] = certain + part * (later - certain)


@inlined
@typing.no_type_check
def measure_unlikeness(own, source, weights, y, x, row, column):
    """Return the weighted difference of the window at (y, x) from the window at (row, column) of a source."""
    height, width = own.shape
    total = np.float32(0)
    for dy in range(-RADIUS_PX, RADIUS_PX + 1):
        own_row, source_row = min(max(y + dy, 0), height - 1), min(max(row + dy, 0), height - 1)
        for dx in range(-RADIUS_PX, RADIUS_PX + 1):
            here = own[own_row, min(max(x + dx, 0), width - 1)]
            there = source[source_row, min(max(column + dx, 0), width - 1)]
            weight = weights[abs(int(here) - int(own[y, x]))]
            total += weight * min(abs(np.float32(here) - np.float32(there)), np.float32(MOST_LEVELS))
    return total


@inlined
@typing.no_type_check
def measure_mismatch(own, other, weights, y, x, offset_px):
    """Return the weighted difference of the window at (y, x) from the other view's, offset by px."""
    height, width = own.shape
    whole = int(np.floor(x + offset_px))
    part = np.float32(x + offset_px - whole)
    total = np.float32(0)
    for dy in range(-RADIUS_PX, RADIUS_PX + 1):
        row = min(max(y + dy, 0), height - 1)
        for dx in range(-RADIUS_PX, RADIUS_PX + 1):
            here = own[row, min(max(x + dx, 0), width - 1)]
            first = np.float32(other[row, min(max(whole + dx, 0), width - 1)])
            second = np.float32(other[row, min(max(whole + dx + 1, 0), width - 1)])
            there = first + part * (second - first)
            weight = weights[abs(int(here) - int(own[y, x]))]
            total += weight * min(abs(np.float32(here) - there), np.float32(MOST_LEVELS))
    return total
