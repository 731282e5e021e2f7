"""Comparison of methods on one dataset, by the errors of disparities and of right views projected with them.

These are the columns of Table I of "Fast Depth Estimation for View Synthesis". The paper does not say how its
view error treats pixels without a source, and a poor disparity map can leave many such pixels. Therefore,
the error is given twice: over the pixels that have a source, together with their share, and over all pixels
after rows are filled identically for all methods. The second error ranks the methods.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float, UInt8

from stereoweave.bench.metrics import depth_error_m, epe_px, mae, psnr_db, ssim
from stereoweave.bench.opencv_matchers import OPENCV_MATCHERS, SGBM, fill_rows
from stereoweave.bench.projection import fill_from_rows, project_right
from stereoweave.errors import StereoweaveError
from stereoweave.stereo import Sample, StereoPair, View

DisparityMethod = Callable[[Sample], Float[np.ndarray, "h w"]]
"""Returns the left disparity of a sample, in px [H, W]."""

GROUND_TRUTH, NO_WARPING = "ground truth", "no warping"


@dataclass(frozen=True, kw_only=True)
class ProjectionErrors:
    """Errors of a projected right view against the right image.

    Attributes:
        mae_sourced: Mean absolute error, in levels of 0..255, over the pixels that have a source.
        sourced_percent: Share of the pixels that have a source.
        mae_filled: Mean absolute error over all pixels after `fill_from_rows`; ranks the methods.
        psnr_db, ssim: Scores of the filled view.
    """

    mae_sourced: float
    sourced_percent: float
    mae_filled: float
    psnr_db: float
    ssim: float


@dataclass(frozen=True, kw_only=True)
class ProjectionRow:
    """Disparity errors and `ProjectionErrors` of one method, averaged over the samples.

    Attributes:
        epe_px: End-point error over the pixels of known truth.
        epe_cm: Mean absolute depth error over the same pixels; NaN if a sample has no camera. Estimates are
            clamped (see `score_projections`).
    """

    method: str
    epe_px: float
    epe_cm: float
    mae_sourced: float
    sourced_percent: float
    mae_filled: float
    psnr_db: float
    ssim: float


def score_projections(
    methods: Mapping[str, DisparityMethod], samples: Iterable[Sample], max_depth_m: float | None = None
) -> list[ProjectionRow]:
    """Return a mean row for each of three baselines, then for each given method.

    The baseline "ground truth" uses the true disparity; where it is unknown, pixels have no source. "no
    warping" uses disparity 0, so its right view is the left image. "sgbm" is OpenCV's matcher with holes
    filled along rows.

    Args:
        methods: Further methods, by name.
        samples: Pairs of known disparity.
        max_depth_m: Maximum to which estimated depth is clamped before comparison, because one pixel at
            infinity would make the mean infinite. Default: each sample's greatest true depth.

    Raises:
        StereoweaveError: If a method has the name of a baseline, or there are no samples.
    """
    everyone: dict[str, DisparityMethod] = {GROUND_TRUTH: _true_px, NO_WARPING: _zero_px, SGBM: _make_sgbm()}
    if taken := everyone.keys() & methods.keys():
        raise StereoweaveError(
            f"{min(taken)}: expected a name that no other row of the table uses, found a duplicate; rename it"
        )
    everyone |= methods
    return _score(everyone, samples, max_depth_m)


def score_projection(
    name: str, method: DisparityMethod, samples: Iterable[Sample], max_depth_m: float | None = None
) -> ProjectionRow:
    """Return the row of one method, without baselines; see `score_projections`."""
    return _score({name: method}, samples, max_depth_m)[0]


def measure_projection(right: UInt8[np.ndarray, "h w 3"], projected: View) -> ProjectionErrors:
    """Compare a right view made by `project_right` with the right image."""
    filled = fill_from_rows(projected)
    return ProjectionErrors(
        mae_sourced=mae(projected.image, right, projected.drawn),
        sourced_percent=100 * float(projected.drawn.mean()),
        mae_filled=mae(filled, right),
        psnr_db=psnr_db(filled, right),
        ssim=ssim(filled, right),
    )


def _score(
    methods: Mapping[str, DisparityMethod], samples: Iterable[Sample], max_depth_m: float | None
) -> list[ProjectionRow]:
    scores = [
        {name: _score_sample(method(sample), sample, max_depth_m) for name, method in methods.items()}
        for sample in samples
    ]
    if not scores:
        raise StereoweaveError("samples: expected at least one, found none; is the split empty?")
    return [ProjectionRow(method=name, **_average([score[name] for score in scores])) for name in methods]


def _score_sample(
    disparity_px: Float[np.ndarray, "h w"], sample: Sample, max_depth_m: float | None
) -> dict[str, float]:
    errors = measure_projection(sample.right, project_right(sample.left, disparity_px))
    return {
        "epe_px": epe_px(disparity_px, sample.disparity_px),
        "epe_cm": _measure_epe_cm(disparity_px, sample, max_depth_m),
        **asdict(errors),
    }


def _measure_epe_cm(
    disparity_px: Float[np.ndarray, "h w"], sample: Sample, max_depth_m: float | None
) -> float:
    if sample.camera is None:
        return float("nan")
    truth_m = sample.camera.depth_m(sample.disparity_px)
    farthest_m = truth_m[np.isfinite(truth_m)].max(initial=0) if max_depth_m is None else max_depth_m
    return 100 * depth_error_m(np.minimum(sample.camera.depth_m(disparity_px), farthest_m), truth_m)


def _average(scores: list[dict[str, float]]) -> dict[str, float]:
    return {column: float(np.mean([score[column] for score in scores])) for column in scores[0]}


def _true_px(sample: Sample) -> Float[np.ndarray, "h w"]:
    return sample.disparity_px


def _zero_px(sample: Sample) -> Float[np.ndarray, "h w"]:
    return np.zeros_like(sample.disparity_px)


def _make_sgbm() -> DisparityMethod:
    match = OPENCV_MATCHERS[SGBM]()
    return lambda sample: fill_rows(match(StereoPair(left=sample.left, right=sample.right)))
