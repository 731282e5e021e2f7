"""OpenCV's matchers with the settings of OpenCV's sample program, hole filling and left-right confidence."""

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from stereoweave.stereo import StereoPair

MapMatch = Callable[[StereoPair], Float32[np.ndarray, "h w"]]
"""Returns the left disparity of a pair, in px [H, W]; values <= 0 are holes."""

LEAST_PX = np.float32(1e-3)
"""Smallest disparity of a matcher that compares candidates from 0 px on, because 0 means a hole."""
SGBM = "sgbm"
DISPARITIES = 192


def _make_sgbm(mode: int) -> MapMatch:
    """Create a semi-global block matcher over 192 disparities.

    The settings are those of OpenCV's sample program stereo_match.cpp at a block size of 5 (P1 = 8*3*5*5,
    P2 = 32*3*5*5), except for the speckle range. It is 2 instead of 32, as StereoSGBM's documentation
    recommends.
    """
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=DISPARITIES,
        blockSize=5,
        P1=600,
        P2=2400,
        disp12MaxDiff=1,
        preFilterCap=63,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
        mode=mode,
    )
    return lambda pair: _compute_padded(matcher, pair.left, pair.right)


def _make_bm() -> MapMatch:
    """Create a block matcher over 192 disparities.

    The settings are those of OpenCV's sample program, except for a speckle range of 2.
    """
    matcher = cv2.StereoBM.create(numDisparities=DISPARITIES, blockSize=9)
    matcher.setPreFilterCap(31)
    matcher.setTextureThreshold(10)
    matcher.setUniquenessRatio(15)
    matcher.setDisp12MaxDiff(1)
    matcher.setSpeckleWindowSize(100)
    matcher.setSpeckleRange(2)
    return lambda pair: _compute_padded(
        matcher, *(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (pair.left, pair.right))
    )


OPENCV_MATCHERS: dict[str, Callable[[], MapMatch]] = {
    SGBM: partial(_make_sgbm, cv2.STEREO_SGBM_MODE_SGBM),
    "sgbm_8_paths": partial(_make_sgbm, cv2.STEREO_SGBM_MODE_HH),
    "sgbm_3_way": partial(_make_sgbm, cv2.STEREO_SGBM_MODE_SGBM_3WAY),
    "bm": _make_bm,
}
"""Factories of OpenCV's matchers, by name."""


def fill_rows(disparity_px: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Fill each hole (<= 0) with the farther of the nearest known values to its left and right.

    A row without known values copies the row above; holes above the first row with known values remain.
    """
    known = disparity_px > 0
    occupied = known.max(axis=1)
    farther_px = np.minimum(
        _find_last_known(disparity_px, known),
        _find_last_known(disparity_px[:, ::-1], known[:, ::-1])[:, ::-1],
    )
    filled_px = np.where(known | ~occupied[:, None], disparity_px, farther_px)
    return filled_px[np.maximum.accumulate(np.where(occupied, np.arange(len(known)), 0))]


def left_right_confidence(
    disparity_px: Float32[np.ndarray, "h w"], right_disparity_px: Float32[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Return the negated left-right disagreement in px, which ranks pixels but is not a probability.

    The best value is 0. The result is minus infinity where either disparity is a hole (<= 0) or the match
    lies outside the right view.
    """
    width = disparity_px.shape[1]
    matches = np.rint(np.arange(width) - disparity_px).astype(int)
    seen_px = np.take_along_axis(right_disparity_px, matches.clip(0, width - 1), axis=1)
    known = (disparity_px > 0) & (seen_px > 0) & (matches >= 0)
    return np.where(known, -np.abs(disparity_px - seen_px), np.float32(-np.inf))


def _compute_padded(
    matcher: cv2.StereoMatcher, left: UInt8[np.ndarray, "h w *c"], right: UInt8[np.ndarray, "h w *c"]
) -> Float32[np.ndarray, "h w"]:
    # OpenCV leaves the first 192 columns empty, so pad the left border by that many.
    left, right = (
        cv2.copyMakeBorder(image, 0, 0, DISPARITIES, 0, cv2.BORDER_REPLICATE) for image in (left, right)
    )
    return matcher.compute(left, right)[:, DISPARITIES:].astype(np.float32) / 16


def _find_last_known(
    values: Float32[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Return the nearest known value at or to the left of each pixel; infinity if there is none."""
    columns = np.maximum.accumulate(np.where(known, np.arange(values.shape[1]), -1), axis=1)
    last = np.take_along_axis(values, np.maximum(columns, 0), axis=1)
    return np.where(columns >= 0, last, np.float32(np.inf))
