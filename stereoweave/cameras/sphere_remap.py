"""Resampling between the pictures of eyes, rectified windows and equirectangular images."""

import cv2
import numpy as np
from jaxtyping import Bool, Shaped

from stereoweave.cameras.sphere_windows import Window
from stereoweave.cameras.spherical import Projection

_BAND_ROWS = 256


class Cutter:
    """Cutter of one window from any number of images of one eye.

    Args:
        projection: Projection of the images.
        eye_size_px: Width and height of the images.
        window: The window.

    Attributes:
        seen: Mask [H, W] of the window's pixels that the images show; None if they show all.
    """

    def __init__(self, projection: Projection, eye_size_px: tuple[int, int], window: Window) -> None:
        width_px, height_px = window.size_px
        # Fixed-point maps take half the memory, and are faster.
        self._places = np.empty((height_px, width_px, 2), np.int16)
        self._shares = np.empty((height_px, width_px), np.uint16)
        seen = np.empty((height_px, width_px), bool)
        for start in range(0, height_px, _BAND_ROWS):
            rows = slice(start, start + _BAND_ROWS)
            found = projection.locate(window.rays(rows), eye_size_px)
            seen[rows] = found.seen
            self._places[rows], self._shares[rows] = cv2.convertMaps(found.columns, found.rows, cv2.CV_16SC2)
        self.seen: Bool[np.ndarray, "h w"] | None = None if seen.all() else seen
        self._border = cv2.BORDER_WRAP if projection.is_closed else cv2.BORDER_REPLICATE

    def cut(self, image: Shaped[np.ndarray, "h w 3"]) -> Shaped[np.ndarray, "h2 w2 3"]:
        """Return the window of an image; black where the image shows nothing."""
        window = cv2.remap(image, self._places, self._shares, cv2.INTER_CUBIC, borderMode=self._border)
        if self.seen is not None:
            window[~self.seen] = 0
        return window


class Spreader:
    """Spreader of windows over equirectangular images, the reverse of `Cutter`.

    Args:
        window: The window.
        projection: An equirectangular projection.
        size_px: Width and height of the equirectangular images.
    """

    def __init__(self, window: Window, projection: Projection, size_px: tuple[int, int]) -> None:
        self._places = np.empty((size_px[1], size_px[0], 2), np.int16)
        self._shares = np.empty((size_px[1], size_px[0]), np.uint16)
        for start in range(0, size_px[1], _BAND_ROWS):
            rows = slice(start, start + _BAND_ROWS)
            columns, lines = window.find(projection.rays(size_px, rows))
            maps = np.clip(columns, -9, 32_000), np.clip(lines, -9, 32_000)
            self._places[rows], self._shares[rows] = cv2.convertMaps(*maps, cv2.CV_16SC2)

    def spread(self, image: Shaped[np.ndarray, "h w *c"]) -> Shaped[np.ndarray, "h2 w2 *c"]:
        """Return an equirectangular image that shows a window's image."""
        return cv2.remap(image, self._places, self._shares, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
