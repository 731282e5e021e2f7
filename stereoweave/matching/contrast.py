"""Local contrast of an image, by which plain pixels are told from texture."""

import cv2
import numpy as np
from jaxtyping import UInt8


def measure_contrast(
    image: UInt8[np.ndarray, "h w 3"], mean_px: int, window_px: int
) -> UInt8[np.ndarray, "h w"]:
    """Return how much the grey level, averaged over `mean_px` squared, varies over `window_px` squared."""
    means = cv2.blur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (mean_px, mean_px))
    return cv2.morphologyEx(means, cv2.MORPH_GRADIENT, np.ones((window_px, window_px), np.uint8))
