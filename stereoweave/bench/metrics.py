"""Error metrics in double precision, for all benchmarks and validations.

In ground truth, NaN and infinity mean unknown, and unknown pixels do not count. A pixel whose estimate is NaN
is bad. A mean over no pixels is NaN.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stereoweave.errors import StereoweaveError

# Number of confidence bins, as in Guo et al. 2017.
_BINS = 15
DROPPED_PERCENT = np.arange(96)
"""Percentages of the pixels that `sparsification` drops."""


class Sparsification(NamedTuple):
    """Mean errors [96] of the pixels that remain after 0, 1, ..., 95 % are dropped, in the error's unit.

    Attributes:
        kept: Errors if the least confident pixels are dropped first.
        oracle: Errors if the pixels with the largest errors are dropped first; no confidence can do better.
    """

    kept: Float[np.ndarray, " n"]
    oracle: Float[np.ndarray, " n"]

    @property
    def ause(self) -> float:
        """Area between the two curves over the dropped share of pixels (AUSE); 0 is best.

        Source: Ilg et al. 2018, who divide errors by the mean over all pixels; here, errors keep their unit.
        """
        return float(np.trapezoid(self.kept - self.oracle, DROPPED_PERCENT / 100))


def epe_px(estimate_px: Float[np.ndarray, "h w"], truth_px: Float[np.ndarray, "h w"]) -> float:
    """Return the end-point error: the mean absolute error of disparity, in pixels."""
    error_px, _ = _known_errors(estimate_px, truth_px)
    return _mean(error_px)


def bad_percent(
    estimate_px: Float[np.ndarray, "h w"], truth_px: Float[np.ndarray, "h w"], threshold_px: float
) -> float:
    """Return the percentage of known pixels off by more than threshold_px (Middlebury's bad-n)."""
    error_px, _ = _known_errors(estimate_px, truth_px)
    return 100 * _mean(~(error_px <= threshold_px))


def d1_percent(estimate_px: Float[np.ndarray, "h w"], truth_px: Float[np.ndarray, "h w"]) -> float:
    """Return the percentage of known pixels off by more than 3 px and more than 5 % (KITTI 2015's D1)."""
    error_px, known_px = _known_errors(estimate_px, truth_px)
    return 100 * _mean(~((error_px <= 3) | (error_px <= 0.05 * np.abs(known_px))))


def depth_error_m(estimate_m: Float[np.ndarray, "h w"], truth_m: Float[np.ndarray, "h w"]) -> float:
    """Return the mean absolute depth error in metres; infinite if a known depth is estimated as infinite."""
    error_m, _ = _known_errors(estimate_m, truth_m)
    return _mean(error_m)


def mae(
    image: UInt8[np.ndarray, "h w 3"],
    truth: UInt8[np.ndarray, "h w 3"],
    where: Bool[np.ndarray, "h w"] | None = None,
) -> float:
    """Return the mean absolute difference between two images, in levels of 0..255, over the mask `where`."""
    error = np.abs(_subtract(image, truth))
    return _mean(error if where is None else error[where])


def psnr_db(image: UInt8[np.ndarray, "h w 3"], truth: UInt8[np.ndarray, "h w 3"]) -> float:
    """Return the peak signal-to-noise ratio of two images in dB; 148 dB if they are equal."""
    return float(10 * np.log10(255**2 / max(_mean(_subtract(image, truth) ** 2), 1e-10)))


def ssim(image: UInt8[np.ndarray, "h w 3"], truth: UInt8[np.ndarray, "h w 3"]) -> float:
    """Return the mean structural similarity of two images' 8-bit luminance; 1 if they are equal.

    Source: Wang et al. 2004, with an 11x11 Gaussian window of sigma 1.5, K1 = 0.01 and K2 = 0.03. Borders are
    mirrored.
    """
    _check_shapes(image, truth)
    a, b = (cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float64) for picture in (image, truth))
    mean_a, mean_b = _average_windows(a), _average_windows(b)
    variance_a, variance_b = _average_windows(a * a) - mean_a**2, _average_windows(b * b) - mean_b**2
    covariance = _average_windows(a * b) - mean_a * mean_b
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    return _mean(luminance * (2 * covariance + c2) / (variance_a + variance_b + c2))


def calibration_error(probability: Float[np.ndarray, "..."], happened: Bool[np.ndarray, "..."]) -> float:
    """Return the expected calibration error: the mean gap between probability and observed frequency.

    Source: Guo et al. 2017, with bins of equal width, each weighted by its number of values.
    """
    if not probability.size:
        return float("nan")
    claimed, came_true, share = calibration_bins(probability, happened)
    return float((np.abs(claimed - came_true) * share).sum())


def calibration_bins(
    probability: Float[np.ndarray, "..."], happened: Bool[np.ndarray, "..."]
) -> Float[np.ndarray, "3 n"]:
    """Return the mean probability, the observed frequency and the share of values in each non-empty bin."""
    where = np.minimum((probability * _BINS).astype(int), _BINS - 1).ravel()
    counts = np.bincount(where, minlength=_BINS)
    used = counts > 0
    claimed, came_true = (np.bincount(where, x.ravel(), _BINS)[used] for x in (probability, happened))
    return np.stack([claimed / counts[used], came_true / counts[used], counts[used] / where.size])


def sparsification(error: Float[np.ndarray, " n"], confidence: Float[np.ndarray, " n"]) -> Sparsification:
    """Return the sparsification curves of a confidence and of the oracle.

    Source: Ilg et al. 2018. Pixels of equal confidence may be dropped in any order; curves are averaged over
    all orders.

    Args:
        error: Error of each pixel [N], such as its absolute error in px, or 100 if bad and 0 if good.
        confidence: Any value that ranks the pixels [N]; it may be infinite but not NaN.
    """
    _check_shapes(error, confidence)
    return Sparsification(kept=_average_kept(error, confidence), oracle=_average_kept(error, -error))


def _average_kept(
    error: Float[np.ndarray, " n"], confidence: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " m"]:
    """Return the mean error of the pixels that remain at each percentage of `DROPPED_PERCENT`."""
    if not error.size:
        return np.full(len(DROPPED_PERCENT), np.nan)
    _, group, counts = np.unique(-confidence, return_inverse=True, return_counts=True)
    expected = np.repeat(np.bincount(group, error) / counts, counts)
    kept = error.size - error.size * DROPPED_PERCENT // 100
    return expected.cumsum()[kept - 1] / kept


def _known_errors(
    estimate: Float[np.ndarray, "h w"], truth: Float[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the absolute errors and the truth at the pixels of known truth."""
    _check_shapes(estimate, truth)
    known = np.isfinite(truth)
    known_truth = truth[known].astype(np.float64)
    return np.abs(estimate[known] - known_truth), known_truth


def _subtract(
    image: UInt8[np.ndarray, "h w 3"], truth: UInt8[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "h w 3"]:
    _check_shapes(image, truth)
    return image.astype(np.float64) - truth


def _average_windows(image: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    return cv2.GaussianBlur(image, (11, 11), 1.5)


def _mean(values: Float[np.ndarray, "..."] | Bool[np.ndarray, "..."]) -> float:
    return float(values.mean()) if values.size else float("nan")


def _check_shapes(estimate: np.ndarray, truth: np.ndarray) -> None:
    # Otherwise NumPy might broadcast, and the score would be meaningless.
    if estimate.shape != truth.shape:
        raise StereoweaveError(f"estimate: expected the truth's shape {truth.shape}, found {estimate.shape}")
