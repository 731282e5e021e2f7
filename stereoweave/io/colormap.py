"""Colour maps of disparity and confidence for the preview, the report and its legend."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

_OUTLIERS_PERCENT = 0.5
OCCLUDED_RGB = (217, 72, 15)


def find_colour_range_px(disparity_px: Float[np.ndarray, "h w"]) -> tuple[float, float]:
    """Return the disparities, in px, that the first and the last colour represent.

    The lowest and the highest half percent are ignored, so that a few outliers do not reduce the contrast.
    """
    low_px, high_px = np.percentile(disparity_px, [_OUTLIERS_PERCENT, 100 - _OUTLIERS_PERCENT])
    return float(low_px), max(float(high_px), float(low_px) + 1.0)


def colour_disparity(
    disparity_px: Float[np.ndarray, "h w"], range_px: tuple[float, float]
) -> UInt8[np.ndarray, "h w 3"]:
    """Return disparity as an RGB image [H, W, 3], from blue (the low end of `range_px`, far) to red."""
    low_px, high_px = range_px
    share = (disparity_px - low_px) / (high_px - low_px)
    levels = np.round(np.clip(share, 0, 1) * 255).astype(np.uint8)
    return cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)


def grey_confidence(confidence: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """Return confidence in 0..1 as a grey image [H, W]: 0 is black, 1 is white."""
    return np.round(confidence * 255).astype(np.uint8)


def colour_confidence(
    confidence: Float[np.ndarray, "h w"], occluded: Bool[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Return confidence as an RGB image [H, W, 3] in shades of grey, with occluded pixels in orange."""
    picture = np.repeat(grey_confidence(confidence)[..., None], 3, axis=2)
    picture[occluded] = OCCLUDED_RGB
    return picture


def legend_colours(count: int) -> list[str]:
    """Return `count` CSS colours, evenly spaced from the low end of the disparity colours to the high end."""
    ramp = colour_disparity(np.linspace(0, 1, count, dtype=np.float32)[None], (0.0, 1.0))[0]
    return [css_colour(tuple(rgb)) for rgb in ramp.tolist()]


def css_colour(rgb: tuple[int, ...]) -> str:
    """Return the CSS notation of an RGB colour."""
    return "rgb({},{},{})".format(*rgb)
