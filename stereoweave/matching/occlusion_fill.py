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
    flat = np.flatnonzero(occluded)
    own_px, claimed = estimate.disparity_px.ravel()[flat], estimate.confidence.ravel()[flat]
    row_px, beside = _fill_rows(estimate, visible)
    filled_px = cv2.medianBlur(row_px, _MEDIAN_PX).ravel()[flat]
    kept = np.abs(filled_px - own_px) > _FAR_OFF_PX
    kept[kept] = _within_surroundings(estimate.disparity_px, visible, flat[kept])
    believed = claimed + _SHARE_BESIDE * (beside.ravel()[flat] - claimed)
    disparity_px, confidence = estimate.disparity_px.copy(), estimate.confidence.copy()
    disparity_px[occluded] = np.where(kept, own_px, filled_px)
    confidence[occluded] = np.where(kept | (claimed == 0), claimed, believed)
    return replace(estimate, disparity_px=disparity_px, confidence=confidence)


def _fill_rows(estimate: Estimate, visible: Bool[np.ndarray, "h w"]) -> Float32[np.ndarray, "2 h w"]:
    """Return disparity and confidence in which every invisible pixel has the values of the background.

    The background is the farther of the two surfaces at the ends of the pixel's run of invisible pixels. In a
    row without visible pixels, each pixel keeps its own values.
    """
    maps = np.stack([estimate.disparity_px, estimate.confidence])
    invisible = np.pad(~visible, ((0, 0), (1, 1)))
    changes = np.flatnonzero(invisible.ravel()[1:] != invisible.ravel()[:-1])
    rows, columns = np.divmod(changes.reshape(-1, 2), invisible.shape[1])
    steps = np.arange(_END_PX)
    left = _medians(maps, visible, rows[:, :1], columns[:, :1] - 1 - steps)
    right = _medians(maps, visible, rows[:, 1:], columns[:, 1:] + steps)
    farther = np.where(np.isnan(left[0]) | (right[0] < left[0]), right, left)
    background = np.repeat(farther, np.diff(columns)[:, 0], axis=1)
    known = ~np.isnan(background[0])
    maps.reshape(2, -1)[:, np.flatnonzero(~visible)[known]] = background[:, known]
    return maps


def _medians(
    maps: Float32[np.ndarray, "2 h w"],
    visible: Bool[np.ndarray, "h w"],
    rows: Int[np.ndarray, "n 1"],
    columns: Int[np.ndarray, "n k"],
) -> Float32[np.ndarray, "2 n"]:
    """Return the lower median of the visible pixels among K columns of each row; NaN if there are none.

    Row i of `columns` [N, K] belongs to `rows[i]`.
    """
    width = maps.shape[2]
    at = width * rows + columns.clip(0, width - 1)
    known = (columns >= 0) & (columns < width) & visible.ravel()[at]
    ordered = np.where(known, maps.reshape(2, -1).take(at, axis=1), np.float32(np.nan))
    ordered.sort(axis=2)
    middle = np.maximum(known.sum(axis=1) - 1, 0) // 2
    return ordered[:, np.arange(len(middle)), middle]


def _within_surroundings(
    disparity_px: Float32[np.ndarray, "h w"],
    visible: Bool[np.ndarray, "h w"],
    flat: Int[np.ndarray, " n"],
) -> Bool[np.ndarray, " n"]:
    """Return whether each pixel's disparity is in the range of the visible disparities around it.

    `flat` holds the pixels' indices in row-major order.
    """
    some = np.s_[::_SPACING_PX, ::_SPACING_PX]
    known, some_px = visible[some], disparity_px[some]
    window = np.ones((_AROUND, _AROUND), np.uint8)
    rows, columns = np.divmod(flat, disparity_px.shape[1])
    cell = rows // _SPACING_PX, columns // _SPACING_PX
    farthest_px = cv2.erode(np.where(known, some_px, np.float32(np.inf)), window)[cell]
    nearest_px = cv2.dilate(np.where(known, some_px, np.float32(-np.inf)), window)[cell]
    own_px = disparity_px.ravel()[flat]
    return (own_px >= farthest_px) & (own_px <= nearest_px)
