"""Smoothing of streaks in disparity at the border that only one camera sees."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from stereoweave.matching.medians import find_median
from stereoweave.stereo import Estimate

# Streaks are a few rows high, and depth edges there rarely follow the rows.
_ROWS = 11


def smooth_streaks(estimate: Estimate) -> Estimate:
    """Smooth both disparity maps where a match would be outside the other picture.

    Nothing is matched there, so the disparities of neighbouring rows hardly agree. Each pixel there becomes
    the median of 11 pixels of its column; all others stay.
    """
    left_px, right_px = estimate.disparity_px, estimate.right_disparity_px
    columns = np.arange(left_px.shape[1], dtype=np.float32)
    return replace(
        estimate,
        disparity_px=_take_median_of_columns(left_px, left_px > columns),
        right_disparity_px=_take_median_of_columns(right_px, right_px > columns[::-1]),
    )


def _take_median_of_columns(
    disparity_px: Float32[np.ndarray, "h w"], where: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    half, width = _ROWS // 2, disparity_px.shape[1]
    extended_px = cv2.copyMakeBorder(disparity_px, half, half, 0, 0, cv2.BORDER_REPLICATE)
    flat = np.flatnonzero(where)
    around_px = extended_px.ravel().take(flat + width * np.arange(_ROWS)[:, None])
    smoothed_px = disparity_px.copy()
    smoothed_px.ravel()[flat] = find_median(list(around_px))
    return smoothed_px
