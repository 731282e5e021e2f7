"""The values that travel through Stereoweave, and the geometry between them.

Conventions (docs/conventions.md): pixel centres are integers; column x of the left image is at
x - disparity in the right one; column x of the right image is at x + right disparity in the left.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from stereoweave.errors import StereoweaveError


@dataclass(frozen=True, kw_only=True)
class StereoCamera:
    """Two rectified cameras: the left one's intrinsics, the baseline, and how far apart their centres lie.

    doffs_px is the right camera's cx minus the left's (Middlebury's definition).
    """

    focal_px: float
    baseline_m: float
    cx_px: float
    cy_px: float
    doffs_px: float = 0.0

    def __post_init__(self) -> None:
        if not (self.focal_px > 0 and self.baseline_m > 0):
            raise StereoweaveError(
                f"focal_px and baseline_m must be positive, got {self.focal_px} and {self.baseline_m}"
            )
        if not np.isfinite([self.focal_px, self.baseline_m, self.cx_px, self.cy_px, self.doffs_px]).all():
            raise StereoweaveError(f"a camera's numbers must be finite, got {self}")

    def depth_m(self, disparity_px: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        """Depth along the optical axis in metres; infinite where disparity_px + doffs_px <= 0."""
        shifted_px = np.maximum(disparity_px + self.doffs_px, 0)
        with np.errstate(divide="ignore"):
            return self.focal_px * self.baseline_m / shifted_px

    def disparity_px(self, depth_m: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        """Disparity in pixels of a depth in metres: the inverse of `depth_m`."""
        with np.errstate(divide="ignore"):
            return self.focal_px * self.baseline_m / depth_m - self.doffs_px


@dataclass(frozen=True, kw_only=True)
class StereoPair:
    """Two rectified photographs of one moment, uint8 RGB of one size, and their camera where it is known."""

    left: UInt8[np.ndarray, "h w 3"]
    right: UInt8[np.ndarray, "h w 3"]
    camera: StereoCamera | None = None

    def __post_init__(self) -> None:
        for side, image in (("left", self.left), ("right", self.right)):
            if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
                raise StereoweaveError(
                    f"{side} image: expected uint8 RGB [H, W, 3], got {image.dtype} {list(image.shape)}"
                )
        if self.left.shape != self.right.shape:
            raise StereoweaveError(
                "left and right images must be of one size, "
                f"got {_size(self.left)} and {_size(self.right)}; crop or rescale one of them"
            )

    def mirrored(self) -> "StereoPair":
        """The pair as a mirror shows it: what was the right view is now the left one."""
        return StereoPair(
            left=np.ascontiguousarray(self.right[:, ::-1]), right=np.ascontiguousarray(self.left[:, ::-1])
        )


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """What a matcher found in a pair; every array is [H, W] and finite.

    Attributes:
        disparity_px: float32, for the left view: column x is at x - disparity_px in the right image.
        right_disparity_px: float32, for the right view: column x is at x + right_disparity_px in the left.
        confidence: float32 in 0..1, the estimated probability that disparity_px is within 1 px.
        occluded: pixels that the left camera alone sees.
    """

    disparity_px: Float[np.ndarray, "h w"]
    right_disparity_px: Float[np.ndarray, "h w"]
    confidence: Float[np.ndarray, "h w"]
    occluded: Bool[np.ndarray, "h w"]

    def __post_init__(self) -> None:
        shape = self.disparity_px.shape
        for name in ("disparity_px", "right_disparity_px", "confidence", "occluded"):
            value = getattr(self, name)
            if value.shape != shape:
                raise StereoweaveError(
                    f"{name}: expected the shape of disparity_px {shape}, got {value.shape}"
                )
            if not np.isfinite(value).all():
                count = int((~np.isfinite(value)).sum())
                raise StereoweaveError(
                    f"{name}: expected finite values, got {count} NaN or infinite ones; fill them first"
                )


@dataclass(frozen=True, kw_only=True)
class View:
    """A synthesized photograph: image uint8 RGB [H, W, 3], and which of its pixels a camera really saw."""

    image: UInt8[np.ndarray, "h w 3"]
    drawn: Bool[np.ndarray, "h w"]


@dataclass(frozen=True, kw_only=True)
class Sample:
    """A pair with exact ground truth, for training and scoring; unknown disparity is NaN.

    Attributes:
        left, right: uint8 RGB [H, W, 3].
        disparity_px, right_disparity_px: float32 [H, W], signs as in `Estimate`.
        occluded, right_occluded: bool [H, W], seen by this camera alone.
    """

    left: UInt8[np.ndarray, "h w 3"]
    right: UInt8[np.ndarray, "h w 3"]
    disparity_px: Float[np.ndarray, "h w"]
    right_disparity_px: Float[np.ndarray, "h w"]
    occluded: Bool[np.ndarray, "h w"]
    right_occluded: Bool[np.ndarray, "h w"]


def _size(image: np.ndarray) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"
