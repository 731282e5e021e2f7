"""Penalties of semi-global matching for large disparity steps between neighbouring pixels."""

import cv2
import numpy as np
from jaxtyping import UInt8

# Greatest between equal grey levels, and halved at this difference.
_LARGEST, _LEAST = 125, 30
_HALVING_LEVELS = 30
_BY_DIFFERENCE = _LARGEST / (1 + np.arange(256, dtype=np.float32) / _HALVING_LEVELS)
_PENALTIES = np.maximum(_BY_DIFFERENCE, _LEAST).astype(np.uint8)


def penalise_large_steps(
    grey: UInt8[np.ndarray, "h w"], before: UInt8[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w"]:
    """Return each pixel's penalty for a large step from the one before, 30..125; lower at grey edges."""
    return cv2.LUT(cv2.absdiff(grey, before), _PENALTIES)
