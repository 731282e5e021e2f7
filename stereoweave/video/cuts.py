"""Cuts of a video: whether a frame shows the scene of a frame shortly before it."""

import math

import cv2
import numpy as np
from jaxtyping import UInt8

from stereoweave.video.motion import CUT_SHARE, convert_to_grey, measure_motion

# `CUT_SHARE` was measured at this width.
_MOST_WIDTH_PX = 320


def make_small_grey(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2"]:
    """Return a frame in grey, at half its size or less, in which cuts are looked for."""
    height, width = image.shape[:2]
    scale = max(2.0, width / _MOST_WIDTH_PX)
    size = math.ceil(width / scale), math.ceil(height / scale)
    return cv2.resize(convert_to_grey(image), size, interpolation=cv2.INTER_AREA)


def begins_shot(before: UInt8[np.ndarray, "h w"] | None, grey: UInt8[np.ndarray, "h2 w2"]) -> bool:
    """Return whether a shot begins at a frame, or between it and an earlier one; true if there is none.

    Args:
        before: The earlier frame, up to three frames before, from `make_small_grey`; None at the start.
        grey: The frame, from `make_small_grey`.
    """
    if before is None or before.shape != grey.shape:
        return True
    return measure_motion(before, grey).explained_share < CUT_SHARE
