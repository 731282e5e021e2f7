"""Filling of occluded pixels with the disparity of the background beside them."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int

from stereoweave.matching.medians import find_median
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
    visible = ~estimate.occluded if left_seen is None else ~estimate.occluded & left_seen
    flat = np.flatnonzero(estimate.occluded)
    own_px, claimed = estimate.disparity_px.ravel()[flat], estimate.confidence.ravel()[flat]
    row_px, beside = _fill_rows(estimate, visible)
    filled_px = cv2.medianBlur(row_px, _MEDIAN_PX).ravel()[flat]
    kept = np.abs(filled_px - own_px) > _FAR_OFF_PX
    kept[kept] = _within_surroundings(estimate.disparity_px, visible, flat[kept])
    believed = claimed + _SHARE_BESIDE * (beside.ravel()[flat] - claimed)
    disparity_px, confidence = estimate.disparity_px.copy(), estimate.confidence.copy()
    disparity_px.ravel()[flat] = np.where(kept, own_px, filled_px)
    confidence.ravel()[flat] = np.where(kept | (claimed == 0), claimed, believed)
    return replace(estimate, disparity_px=disparity_px, confidence=confidence)


def _fill_rows(estimate: Estimate, visible: Bool[np.ndarray, "h w"]) -> Float32[np.ndarray, "2 h w"]:
    """Return disparity and confidence in which every invisible pixel has the values of the background.

    The background is the farther of the two surfaces at the ends of the pixel's run of invisible pixels. In a
    row without visible pixels, each pixel keeps its own values.
    """
    # Invisible pixels beside each row end its runs, so that runs and their ends are found without rows.
    beside = ((0, 0), (_END_PX, _END_PX))
    height, width = visible.shape
    maps = np.zeros((2, height, width + 2 * _END_PX), np.float32)
    maps[:, :, _END_PX:-_END_PX] = estimate.disparity_px, estimate.confidence
    flat_maps, seen = maps.reshape(2, -1), np.pad(visible, beside).ravel()
    gaps = np.pad(~visible & visible.any(axis=1, keepdims=True), beside).ravel()
    changes = 1 + np.flatnonzero(gaps[1:] != gaps[:-1])
    starts, ends = changes[::2], changes[1::2]
    left, right = _medians(flat_maps, seen, starts - 1, -1), _medians(flat_maps, seen, ends, 1)
    background = np.repeat(np.where(right[0] < left[0], right, left), ends - starts, axis=1)
    filled = np.flatnonzero(gaps)
    for values, found in zip(flat_maps, background, strict=True):
        values[filled] = found
    return maps[:, :, _END_PX:-_END_PX]


def _medians(
    maps: Float32[np.ndarray, "2 hw"],
    visible: Bool[np.ndarray, " hw"],
    flat: Int[np.ndarray, " n"],
    step: int,
) -> Float32[np.ndarray, "2 n"]:
    """Return the lower median of the visible ones of 7 pixels in a row; infinity if the first is not visible.

    Args:
        maps: Maps, each in row-major order.
        visible: Mask of visible pixels.
        flat: Index of the first pixel of each row of 7.
        step: Difference of the indices of successive pixels.
    """
    first, values = visible[flat], []
    # The others count alternately as less and as greater than all, so that they do not move the median.
    other = np.full(flat.shape, -np.inf, np.float32)
    for away in range(0, _END_PX * step, step):
        known = visible[flat + away]
        values.append(np.where(known, maps.take(flat + away, axis=1), other))
        other = np.where(known, other, -other)
    return np.where(first, find_median(values), np.float32(np.inf))


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
