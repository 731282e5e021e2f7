"""Filling of occluded pixels with the disparity of the background beside them."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from stereoweave.stereo import Estimate

_MEDIAN_PX = 5
# The surroundings of a pixel are this many rows and columns of a grid (`SPACING_PX`).
_AROUND = 11
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
    from stereoweave.matching.occlusion_fill_kernels import fill_rows, settle  # it loads LLVM

    disparity_px, confidence, occluded = estimate.disparity_px, estimate.confidence, estimate.occluded
    visible = ~occluded if left_seen is None else ~occluded & left_seen
    filled_px, believed = disparity_px.copy(), confidence.copy()
    fill_rows(disparity_px, confidence, visible, filled_px, believed)
    smooth_px = cv2.medianBlur(filled_px, _MEDIAN_PX)
    # In place, because a new array takes longer than the arithmetic.
    believed -= confidence
    believed *= _SHARE_BESIDE
    believed += confidence
    range_px = _find_range(disparity_px, visible)
    settle(disparity_px, confidence, smooth_px, visible, occluded, range_px, filled_px, believed)
    return replace(estimate, disparity_px=filled_px, confidence=believed)


def _find_range(
    disparity_px: Float32[np.ndarray, "h w"], visible: Bool[np.ndarray, "h w"]
) -> tuple[Float32[np.ndarray, "h2 w2"], Float32[np.ndarray, "h2 w2"]]:
    """Return the least and the greatest visible disparity around each pixel of a grid."""
    from stereoweave.matching.occlusion_fill_kernels import NO_PX, SPACING_PX

    some = np.s_[::SPACING_PX, ::SPACING_PX]
    known, some_px = visible[some], disparity_px[some]
    window = np.ones((_AROUND, _AROUND), np.uint8)
    farthest_px = cv2.erode(np.where(known, some_px, NO_PX), window)
    return farthest_px, cv2.dilate(np.where(known, some_px, -NO_PX), window)
