"""Metric depth of pairs that cameras of known focal length and baseline took slightly out of line."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from experiments.handheld.cameras import HandheldCamera, Ranges, Size
from experiments.handheld.pairs import SEED, HandheldPair, Original, render_originals, take_with
from stereoweave.cameras.feature_matches import Matches
from stereoweave.cameras.rectify_uncalibrated import Fit, fit_warps
from stereoweave.stereo import StereoCamera, StereoPair

_TURN_DEGREES, _LOWER = 1.0, 0.02
_PAIR_STEP = 5
_BASELINE_M = 0.1
# A greater baseline or a nearer scene has larger disparities, of which an error is a smaller share.
_LEAST_DISPARITY_PX = 5.0


@dataclass(frozen=True, kw_only=True)
class KnownCameraRow:
    """Score of one pair.

    Attributes:
        pair: Name of the original, and number of the pair.
        vertical_error_before_px: Median vertical error at the true correspondences before rectification.
        vertical_error_px, vertical_error_95_px: Median and 95th percentile afterwards.
        unknown_camera_px, unknown_camera_95_px: The same if the camera is not known.
        distance_error_percent, distance_bias_percent: Median absolute error of the distances from the left
            camera, and median error, of points with a disparity of at least 5 px; NaN without metres.
    """

    pair: str
    vertical_error_before_px: float
    vertical_error_px: float
    vertical_error_95_px: float
    unknown_camera_px: float
    unknown_camera_95_px: float
    distance_error_percent: float
    distance_bias_percent: float


def score_known_cameras() -> list[KnownCameraRow]:
    """Rectify rendered pairs of known cameras, and measure rows and distances at true correspondences."""
    return [score_pair(*draw_pair(original, index)) for index, original in render_originals(_PAIR_STEP)]


def summarize_known_cameras(rows: list[KnownCameraRow]) -> str:
    """Describe how many pairs keep metres, and the errors of their distances and rows."""
    errors = [row.distance_error_percent for row in rows if not np.isnan(row.distance_error_percent)]
    rows_px, unknown_px = (
        np.median([getattr(row, name) for row in rows]) for name in ("vertical_error_px", "unknown_camera_px")
    )
    return (
        f"{len(errors)} of {len(rows)} pairs keep metres; distances are off by {np.median(errors):.2f} % in "
        f"the median, {max(errors):.2f} % at worst; rows by {rows_px:.3f} px ({unknown_px:.3f} px if the "
        "camera is not known)"
    )


def draw_pair(original: Original, index: int) -> tuple[HandheldPair, Original, HandheldCamera]:
    """Return a pair taken by parallel cameras, its original and the left camera.

    The cameras are turned about the optical axis and the baseline; the right centre is lower or higher.
    """
    rng = np.random.default_rng((SEED, index, 2))
    width = original.pair.left.shape[1]
    left, right = (
        HandheldCamera(
            turn=_turn(0, rng) @ _turn(2, rng),
            focal_px=original.focal_px,
            shift_px=np.array([0.0, lower * rng.uniform(-1, 1) * width]),
            distortion=0.0,
            original_focal_px=original.focal_px,
        )
        for lower in (0.0, _LOWER)
    )
    still = Ranges(exposure_stops=0, balance=0)
    return take_with((left, right), original, index, rng, still), original, left


def _turn(axis: int, rng: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    angles = np.zeros(3)
    angles[axis] = np.radians(rng.uniform(-1, 1) * _TURN_DEGREES)
    return cv2.Rodrigues(angles)[0]


def score_pair(made: HandheldPair, original: Original, camera: HandheldCamera) -> KnownCameraRow:
    """Rectify one pair of `draw_pair`, and measure its rows and distances."""
    known = StereoCamera.centred(made.pair.left, focal_px=original.focal_px, baseline_m=_BASELINE_M)
    pair = StereoPair(left=made.pair.left, right=made.pair.right, camera=known)
    fit = fit_warps(pair)
    before_px, off_px, unknown_px = (
        np.abs(left_px - right_px)[:, 1]
        for left_px, right_px in (
            (made.left_px, made.right_px),
            _transform(fit, made),
            _transform(fit_warps(made.pair), made),
        )
    )
    warped = fit.apply(pair).camera
    shares = _compare_distances(warped, _transform(fit, made), _find_true_m(made, original, camera))
    return KnownCameraRow(
        pair=made.name,
        vertical_error_before_px=float(np.median(before_px)),
        vertical_error_px=float(np.median(off_px)),
        vertical_error_95_px=float(np.percentile(off_px, 95)),
        unknown_camera_px=float(np.median(unknown_px)),
        unknown_camera_95_px=float(np.percentile(unknown_px, 95)),
        distance_error_percent=100 * float(np.median(np.abs(shares))),
        distance_bias_percent=100 * float(np.median(shares)),
    )


def _transform(fit: Fit, made: HandheldPair) -> Matches:
    return fit.warps.transform(Matches(made.left_px, made.right_px))


def _find_true_m(made: HandheldPair, original: Original, camera: HandheldCamera) -> Float[np.ndarray, " n"]:
    """Return the distances of the correspondences from the left camera; NaN for those of small disparity."""
    size, before = (Size(each.left.shape[1], each.left.shape[0]) for each in (made.pair, original.pair))
    sources_px = camera.find_sources(made.left_px, size, before)
    columns, rows = np.rint(sources_px).astype(int).T
    true_px = original.truth_px[rows, columns].astype(float)
    exact = StereoCamera.centred(
        original.pair.left, focal_px=camera.original_focal_px, baseline_m=_BASELINE_M
    )
    true_m = _measure_distances_m(exact, sources_px, true_px)
    return np.where(true_px >= _LEAST_DISPARITY_PX, true_m, np.nan)


def _compare_distances(
    camera: StereoCamera | None, places: Matches, true_m: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Return the relative errors of the distances of rectified correspondences; NaN without a camera."""
    if camera is None:
        return np.full(1, np.nan)
    found_m = _measure_distances_m(camera, places.left_px, places.disparity_px)
    return (found_m / true_m - 1)[np.isfinite(true_m)]


def _measure_distances_m(
    camera: StereoCamera, left_px: Float[np.ndarray, "n 2"], disparity_px: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Return the distances of points from the left camera, which do not depend on its direction."""
    depth_m = camera.depth_m(disparity_px[:, None])[:, 0]
    away = np.linalg.norm(left_px - [camera.cx_px, camera.cy_px], axis=1) / camera.focal_px
    return depth_m * np.hypot(1, away)
