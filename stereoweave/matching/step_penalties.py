"""Penalties of semi-global matching for large disparity steps between neighbouring pixels."""

import cv2
import numpy as np
from jaxtyping import UInt8

# Greatest between equal grey levels, and halved at this difference.
_LARGEST, _LEAST = 125, 30
_HALVING_LEVELS = 30
_BY_DIFFERENCE = np.maximum(_LARGEST / (1 + np.arange(256, dtype=np.float32) / _HALVING_LEVELS), _LEAST)


def penalise_large_steps(
    grey: UInt8[np.ndarray, "h w"], before: UInt8[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w"]:
    """Return the penalty for a large step between two pixels each, 30..125; it is lower at grey edges."""
    return cv2.LUT(cv2.absdiff(grey, before), _BY_DIFFERENCE.astype(np.uint8))
