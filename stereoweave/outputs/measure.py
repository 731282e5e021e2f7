"""Distances in metres between what two pixels of the left photograph show, and how sure they are."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from stereoweave.errors import StereoweaveError
from stereoweave.stereo import Estimate, StereoCamera

# The probability that the stated uncertainty holds: that of one standard deviation of a normal distribution.
HOLDS = 0.6827
# What is around a pixel in such a square, and within so much of its disparity, is the same surface.
_WINDOW_PX = 5
_SAME_SURFACE_PX = 1.0
_LEAST_CONFIDENCE = 0.5
# It stands for 0.15 px; where the shipped networks claim more, 68 % of their errors on painted pairs are
# below 0.10 and 0.16 px.
_MOST_CONFIDENT = 0.9995


@dataclass(frozen=True, kw_only=True)
class CameraError:
    """How uncertain a camera's numbers are, each as a share of the number: 0.01 is 1 %."""

    focal: float = 0.0
    baseline: float = 0.0

    def __post_init__(self) -> None:
        if not (0 <= self.focal < math.inf and 0 <= self.baseline < math.inf):
            raise StereoweaveError(f"expected uncertainties of at least 0, got {self}")


EXACT = CameraError()


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """A distance between two points, right to within uncertainty_m with a probability of 68 %.

    first_m and second_m are the points: x right, y down, z forward of the left camera, in metres.
    """

    distance_m: float
    uncertainty_m: float
    first_m: tuple[float, float, float]
    second_m: tuple[float, float, float]

    def __str__(self) -> str:
        """Such as 1.234 m ± 0.012 m (68 %): two digits of the uncertainty, and the distance as exactly."""
        digits = 1 - math.floor(math.log10(self.uncertainty_m)) if self.uncertainty_m > 0 else 6
        digits = min(max(digits, 0), 6)
        return f"{self.distance_m:.{digits}f} m ± {self.uncertainty_m:.{digits}f} m (68 %)"


def distance(
    estimate: Estimate,
    camera: StereoCamera,
    first_px: tuple[int, int],
    second_px: tuple[int, int],
    *,
    camera_error: CameraError = EXACT,
) -> Measurement:
    """The distance between what two pixels show, in metres, with its uncertainty.

    A disparity is the median of the confident ones on the same surface in the 5x5 pixels around. Its errors
    are taken to have a Laplace distribution: if one is below 1 px with the probability p, which is what the
    confidence says, then it is below e px with the probability 1 - (1 - p)^e, and 68 % of them are below

        sigma_d = ln(1 - 0.6827) / ln(1 - p)

    and nine in ten below twice as much. The points are P = B / (d + doffs) * (x - cx, y - cy, f). So a change
    of a disparity moves its point by -P / (d + doffs), and changes the distance D by as much of that as lies
    along the line between the two. The relative change of D is that of the baseline, and that of the focal
    length times (difference of depth / D)^2. The parts add up in squares; cx, cy, doffs and the pixels
    themselves are taken for exact.

    Args:
        estimate: Of the pair.
        camera: Its camera.
        first_px: Column and row of a pixel of the left photograph.
        second_px: Those of another one.
        camera_error: How uncertain the camera is.

    Raises:
        StereoweaveError: A pixel is outside, its depth is unknown or infinite, or the two are one.
    """
    if tuple(first_px) == tuple(second_px):
        raise StereoweaveError(f"expected two pixels, found one, {_named(first_px)}, twice")
    (first, first_error), (second, second_error) = (
        _point_m(estimate, camera, pixel) for pixel in (first_px, second_px)
    )
    between = second - first
    distance_m = float(np.linalg.norm(between))
    along = between / distance_m
    parts = (
        first @ along * first_error,
        second @ along * second_error,
        distance_m * camera_error.baseline,
        between[2] ** 2 / distance_m * camera_error.focal,
    )
    return Measurement(
        distance_m=distance_m,
        uncertainty_m=math.hypot(*parts),
        first_m=tuple(first.tolist()),
        second_m=tuple(second.tolist()),
    )


def disparity_error_px(confidence: float) -> float:
    """What 68 % of the errors of disparity stay below, given the probability that one is less than 1 px."""
    return math.log(1 - HOLDS) / math.log(1 - min(confidence, _MOST_CONFIDENT))


def _point_m(
    estimate: Estimate, camera: StereoCamera, pixel_px: tuple[int, int]
) -> tuple[Float64[np.ndarray, "3"], float]:
    """What a pixel shows, in metres, and the uncertainty of its distance from the camera as a share of it."""
    column, row = _checked(estimate, pixel_px)
    here_px = estimate.disparity_px[row, column]
    half = _WINDOW_PX // 2
    around = np.s_[max(row - half, 0) : row + half + 1, max(column - half, 0) : column + half + 1]
    around_px = estimate.disparity_px[around]
    same = (estimate.confidence[around] >= _LEAST_CONFIDENCE) & ~estimate.occluded[around]
    same &= np.abs(around_px - here_px) <= _SAME_SURFACE_PX
    shift_px = float(np.median(around_px[same])) + camera.doffs_px
    if shift_px <= 0:
        raise StereoweaveError(
            f"pixel {_named(pixel_px)}: expected a depth, found one at infinity; choose something nearer"
        )
    ray = np.array([column - camera.cx_px, row - camera.cy_px, camera.focal_px], np.float64)
    error_px = disparity_error_px(float(estimate.confidence[row, column]))
    return ray * camera.baseline_m / shift_px, error_px / shift_px


def _checked(estimate: Estimate, pixel_px: tuple[int, int]) -> tuple[int, int]:
    """Column and row of a pixel that both cameras see, and whose disparity is known."""
    height, width = estimate.disparity_px.shape
    column, row = pixel_px
    if not (0 <= column < width and 0 <= row < height):
        raise StereoweaveError(
            f"pixel {_named(pixel_px)}: expected one of the left picture, {width}x{height} px, "
            f"0,0 to {width - 1},{height - 1}, found one outside"
        )
    if estimate.occluded[row, column]:
        raise StereoweaveError(
            f"pixel {_named(pixel_px)}: expected one that both cameras see, found one that the left alone "
            "sees; choose another nearby"
        )
    confidence = float(estimate.confidence[row, column])
    if confidence < _LEAST_CONFIDENCE:
        raise StereoweaveError(
            f"pixel {_named(pixel_px)}: expected a confidence of at least {100 * _LEAST_CONFIDENCE:.0f} %, "
            f"found {100 * confidence:.0f} %; choose another nearby"
        )
    return column, row


def _named(pixel_px: tuple[int, int]) -> str:
    return f"{pixel_px[0]},{pixel_px[1]}"
