"""Local contrast of an image, which separates plain pixels from texture."""

import cv2
import numpy as np
from jaxtyping import UInt8


def measure_contrast(
    image: UInt8[np.ndarray, "h w 3"], mean_px: int, window_px: int
) -> UInt8[np.ndarray, "h w"]:
    """Return the span of grey levels around each pixel.

    Levels are means of `mean_px` x `mean_px` pixels, and spans are over `window_px` x `window_px` of them.
    """
    means = cv2.blur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (mean_px, mean_px))
    return cv2.morphologyEx(means, cv2.MORPH_GRADIENT, np.ones((window_px, window_px), np.uint8))
