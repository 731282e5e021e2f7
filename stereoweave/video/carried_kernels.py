"""Kernel that takes each pixel of a frame from one of two other frames (`carried_frames`)."""

import typing

import numpy as np

from stereoweave.system.jit import inlined, kernel
from stereoweave.video.temporal_kernels import SAME_PX, SAME_SHARE

RADIUS_PX = 2
"""Greatest distance of a window's pixels from its centre, along rows and columns."""
MOST_LEVELS = np.float32(40)
"""A pixel of a window counts at most this difference, because it may lie on another surface."""


class Source(typing.NamedTuple):
    """View of a matched frame from which pixels are taken.

    Attributes:
        grey: uint8 [H, W].
        disparity_px, confidence: float32 [H, W].
        places: int32 [H, W], index of the pixel of this frame that each pixel of the other frame shows.
    """

    grey: np.ndarray
    disparity_px: np.ndarray
    confidence: np.ndarray
    places: np.ndarray


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
    before_places, before_grey = before.places, before.grey
    before_disparity_px, before_confidence = before.disparity_px, before.confidence
    after_places, after_grey = after.places, after.grey
    after_disparity_px, after_confidence = after.disparity_px, after.confidence
    for y in range(height):
        for x in range(width):
            row, column = before_places[y, x] // width, before_places[y, x] % width
            later_row, later_column = after_places[y, x] // width, after_places[y, x] % width
            from_px, to_px = before_disparity_px[row, column], after_disparity_px[later_row, later_column]
            certain, later = before_confidence[row, column], after_confidence[later_row, later_column]
            part = np.float32(share)
            if abs(to_px - from_px) > SAME_PX + SAME_SHARE * abs(from_px):
                # Four comparisons in one loop, which takes half the time of four loops.
                place, later_place = x + towards * from_px, x + towards * to_px
                whole, later_whole = int(np.floor(place)), int(np.floor(later_place))
                past, later_past = np.float32(place - whole), np.float32(later_place - later_whole)
                centre = np.float32(own[y, x])
                apart = later_apart = np.float32(0)
                for dy in range(-RADIUS_PX, RADIUS_PX + 1):
                    here_row = min(max(y + dy, 0), height - 1)
                    from_row = min(max(row + dy, 0), height - 1)
                    to_row = min(max(later_row + dy, 0), height - 1)
                    for dx in range(-RADIUS_PX, RADIUS_PX + 1):
                        level = np.float32(own[here_row, min(max(x + dx, 0), width - 1)])
                        weight = weights[int(abs(level - centre))]
                        shown = np.float32(before_grey[from_row, min(max(column + dx, 0), width - 1)])
                        match = sample(other, here_row, whole + dx, past)
                        apart += weight * (differ(level, shown) + differ(level, match))
                        shown = np.float32(after_grey[to_row, min(max(later_column + dx, 0), width - 1)])
                        match = sample(other, here_row, later_whole + dx, later_past)
                        later_apart += weight * (differ(level, shown) + differ(level, match))
                part = np.float32(0) if apart <= later_apart else np.float32(1)
            disparity_px[y, x] = from_px + part * (to_px - from_px)
            confidence[y, x] = certain + part * (later - certain)


@kernel
@typing.no_type_check
def locate(motion, source, places):
    """Write the index of the pixel of another frame that each pixel shows to `places` [H, W].

    It is the point of `source` (`splat_kernels.splat`) where the camera's motion explains the image, else
    where optical flow leads.
    """
    to_before_px, explained, rests = motion.to_before_px, motion.explained, motion.rests
    height, width = places.shape
    for y in range(height):
        for x in range(width):
            i, j = y // 2, x // 2
            places[y, x] = source[y, x]
            if source[y, x] < 0 or not rests[i, j] or not explained[i, j]:
                row = min(max(int(round(y + to_before_px[i, j, 1])), 0), height - 1)
                column = min(max(int(round(x + to_before_px[i, j, 0])), 0), width - 1)
                places[y, x] = row * width + column


@inlined
@typing.no_type_check
def differ(level, other):
    """Return the difference of two grey levels, at most `MOST_LEVELS`."""
    return min(abs(level - other), MOST_LEVELS)


@inlined
@typing.no_type_check
def sample(image, row, column, past):
    """Return the grey level at a place between a column and the next one."""
    last = image.shape[1] - 1
    first = np.float32(image[row, min(max(column, 0), last)])
    second = np.float32(image[row, min(max(column + 1, 0), last)])
    return first + past * (second - first)
