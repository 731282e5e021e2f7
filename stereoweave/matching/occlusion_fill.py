"""Filling of occluded pixels with the disparity of the background beside them."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int

from stereoweave.stereo import Estimate

# The median of this many visible pixels represents one end of a run, because the first pixel alone often
# mixes two surfaces.
_END_PX = 7
_MEDIAN_PX = 5
# The network's disparity is kept where it differs from the fill by more than this and lies within the range
# of the surrounding visible disparities, because the fill is less accurate in this case. The surroundings are
# 11x11 points of a grid with a spacing of 4 px.
_FAR_OFF_PX = 10.0
_SPACING_PX, _AROUND = 4, 11
# Weight of the background's confidence in a filled pixel; the remaining weight goes to the network's
# confidence. The weight is fitted to collages and rendered pairs: the network's confidence alone is 0.02 to
# 0.12 too low, and the mixture is off by 0.02 to 0.06.
_SHARE_BESIDE = np.float32(0.4)


def fill_occluded(estimate: Estimate, left_seen: Bool[np.ndarray, "h w"] | None = None) -> Estimate:
    """Fill occluded pixels with the disparity of the farther visible surface in their row.

    Visible pixels and the `occluded` mask do not change. A filled pixel's confidence moves towards the
    confidence of the surface that fills it, but a confidence of 0 stays 0.

    Args:
        estimate: The estimate to fill.
        left_seen: Mask of left pixels with content, from which occluded pixels may be filled; default: all.
    """
    occluded = estimate.occluded
    visible = ~occluded if left_seen is None else ~occluded & left_seen
    own_px, claimed = estimate.disparity_px[occluded], estimate.confidence[occluded]
    disparity_px, confidence = estimate.disparity_px.copy(), estimate.confidence.copy()
    disparity_px[~visible], confidence[~visible] = _background(estimate, visible)
    filled_px, beside = cv2.medianBlur(disparity_px, _MEDIAN_PX)[occluded], confidence[occluded]
    kept = np.abs(filled_px - own_px) > _FAR_OFF_PX
    rows, columns = np.nonzero(occluded)
    kept[kept] = _within_surroundings(estimate.disparity_px, visible, rows[kept], columns[kept])
    np.copyto(disparity_px, estimate.disparity_px)
    np.copyto(confidence, estimate.confidence)
    disparity_px[occluded] = np.where(kept, own_px, filled_px)
    believed = claimed + _SHARE_BESIDE * (beside - claimed)
    confidence[occluded] = np.where(kept | (claimed == 0), claimed, believed)
    return replace(estimate, disparity_px=disparity_px, confidence=confidence)


def _background(
    estimate: Estimate, visible: Bool[np.ndarray, "h w"]
) -> tuple[Float32[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
    """Return the background's disparity and confidence for each invisible pixel, in row-major order.

    The background is the farther of the two surfaces at the ends of the pixel's run of invisible pixels. In a
    row without visible pixels, each pixel keeps its own values.
    """
    occluded = np.pad(~visible, ((0, 0), (1, 1)))
    changes = np.flatnonzero(occluded.ravel()[1:] != occluded.ravel()[:-1])
    rows, columns = np.divmod(changes.reshape(-1, 2), occluded.shape[1])
    steps = np.arange(_END_PX)
    left, right = (rows[:, :1], columns[:, :1] - 1 - steps), (rows[:, 1:], columns[:, 1:] + steps)
    left_px, right_px = (_medians(estimate.disparity_px, visible, *end) for end in (left, right))
    left_confidence, right_confidence = (
        _medians(estimate.confidence, visible, *end) for end in (left, right)
    )
    from_right = np.isnan(left_px) | (right_px < left_px)
    lengths = np.diff(columns)[:, 0]
    farther_px = np.repeat(np.where(from_right, right_px, left_px), lengths)
    confidence = np.repeat(np.where(from_right, right_confidence, left_confidence), lengths)
    alone = np.isnan(farther_px)
    return (
        np.where(alone, estimate.disparity_px[~visible], farther_px),
        np.where(alone, estimate.confidence[~visible], confidence),
    )


def _medians(
    values: Float32[np.ndarray, "h w"],
    visible: Bool[np.ndarray, "h w"],
    rows: Int[np.ndarray, "n 1"],
    columns: Int[np.ndarray, "n k"],
) -> Float32[np.ndarray, " n"]:
    """Return the lower median of the visible pixels among K columns of each row; NaN if there are none.

    Row i of `columns` [N, K] belongs to `rows[i]`.
    """
    last = values.shape[1] - 1
    at = rows, columns.clip(0, last)
    known = (columns >= 0) & (columns <= last) & visible[at]
    ordered = np.sort(np.where(known, values[at], np.float32(np.nan)), axis=1)
    middle = np.maximum(known.sum(axis=1) - 1, 0) // 2
    return ordered[np.arange(len(middle)), middle]


def _within_surroundings(
    disparity_px: Float32[np.ndarray, "h w"],
    visible: Bool[np.ndarray, "h w"],
    rows: Int[np.ndarray, " n"],
    columns: Int[np.ndarray, " n"],
) -> Bool[np.ndarray, " n"]:
    """Return whether each pixel's disparity lies within the range of the visible disparities around it."""
    some = np.s_[::_SPACING_PX, ::_SPACING_PX]
    known, some_px = visible[some], disparity_px[some]
    window = np.ones((_AROUND, _AROUND), np.uint8)
    at = rows // _SPACING_PX, columns // _SPACING_PX
    farthest_px = cv2.erode(np.where(known, some_px, np.float32(np.inf)), window)[at]
    nearest_px = cv2.dilate(np.where(known, some_px, np.float32(-np.inf)), window)[at]
    own_px = disparity_px[rows, columns]
    return (own_px >= farthest_px) & (own_px <= nearest_px)
