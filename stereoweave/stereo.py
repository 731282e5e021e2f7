"""Data types that the parts of Stereoweave exchange, and their geometry.

Values that hold arrays are compared by identity, because arrays have no truth value.

Conventions (docs/conventions.md): pixel centres are integers; column x of the left image is at
x - disparity in the right one; column x of the right image is at x + right disparity in the left.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Real, UInt8

from stereoweave.arguments import (
    check_array,
    check_kind,
    check_number,
    check_numbers,
    describe,
    is_plain_array,
)
from stereoweave.errors import Note, StereoweaveError

# Limit of cv2.remap, which indexes pixels with 16-bit integers.
LONGEST_SIDE_PX = 32_766

# NumPy arrays and PyTorch tensors have no common base class, and only `learn` imports PyTorch.
ArrayOrTensor = TypeVar("ArrayOrTensor", bound=Any)

# No real camera has larger parameters (px, m or coefficients), and products of such would overflow float32.
CAMERA_NUMBERS_BELOW = 1e9
# Below this code, the curve is a straight line, so that the slope of `DepthCurve.decode` is bounded.
_STRAIGHT_BELOW = 1e-5
_LARGEST_FITTED_EXPONENT = 8.0


@dataclass(frozen=True, kw_only=True)
class StereoCamera:
    """Rectified stereo camera: intrinsics of the left camera, baseline and principal-point offset.

    doffs_px is the right camera's cx minus the left camera's cx (Middlebury's definition).
    """

    focal_px: float
    baseline_m: float
    cx_px: float
    cy_px: float
    doffs_px: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            object.__setattr__(self, name, check_number(name, value))
        # Smaller values underflow to 0 in float32 and give no depth.
        for name in ("focal_px", "baseline_m"):
            value = getattr(self, name)
            if not value > 1 / CAMERA_NUMBERS_BELOW:
                raise StereoweaveError(
                    f"expected a number above {1 / CAMERA_NUMBERS_BELOW:g}, found {value:g}", setting=name
                )
        if not all(abs(value) < CAMERA_NUMBERS_BELOW for value in vars(self).values()):
            raise StereoweaveError(
                f"camera parameters must be finite with magnitudes below {CAMERA_NUMBERS_BELOW:g}, got {self}"
            )

    @classmethod
    def centred(
        cls, image: UInt8[np.ndarray, "h w 3"], *, focal_px: float, baseline_m: float
    ) -> "StereoCamera":
        """Create a camera whose optical axis passes through the centre of the image [H, W, 3]."""
        _check_rgb("image", image)
        height, width = image.shape[:2]
        return cls(focal_px=focal_px, baseline_m=baseline_m, cx_px=(width - 1) / 2, cy_px=(height - 1) / 2)

    def depth_m(self, disparity_px: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        """Return the depth along the optical axis in metres; infinite where disparity_px + doffs_px <= 0."""
        check_numbers("disparity_px", disparity_px)
        shifted_px = np.maximum(_widen(disparity_px) + self.doffs_px, 0)
        with np.errstate(divide="ignore"):
            return self.focal_px * self.baseline_m / shifted_px

    def disparity_px(self, depth_m: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        """Return the disparity in pixels for a depth in metres; this is the inverse of `depth_m`."""
        check_numbers("depth_m", depth_m)
        with np.errstate(divide="ignore"):
            return self.focal_px * self.baseline_m / _widen(depth_m) - self.doffs_px


def scale_camera(camera: StereoCamera, scale_x: float, scale_y: float) -> StereoCamera:
    """Return the camera of pictures scaled by these factors.

    The focal length is scaled by `scale_x`, because the horizontal focal length determines depth.
    """
    # Pixel centres are integers, so the picture's corner is at -0.5.
    return replace(
        camera,
        focal_px=camera.focal_px * scale_x,
        cx_px=(camera.cx_px + 0.5) * scale_x - 0.5,
        cy_px=(camera.cy_px + 0.5) * scale_y - 0.5,
        doffs_px=camera.doffs_px * scale_x,
    )


def assume_camera(size_px: tuple[int, int], *, doffs_px: float = 0.0) -> StereoCamera:
    """Return a plausible camera for images of this width and height, whose own camera is unknown.

    It has a baseline of 1 m and a horizontal field of view of 53 degrees, as a focal length of 36 mm gives on
    35 mm film, and its optical axis passes through the centre.
    """
    width, height = size_px
    return StereoCamera(
        focal_px=width,
        baseline_m=1.0,
        cx_px=(width - 1) / 2,
        cy_px=(height - 1) / 2,
        doffs_px=doffs_px,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class StereoPair:
    """Rectified left and right images, uint8 RGB of the same size, and their camera if known.

    left_seen and right_seen, bool [H, W], are False at pixels without content, such as the borders that
    rectification leaves; they are None if every pixel has content.
    """

    left: UInt8[np.ndarray, "h w 3"]
    right: UInt8[np.ndarray, "h w 3"]
    camera: StereoCamera | None = None
    left_seen: Bool[np.ndarray, "h w"] | None = None
    right_seen: Bool[np.ndarray, "h w"] | None = None

    def __post_init__(self) -> None:
        for side, image in (("left", self.left), ("right", self.right)):
            _check_rgb(f"{side} image", image)
            if max(image.shape) > LONGEST_SIDE_PX:
                raise StereoweaveError(
                    f"{side} image: expected at most {LONGEST_SIDE_PX} pixels per side, got {_size(image)}; "
                    "scale it down or crop it"
                )
        if self.left.shape != self.right.shape:
            raise StereoweaveError(
                "left and right images must have the same size, "
                f"got {_size(self.left)} and {_size(self.right)}; crop or rescale one of them"
            )
        if self.camera is not None:
            check_kind("camera", self.camera, StereoCamera)
        for side, seen in (("left", self.left_seen), ("right", self.right_seen)):
            if seen is not None:
                check_array(f"{side}_seen", seen, "b", 2)
            if seen is not None and seen.shape != self.left.shape[:2]:
                raise StereoweaveError(
                    f"{side}_seen: expected the shape of the images {self.left.shape[:2]}, got {seen.shape}"
                )

    def __repr__(self) -> str:
        masks = (("left", self.left_seen), ("right", self.right_seen))
        shares = [f"{_percent(seen)} of {side} with content" for side, seen in masks if seen is not None]
        return _summary(self, self.left, *_list_camera(self.camera), *shares)

    def mirror(self) -> "StereoPair":
        """Return the pair flipped horizontally, with its views swapped and without its camera."""
        return StereoPair(
            left=np.ascontiguousarray(self.right[:, ::-1]),
            right=np.ascontiguousarray(self.left[:, ::-1]),
            left_seen=None if self.right_seen is None else np.ascontiguousarray(self.right_seen[:, ::-1]),
            right_seen=None if self.left_seen is None else np.ascontiguousarray(self.left_seen[:, ::-1]),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimate:
    """Matching result for a pair; every array is [H, W] and finite. Floats of any width become float32.

    Attributes:
        disparity_px: Disparity of the left view, float32: column x is at x - disparity_px in the right image.
        right_disparity_px: Disparity of the right view, float32: column x is at x + right_disparity_px in the
            left image.
        confidence: Estimated probability, float32 in 0..1, that disparity_px is within 1 px of the truth.
        occluded: Mask, bool, of the pixels that only the left camera sees.
        pair: The pair that the estimate belongs to, if `estimate` aligned it, opened it from one file or
            turned one of two files as the other; None if the estimate belongs to the images as given.
        notes: Notes on how `estimate` opened or aligned the pair, or why it could not align it, and on other
            problems, such as a range that is too narrow; `str` gives their text.
    """

    disparity_px: Float[np.ndarray, "h w"]
    right_disparity_px: Float[np.ndarray, "h w"]
    confidence: Float[np.ndarray, "h w"]
    occluded: Bool[np.ndarray, "h w"]
    pair: StereoPair | None = None
    notes: tuple[Note, ...] = ()

    def __post_init__(self) -> None:
        if self.pair is not None:
            check_kind("pair", self.pair, StereoPair)
        check_kind("notes", self.notes, tuple)
        for note in self.notes:
            check_kind("notes", note, Note)
        check_array("disparity_px", self.disparity_px, "f", 2)
        _check_not_empty("disparity_px", self.disparity_px)
        shape = self.disparity_px.shape
        for name in ("disparity_px", "right_disparity_px", "confidence", "occluded"):
            value = getattr(self, name)
            check_array(name, value, "b" if name == "occluded" else "f", 2)
            if name != "occluded":
                # OpenCV and the kernels take no half floats, and Numba compiles again for wider ones.
                with np.errstate(over="ignore"):
                    value = value.astype(np.float32, copy=False)
                object.__setattr__(self, name, value)
            if value.shape != shape:
                raise StereoweaveError(
                    f"{name}: expected the shape of disparity_px {shape}, got {value.shape}"
                )
            if not np.isfinite(value).all():
                count = int((~np.isfinite(value)).sum())
                raise StereoweaveError(
                    f"{name}: expected finite values, got {count} that are NaN or infinite; fill them first"
                )
        if not 0 <= self.confidence.min() <= self.confidence.max() <= 1:
            raise StereoweaveError(
                f"confidence: expected probabilities from 0 to 1, got {self.confidence.min():g} to "
                f"{self.confidence.max():g}"
            )

    def __repr__(self) -> str:
        return _summary(
            self,
            self.disparity_px,
            f"disparity {_range(self.disparity_px)}",
            f"mean confidence {_mean(self.confidence):.2f}",
            f"{_percent(self.occluded)} occluded",
        )


def check_fits(estimate: Estimate, pair: StereoPair) -> None:
    """Require an estimate of the same size as the pair, and of its images if the estimate holds a pair."""
    check_kind("estimate", estimate, Estimate)
    check_kind("pair", pair, StereoPair)
    found, expected = estimate.disparity_px.shape, pair.left.shape[:2]
    if found != expected:
        raise StereoweaveError(
            f"estimate: expected the size of the images, {expected[1]}x{expected[0]}, "
            f"got {found[1]}x{found[0]}; use an estimate made from these images"
        )
    if estimate.pair is not None and not _has_same_images(estimate.pair, pair):
        raise StereoweaveError(
            "pair: expected the images that the estimate belongs to, found others; use estimate.pair"
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """Synthesised image, uint8 RGB [H, W, 3], and the mask `drawn`, bool [H, W].

    `drawn` is False at filled holes, which no camera saw, and where part of the colour may come from a border
    without content (`StereoPair.left_seen`).
    """

    image: UInt8[np.ndarray, "h w 3"]
    drawn: Bool[np.ndarray, "h w"]

    def __repr__(self) -> str:
        return _summary(self, self.image, f"{_percent(self.drawn)} drawn")


@dataclass(frozen=True, kw_only=True, eq=False)
class Sample:
    """Stereo pair with exact ground truth for training and evaluation; unknown disparity is NaN.

    Attributes:
        left, right: Images, uint8 RGB [H, W, 3].
        disparity_px, right_disparity_px: True disparities, float32 [H, W], with the sign convention of
            `Estimate`.
        occluded, right_occluded: Masks, bool [H, W], of the pixels that only that view's camera sees.
        camera: The camera, if known.
    """

    left: UInt8[np.ndarray, "h w 3"]
    right: UInt8[np.ndarray, "h w 3"]
    disparity_px: Float[np.ndarray, "h w"]
    right_disparity_px: Float[np.ndarray, "h w"]
    occluded: Bool[np.ndarray, "h w"]
    right_occluded: Bool[np.ndarray, "h w"]
    camera: StereoCamera | None = None

    def __repr__(self) -> str:
        known = ~np.isnan(self.disparity_px)
        return _summary(
            self,
            self.left,
            f"disparity {_range(self.disparity_px[known])}",
            f"{_percent(known)} known",
            f"{_percent(self.occluded)} occluded",
            *_list_camera(self.camera),
        )


@dataclass(frozen=True, kw_only=True)
class DepthCurve:
    """Depth adjustment of "Fast Depth Estimation for View Synthesis": map from disparity or depth to a code.

    The code is u^p (equation 3), where u is d / d_max or 1 - z / z_max. A code of 0 is far and a code of 1 is
    near; p >= 1 gives near surfaces more of the range. Set max_disparity_px to encode disparity, or
    max_depth_m to encode depth, but not both.

    There is one deviation: below a code of 1e-5, the curve is a straight line to 0. The slope of the paper's
    x^(1/p) (equation 4) is infinite at 0; here it is at most 1e5 for any p, and 46 for p = 1.5. The code
    differs by less than 1e-5 (1.5e-6 for p = 1.5), and `encode` and `decode` remain exact inverses.
    """

    exponent: float = 1.5
    max_disparity_px: float | None = None
    max_depth_m: float | None = None

    def __post_init__(self) -> None:
        if (self.max_disparity_px is None) == (self.max_depth_m is None):
            raise StereoweaveError(
                "expected exactly one of max_disparity_px and max_depth_m, "
                f"got {self.max_disparity_px} and {self.max_depth_m}"
            )
        for name in ("max_disparity_px", "max_depth_m"):
            value = getattr(self, name)
            if value is None:
                continue
            value = check_number(name, value)
            object.__setattr__(self, name, value)
            if not 0 < value < math.inf:
                raise StereoweaveError(f"{name} must be positive and finite, got {value}")
        object.__setattr__(self, "exponent", check_number("exponent", self.exponent))
        if not 1 <= self.exponent < math.inf:
            raise StereoweaveError(f"exponent must be finite and at least 1, got {self.exponent}")

    def encode(self, values: ArrayOrTensor) -> ArrayOrTensor:
        """Encode disparity in px or depth in m as a code in 0..1 of the same shape; NaN stays NaN.

        Args:
            values: Array or tensor of any shape: disparity in 0..max_disparity_px, or depth that is above 0
                and at most max_depth_m; NaN where unknown.

        Raises:
            StereoweaveError: A value is outside the range.
        """
        self.check(values)
        return self.encode_estimate(values)

    def check(self, values: ArrayOrTensor) -> None:
        """Raise StereoweaveError if a value is outside the range of `encode`."""
        _require_elements(values)
        if self.max_disparity_px is not None:
            outside = values[(values < 0) | (values > self.max_disparity_px)]
            _refuse(outside, f"disparity: expected 0 to {self.max_disparity_px} px")
        else:
            outside = values[(values <= 0) | (values > self.max_depth_m)]
            _refuse(outside, f"depth: expected more than 0 and at most {self.max_depth_m} m")

    def encode_estimate(self, values: ArrayOrTensor) -> ArrayOrTensor:
        """Encode estimated values; outside the range, extrapolate the curve instead of raising an error."""
        _require_elements(values)
        if self.max_disparity_px is not None:
            straight = values / self.max_disparity_px
        else:
            straight = 1 - values / self.max_depth_m
        return straight * straight.clip(min=_STRAIGHT_BELOW ** (1 / self.exponent)) ** (self.exponent - 1)

    def decode(self, code: ArrayOrTensor) -> ArrayOrTensor:
        """Decode a code in 0..1 to disparity in px or depth in m; this is the inverse of `encode`.

        The value and its gradient are finite on all of [0, 1]. A code of 0 is far (disparity 0 or
        max_depth_m), and a code of 1 is near.
        """
        _require_elements(code)
        straight = code * code.clip(min=_STRAIGHT_BELOW) ** (1 / self.exponent - 1)
        if self.max_disparity_px is not None:
            return straight * self.max_disparity_px
        return (1 - straight) * self.max_depth_m


def fit_exponent(histogram: Real[np.ndarray, " n"]) -> float:
    """Fit the exponent p of a `DepthCurve`, from 1 to 8, to a training set.

    The paper initialises p by "curve fitting to the histogram of the training ground truth" and gives no
    details. Here u^p is fitted to the cumulative histogram by least squares at the bin edges. The cumulative
    histogram is the equalising curve, so the codes spread over 0..1 as evenly as u^p allows. A set of mostly
    far pixels would need p < 1; it gets 1, the paper's lower bound.

    Args:
        histogram: Counts [N], N >= 2, of known ground truth in equal bins over u in 0..1, where u is
            d / d_max or 1 - z / z_max.
    """
    if histogram.size < 2 or not (histogram >= 0).all() or not 0 < histogram.sum() < math.inf:
        raise StereoweaveError(
            "histogram: expected 2 or more finite counts, none of them negative and not all of them 0, "
            f"got {histogram.size} counts, {(histogram < 0).sum()} of them negative, with the sum "
            f"{histogram.sum()}"
        )
    edges = np.arange(1, histogram.size) / histogram.size
    cumulative = histogram.cumsum()[:-1] / histogram.sum()
    low, high = 1.0, _LARGEST_FITTED_EXPONENT
    for _ in range(4):  # each pass narrows the interval to 2 of its 50 steps
        exponents = np.linspace(low, high, 51)
        best = ((edges ** exponents[:, None] - cumulative) ** 2).sum(1).argmin()
        low, high = exponents[max(best - 1, 0)], exponents[min(best + 1, 50)]
    return float(exponents[best])


def _require_elements(values: object) -> None:
    if not hasattr(values, "clip"):
        raise StereoweaveError(f"expected an array or a tensor, found {describe(values)}")


def _refuse(outside: ArrayOrTensor, expected: str) -> None:
    if len(outside) > 0:
        raise StereoweaveError(
            f"{expected}, or NaN where unknown, found {outside[0].item()}; "
            "raise the maximum, or set such pixels to NaN"
        )


def _widen(values: np.ndarray | float) -> np.ndarray:
    """Return numbers as an array of float32 or wider, because half floats would overflow."""
    array = np.asanyarray(values)
    return array.astype(np.result_type(array.dtype, np.float32), copy=False)


def _check_rgb(name: str, image: np.ndarray) -> None:
    if not is_plain_array(image) or image.dtype != np.uint8 or image.shape[2:] != (3,):
        raise StereoweaveError(f"{name}: expected uint8 RGB [H, W, 3], got {describe(image)}")
    _check_not_empty(name, image)


def _check_not_empty(name: str, image: np.ndarray) -> None:
    if not image.size:
        raise StereoweaveError(f"{name}: expected at least one pixel, found {_size(image)}")


def _has_same_images(one: StereoPair, other: StereoPair) -> bool:
    return all(
        own is others or np.array_equal(own, others)
        for own, others in ((one.left, other.left), (one.right, other.right))
    )


def _size(image: np.ndarray) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def _summary(value: object, image: np.ndarray, *parts: str) -> str:
    """Return the text that stands for a value in an interactive session, instead of its arrays."""
    return f"{type(value).__name__}({', '.join([_size(image), *parts])})"


def _list_camera(camera: StereoCamera | None) -> list[str]:
    return [f"focal length {camera.focal_px:g} px, baseline {camera.baseline_m:g} m"] if camera else []


def _range(disparity_px: Float[np.ndarray, "..."]) -> str:
    if not disparity_px.size:
        return "unknown"
    return f"{disparity_px.min():.1f} to {disparity_px.max():.1f} px"


def _percent(mask: Bool[np.ndarray, "h w"]) -> str:
    return f"{100 * _mean(mask):.1f} %"


def _mean(values: np.ndarray) -> float:
    """Return the mean; NaN, without NumPy's warning, if there is no value."""
    return float(values.mean()) if values.size else math.nan
