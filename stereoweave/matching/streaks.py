"""Smoothing of streaks in disparity at the border that only one camera sees."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float32

from stereoweave.stereo import Estimate


def smooth_streaks(estimate: Estimate) -> Estimate:
    """Smooth both disparity maps where a match would be outside the other picture.

    Nothing is matched there, so the disparities of neighbouring rows hardly agree. Each pixel there becomes
    the median of 11 pixels of its column; all others stay.
    """
    columns = np.arange(estimate.disparity_px.shape[1], dtype=np.float32)
    return replace(
        estimate,
        disparity_px=_smooth(estimate.disparity_px, columns),
        right_disparity_px=_smooth(estimate.right_disparity_px, columns[::-1]),
    )


def _smooth(
    disparity_px: Float32[np.ndarray, "h w"], most_px: Float32[np.ndarray, " w"]
) -> Float32[np.ndarray, "h w"]:
    """Smooth the disparities that are greater than their column's `most_px`."""
    from stereoweave.matching.streak_kernels import smooth  # it loads LLVM

    smoothed_px = disparity_px.copy()
    smooth(disparity_px, np.flatnonzero(disparity_px > most_px), smoothed_px)
    return smoothed_px
