"""Left-right consistency check: what each view finds at the other view's match."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped

OCCLUSION_STEP_PX = 1.0
"""A nearer surface this much in front of a pixel's match hides it; less is the two views' disagreement."""
# Rows checked at once: a picture of 50 megapixels would need another gigabyte.
_BAND_ROWS = 256


def find_occluded(
    disparity_px: Float[np.ndarray, "h w"], right_disparity_px: Float[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Left pixels whose match is outside the right picture, or hidden there by a nearer surface."""
    occluded = np.empty(disparity_px.shape, bool)
    for top in range(0, len(occluded), _BAND_ROWS):
        rows = slice(top, top + _BAND_ROWS)
        occluded[rows] = is_occluded(*measure_disagreement(disparity_px[rows], right_disparity_px[rows]))
    return occluded


def measure_disagreement(
    disparity_px: Float[np.ndarray, "h w"], right_disparity_px: Float[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Right disparity at each left pixel's match less its own, in px, and where the match is inside."""
    seen_px, inside = at_match(right_disparity_px, disparity_px, -1)
    return seen_px - disparity_px, inside


def is_occluded(
    disagreement_px: Float[np.ndarray, "h w"], inside: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Where a disagreement of the two views means that only the left camera sees the pixel."""
    return ~inside | (disagreement_px > OCCLUSION_STEP_PX)


def at_match(
    values: Shaped[np.ndarray, "h w"], disparity_px: Float[np.ndarray, "h w"], direction: int
) -> tuple[Shaped[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """The other view's values at each pixel's match, and where the match is inside its picture.

    Beyond a border its last column is taken.

    Args:
        values: Of the other view, float32 or uint8.
        disparity_px: Of this view.
        direction: -1 for the left view's disparity, whose matches are to the left; 1 for the right view's.
    """
    height, width = disparity_px.shape
    columns = (np.arange(width, dtype=np.float32) + direction * disparity_px).astype(np.float32, copy=False)
    rows = np.broadcast_to(np.arange(height, dtype=np.float32)[:, None], columns.shape)
    seen = cv2.remap(values, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    return seen, (columns > -0.5) & (columns < width - 0.5)
