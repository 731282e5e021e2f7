"""Left-right check: comparison of the two views' disparities."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped

OCCLUSION_STEP_PX = 1.0
"""Matching tolerance: a pixel is occluded if the surface at its match is nearer by more than this."""
# Edges of the right view's disparity are coarse (decision 0035), so a match may be four columns aside.
_ASIDE = np.ones((1, 9), np.uint8)
# Number of rows checked at once, because checking all of a 50-megapixel image would take another gigabyte.
_BAND_ROWS = 256


def find_occluded(
    disparity_px: Float[np.ndarray, "h w"], right_disparity_px: Float[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return the mask of left pixels whose match is outside the right image or behind a nearer surface."""
    occluded = np.empty(disparity_px.shape, bool)
    for top in range(0, len(occluded), _BAND_ROWS):
        rows = slice(top, top + _BAND_ROWS)
        occluded[rows] = is_occluded(*measure_disagreement(disparity_px[rows], right_disparity_px[rows]))
    return occluded


def measure_disagreement(
    disparity_px: Float[np.ndarray, "h w"], right_disparity_px: Float[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Return the views' disagreement in px at each left pixel, and whether its match is in the right image.

    The disagreement is the right disparity at the pixel's match minus the pixel's own disparity.
    """
    seen_px, inside = at_match(right_disparity_px, disparity_px, -1)
    return seen_px - disparity_px, inside


def is_occluded(
    disagreement_px: Float[np.ndarray, "h w"], inside: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return the mask of pixels that only the left camera sees, judging by the views' disagreement."""
    return ~inside | (disagreement_px > OCCLUSION_STEP_PX)


def find_contradicted(
    disparity_px: Float[np.ndarray, "h w"], right_disparity_px: Float[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return the mask of left pixels that are nearer than their match and the four columns on each side."""
    nearest_px = cv2.dilate(right_disparity_px, _ASIDE)
    disagreement_px, inside = measure_disagreement(disparity_px, nearest_px)
    return inside & (disagreement_px < -OCCLUSION_STEP_PX)


def at_match(
    values: Shaped[np.ndarray, "h w"], disparity_px: Float[np.ndarray, "h w"], direction: int
) -> tuple[Shaped[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Return the other view's value at each pixel's match, and whether the match is inside the other image.

    Matches outside the other image get the value of its border column.

    Args:
        values: Values of the other view, float32 or uint8.
        disparity_px: Disparity of this view.
        direction: -1 for the left view's disparity, whose matches are to the left; 1 for the right view's
            disparity.
    """
    height, width = disparity_px.shape
    columns = (np.arange(width, dtype=np.float32) + direction * disparity_px).astype(np.float32, copy=False)
    rows = np.broadcast_to(np.arange(height, dtype=np.float32)[:, None], columns.shape)
    seen = cv2.remap(values, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    return seen, (columns > -0.5) & (columns < width - 0.5)
