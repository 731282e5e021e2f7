"""Distances in metres between the points at two pixels of the left image, with uncertainty."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from stereoweave.errors import StereoweaveError
from stereoweave.stereo import Estimate, StereoCamera

# Probability that an error is within the stated uncertainty, as for one standard deviation of a normal
# distribution.
HOLDS = 0.6827
# Pixels in the window around a pixel are on its surface if their disparities differ from its own by at most
# this.
_WINDOW_PX = 5
_SAME_SURFACE_PX = 1.0
_LEAST_CONFIDENCE = 0.5
# Corresponds to an error of 0.15 px. Where the two shipped networks are more confident than this, 68 % of
# their errors on painted pairs are below 0.10 px and 0.16 px, respectively.
_MOST_CONFIDENT = 0.9995


@dataclass(frozen=True, kw_only=True)
class CameraError:
    """Relative uncertainties of the focal length and the baseline; 0.01 means 1 %."""

    focal: float = 0.0
    baseline: float = 0.0

    def __post_init__(self) -> None:
        if not (0 <= self.focal < math.inf and 0 <= self.baseline < math.inf):
            raise StereoweaveError(f"expected finite uncertainties of at least 0, got {self}")


EXACT = CameraError()


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """Distance between two points; its error is below uncertainty_m with a probability of 68 %.

    first_m and second_m are the points in metres, in the left camera's axes: x right, y down and z forward.
    """

    distance_m: float
    uncertainty_m: float
    first_m: tuple[float, float, float]
    second_m: tuple[float, float, float]

    def __str__(self) -> str:
        """Format as 1.234 m ± 0.012 m (68 %), with two significant digits of uncertainty."""
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
    """Measure the distance in metres between the points at two pixels, with its uncertainty.

    A pixel's disparity is the median over the confident pixels of the same surface in a 5x5 window. Disparity
    errors are modelled by a Laplace distribution: if an error is below 1 px with probability p, the
    confidence, then it is below e px with probability 1 - (1 - p)^e. So 68 % of the errors are below

        sigma_d = ln(1 - 0.6827) / ln(1 - p)

    and 90 % are below twice this bound. The points are P = B / (d + doffs) * (x - cx, y - cy, f). A disparity
    error moves a point by -P / (d + doffs) per pixel; the component along the line between the points changes
    the distance D. A relative baseline error changes D by the same fraction. A relative focal length error
    changes D by that fraction times (depth difference / D)^2. The contributions are added in quadrature. cx,
    cy, doffs and the pixel coordinates are taken as exact.

    Args:
        estimate: The pair's estimate.
        camera: The pair's camera.
        first_px: Column and row of a pixel in the left image.
        second_px: Column and row of another pixel.
        camera_error: Relative uncertainties of the focal length and the baseline.

    Raises:
        StereoweaveError: A pixel is outside the image, its depth is unknown or infinite, or the two pixels
            are the same.
    """
    height, width = estimate.disparity_px.shape
    check_places((width, height), first_px, second_px)
    (first, first_error), (second, second_error) = (
        _find_point_m(estimate, camera, pixel) for pixel in (first_px, second_px)
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


def check_places(size_px: tuple[int, int], first_px: tuple[int, int], second_px: tuple[int, int]) -> None:
    """Raise a StereoweaveError if the pixels are the same, or one is outside the image."""
    if tuple(first_px) == tuple(second_px):
        raise StereoweaveError(f"expected two different pixels, found {_format_pixel(first_px)} twice")
    width, height = size_px
    for column, row in (first_px, second_px):
        if not (0 <= column < width and 0 <= row < height):
            raise StereoweaveError(
                f"expected a pixel of the left picture, from 0,0 to {width - 1},{height - 1}, "
                f"found {_format_pixel((column, row))}"
            )


def disparity_error_px(confidence: float) -> float:
    """Return the bound, in px, below which 68 % of the disparity errors at this confidence lie."""
    return math.log(1 - HOLDS) / math.log(1 - min(confidence, _MOST_CONFIDENT))


def _find_point_m(
    estimate: Estimate, camera: StereoCamera, pixel_px: tuple[int, int]
) -> tuple[Float64[np.ndarray, "3"], float]:
    """Return the point at a pixel, in metres, and the relative uncertainty of its distance to the camera."""
    column, row = _check_pixel(estimate, pixel_px)
    here_px = estimate.disparity_px[row, column]
    half = _WINDOW_PX // 2
    around = np.s_[max(row - half, 0) : row + half + 1, max(column - half, 0) : column + half + 1]
    around_px = estimate.disparity_px[around]
    same = (estimate.confidence[around] >= _LEAST_CONFIDENCE) & ~estimate.occluded[around]
    same &= np.abs(around_px - here_px) <= _SAME_SURFACE_PX
    shift_px = float(np.median(around_px[same])) + camera.doffs_px
    if shift_px <= 0:
        raise StereoweaveError(
            f"pixel {_format_pixel(pixel_px)}: expected a finite depth, found a point at infinity; "
            "choose a nearer point"
        )
    ray = np.array([column - camera.cx_px, row - camera.cy_px, camera.focal_px], np.float64)
    error_px = disparity_error_px(float(estimate.confidence[row, column]))
    return ray * camera.baseline_m / shift_px, error_px / shift_px


def _check_pixel(estimate: Estimate, pixel_px: tuple[int, int]) -> tuple[int, int]:
    """Check that a pixel can be measured, and return its column and row.

    Raises:
        StereoweaveError: The pixel is occluded or has a low confidence.
    """
    column, row = pixel_px
    if estimate.occluded[row, column]:
        raise StereoweaveError(
            f"pixel {_format_pixel(pixel_px)}: expected a pixel that both cameras see, found an occluded "
            "one, which only the left camera sees; choose another pixel nearby"
        )
    confidence = float(estimate.confidence[row, column])
    if confidence < _LEAST_CONFIDENCE:
        raise StereoweaveError(
            f"pixel {_format_pixel(pixel_px)}: expected a confidence of at least "
            f"{100 * _LEAST_CONFIDENCE:.0f} %, found {100 * confidence:.0f} %; choose another pixel nearby"
        )
    return column, row


def _format_pixel(pixel_px: tuple[int, int]) -> str:
    return f"{pixel_px[0]},{pixel_px[1]}"
