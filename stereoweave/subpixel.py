"""An estimate that is right to about a pixel becomes one that is right to a small part of one."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from stereoweave.stereo import Estimate

_STEPS = 2
# What a step smooths before it compares: over this far, and not across steps of disparity above this.
_SMOOTH_PX, _SMOOTH_DISPARITY_PX = 3.0, 0.6
_WINDOW_SIGMA_PX = 2.25
_LARGEST_CHANGE_PX = 1.0
# The variance of a slope that noise alone gives, in grey levels squared: plain places stay as they are.
_PLAIN = 4.0
# The slope of a picture along its rows, without the blur of a Sobel filter.
_SLOPE = np.array([[1, -8, 0, 8, -1]], np.float32) / 12


def to_subpixel(
    left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"], estimate: Estimate
) -> Estimate:
    """The estimate with the left view's disparity moved by at most 1 px, to where the photographs agree best.

    Source: B. Lucas and T. Kanade, "An iterative image registration technique with an application to stereo
    vision", 1981: around each pixel least squares between the left view and the right one shifted by the
    disparity, after which the slopes say how much is missing. Two deviations: contrast is made alike and
    means within the window are taken off, so that a difference in exposure does not shift anything; and
    before every step the disparity is smoothed, not across edges, for neighbours that err to either side
    hold each other. What does not bring the photographs nearer to each other, and what the right camera
    does not see, stays.
    """
    here, there = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in (left, right))
    given_px = estimate.disparity_px.astype(np.float32)
    there *= _contrast(here, ~estimate.occluded) / _contrast(_shifted(there, given_px), ~estimate.occluded)
    found_px = given_px
    for _ in range(_STEPS):
        smooth_px = cv2.bilateralFilter(found_px, -1, _SMOOTH_DISPARITY_PX, _SMOOTH_PX)
        found_px = smooth_px + _missing_px(here, there, smooth_px)
        found_px = given_px + np.clip(found_px - given_px, -_LARGEST_CHANGE_PX, _LARGEST_CHANGE_PX)
    nearer = _unlikeness(here, there, found_px) <= _unlikeness(here, there, given_px)
    return replace(estimate, disparity_px=np.where(nearer & ~estimate.occluded, found_px, given_px))


def _contrast(image: Float32[np.ndarray, "h w"], seen: Bool[np.ndarray, "h w"]) -> float:
    """The standard deviation of what both see; 1 at least, for a picture without any."""
    return max(float(image[seen].std()), 1.0) if seen.any() else 1.0


def _missing_px(
    here: Float32[np.ndarray, "h w"],
    there: Float32[np.ndarray, "h w"],
    disparity_px: Float32[np.ndarray, "h w"],
) -> Float32[np.ndarray, "h w"]:
    """What least squares adds to a disparity."""
    slope = (cv2.filter2D(here, -1, _SLOPE) + _shifted(cv2.filter2D(there, -1, _SLOPE), disparity_px)) / 2
    difference = _shifted(there, disparity_px) - here
    mean = _window(slope)
    together = _window(slope * difference) - mean * _window(difference)
    return together / (_window(slope * slope) - mean * mean + _PLAIN)


def _unlikeness(
    here: Float32[np.ndarray, "h w"],
    there: Float32[np.ndarray, "h w"],
    disparity_px: Float32[np.ndarray, "h w"],
) -> Float32[np.ndarray, "h w"]:
    """The variance of the photographs' difference around each pixel."""
    difference = _shifted(there, disparity_px) - here
    return _window(difference * difference) - _window(difference) ** 2


def _shifted(
    image: Float32[np.ndarray, "h w"], disparity_px: Float32[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """What the right picture shows where each left pixel has its match."""
    columns = np.arange(image.shape[1], dtype=np.float32) - disparity_px
    rows = np.broadcast_to(np.arange(image.shape[0], dtype=np.float32)[:, None], columns.shape)
    return cv2.remap(image, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def _window(values: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    return cv2.GaussianBlur(values, (0, 0), _WINDOW_SIGMA_PX)
