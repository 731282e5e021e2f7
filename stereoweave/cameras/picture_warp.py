"""Warp of one picture: removes radial distortion, applies a homography, then moves parts up or down."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Num

from stereoweave.cameras.row_field import RowField


@dataclass(frozen=True, kw_only=True)
class PictureWarp:
    """Warp of a picture, for its pixels and for points.

    Distortion follows the division model: a point at distance r from the centre (in half diagonals) is
    moved to distance r / (1 + distortion * r^2).

    Source: "Simultaneous linear estimation of multiple view geometry and lens distortion" (Fitzgibbon 2001).

    Attributes:
        homography: [3, 3], maps undistorted to warped pixels.
        distortion: Lens distortion; positive values move points towards the centre, and 0 moves none.
        size_px: Width and height of the picture, both before and after the warp.
        field: Vertical errors that the homography leaves, if known.
    """

    homography: Float[np.ndarray, "3 3"]
    distortion: float
    size_px: tuple[int, int]
    field: RowField | None = None

    def transform(self, places_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Map points of the source picture to their positions in the warped picture."""
        undistorted = undistort(places_px, self.distortion, self.size_px)
        moved_px = cv2.perspectiveTransform(undistorted[None], self.homography)[0]
        return self.field.align(moved_px) if self.field else moved_px

    def shifted(self, shift_px: tuple[float, float]) -> "PictureWarp":
        """Return this warp, whose homography is followed by a shift to the right and down."""
        shift = np.eye(3)
        shift[:2, 2] = shift_px
        return replace(self, homography=shift @ self.homography)

    def scaled(self, factor: float) -> "PictureWarp":
        """Return this warp, whose homography is followed by a change of size about the centre."""
        about_centre = np.diag([factor, factor, 1.0])
        about_centre[:2, 2] = (1 - factor) * (np.array(self.size_px) - 1) / 2
        return replace(self, homography=about_centre @ self.homography)

    def apply(
        self, image: Num[np.ndarray, "h w 3"], seen: Bool[np.ndarray, "h w"] | None
    ) -> tuple[Num[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
        """Warp a picture, repeating its border; return it with the mask of its valid pixels."""
        x_px, y_px = self._find_sources()
        before = np.full(image.shape[:2], 255, np.uint8) if seen is None else 255 * seen.astype(np.uint8)
        warped = cv2.remap(image, x_px, y_px, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        shown = cv2.remap(before, x_px, y_px, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        return warped, shown == 255

    def _find_sources(self) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
        """Return the source column and row, as float32, of each pixel of the warped picture."""
        width, height = self.size_px
        inverse = np.linalg.inv(self.homography).astype(np.float32)
        x, y = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
        if self.field:
            y = y + self.field.measure_everywhere_px()
        u, v, scale = (row[0] * x + row[1] * y + row[2] for row in inverse)
        u, v = u / scale - (width - 1) / 2, v / scale - (height - 1) / 2
        squares = (u * u + v * v) / np.float32(_half_diagonal_px(self.size_px) ** 2)
        # The inverse of the division model. Beyond the radius that it reaches, the root has no real value.
        stretch = 2 / (1 + np.sqrt(np.maximum(1 - np.float32(4 * self.distortion) * squares, 0)))
        return u * stretch + (width - 1) / 2, v * stretch + (height - 1) / 2


def undistort(
    places_px: Float[np.ndarray, "n 2"], distortion: float, size_px: tuple[int, int]
) -> Float[np.ndarray, "n 2"]:
    """Return the points with radial distortion removed (see `PictureWarp`)."""
    centre_px = (np.array(size_px) - 1) / 2
    from_centre = places_px - centre_px
    squares = (from_centre**2).sum(1, keepdims=True) / _half_diagonal_px(size_px) ** 2
    return from_centre / (1 + distortion * squares) + centre_px


def _half_diagonal_px(size_px: tuple[int, int]) -> float:
    return float(np.hypot(*size_px)) / 2
