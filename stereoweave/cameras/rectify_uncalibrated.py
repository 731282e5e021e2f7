"""Rectification without a calibration, from feature matches."""

from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float

from stereoweave.cameras.feature_matches import Matches, find_matches
from stereoweave.cameras.picture_warp import PictureWarp, undistort
from stereoweave.cameras.rectify import Rectified
from stereoweave.errors import Note, Remedy, StereoweaveError
from stereoweave.stereo import StereoPair

_LEAST_MATCHES = 40
_LEAST_RIGHT_SHARE = 0.3
# Inliers lie within this distance of their epipolar lines.
_RIGHT_PX = 1.0
_STEPS = 40
# Scale of the robust loss.
_SOFT_PX = 0.5
# Standard deviations of the prior: of the angles in radians, of log(focal length / width), of log(scale) and
# of the distortion. Where the matches do not determine the solution, the prior selects the smallest change.
_LIKELY = np.array([0.05] * 5 + [0.3, 0.05, 0.03])
_MOST_TURN_DEGREES = 20.0
# Largest difference in focal length; a larger one is taken for a camera that moved forward.
_MOST_SCALE = 0.07
# Number of times that the matches are selected by the fitted warps; the first selection ignores distortion.
_SELECTIONS = 2
_MOST_RESIDUAL_PX = 1.0
_PIXELS_OF_RESIDUAL = 1_500_000
_LOG_SCALE = 6
# This percentage of the smallest disparities may come from wrong matches.
_OUTER_PERCENT = 1.0


class Warps(NamedTuple):
    """Warps of both pictures, after which corresponding rows coincide."""

    left: PictureWarp
    right: PictureWarp

    def measure_lower_px(self, matches: Matches) -> Float[np.ndarray, " n"]:
        """Return how much lower each match is in the warped right picture, in px."""
        return self.right.transform(matches.right_px)[:, 1] - self.left.transform(matches.left_px)[:, 1]


def rectify_by_features(pair: StereoPair) -> Rectified:
    """Rectify a pair using its feature matches.

    Both pictures are warped by the smallest camera rotations that suffice. The focal length, the difference
    in scale and the lens distortion are fitted too. Unlike arbitrary homographies, rotations preserve shapes.
    The result has no camera, because neither focal length nor baseline is known well enough for metric depth.

    Source: "Quasi-Euclidean epipolar rectification of uncalibrated images" (Fusiello and Irsara 2011).

    Raises:
        StereoweaveError: There are too few matches, or no rotation aligns their rows.
    """
    warps, note = fit_warps(pair)
    left, left_seen = warps.left.apply(pair.left, pair.left_seen)
    right, right_seen = warps.right.apply(pair.right, pair.right_seen)
    rectified = replace(pair, left=left, right=right, camera=None, left_seen=left_seen, right_seen=right_seen)
    return Rectified(pair=rectified, notes=(note,))


def fit_warps(pair: StereoPair) -> tuple[Warps, Note]:
    """Fit the warps of `rectify_by_features`, and describe them; raises the same errors."""
    height, width = pair.left.shape[:2]
    found = find_matches(pair.left, pair.right)
    matches = _select_inliers(found)
    for _ in range(_SELECTIONS):
        parameters = _fit_cameras(matches, (width, height))
        warps = _make_warps(parameters, (width, height))
        matches = _require_enough(found, np.abs(_measure_sampson_px(warps, found)) < _RIGHT_PX)
    missed_px = np.abs(warps.measure_lower_px(matches))
    _check(parameters, float(np.median(missed_px)), width, height)
    warps, moved_px = _align_views(warps, matches)
    note = Note(
        f"rectified with {len(missed_px)} matches: median vertical error {np.median(missed_px):.2f} px "
        f"({np.median(np.abs(matches.lower_px)):.2f} px before); the right picture was scaled by "
        f"{100 * np.expm1(-parameters[_LOG_SCALE]):+.1f} % and shifted sideways by {moved_px:+.0f} px"
    )
    return warps, note


def _select_inliers(found: Matches) -> Matches:
    """Return the matches that are consistent with the same epipolar geometry."""
    count = len(found.left_px)
    right_ones = np.zeros(count, bool)
    if count >= _LEAST_MATCHES:
        cv2.setRNGSeed(0)
        with suppress(cv2.error):  # raised if no geometry explains any match
            _, mask = cv2.findFundamentalMat(
                found.left_px, found.right_px, cv2.USAC_MAGSAC, _RIGHT_PX, 0.9999, 5000
            )
            right_ones = right_ones if mask is None else mask.ravel() > 0
    return _require_enough(found, right_ones)


def _require_enough(found: Matches, right_ones: Bool[np.ndarray, " n"]) -> Matches:
    """Return the matches that agree; raise a StereoweaveError if there are too few."""
    count = len(right_ones)
    if right_ones.sum() < max(_LEAST_MATCHES, _LEAST_RIGHT_SHARE * count):
        raise StereoweaveError(
            f"expected at least {_LEAST_MATCHES} feature matches that agree on the camera positions, "
            f"found {right_ones.sum()} of {count} matches; "
            "photograph a scene with more texture and with more overlap",
            setting="rectify",
            remedy=Remedy("or give a calibration", ("calibration",)),
        )
    return Matches(found.left_px[right_ones], found.right_px[right_ones])


def _fit_cameras(matches: Matches, size_px: tuple[int, int]) -> Float[np.ndarray, " 8"]:
    """Fit the parameters of `_make_warps`.

    Minimises a robust loss of the Sampson errors in px by Levenberg-Marquardt with numeric derivatives.
    """

    def errors(parameters: Float[np.ndarray, " 8"]) -> Float[np.ndarray, " n"]:
        missed_px = _measure_sampson_px(_make_warps(parameters, size_px), matches)
        softened = np.sign(missed_px) * _SOFT_PX * np.sqrt(np.log1p((missed_px / _SOFT_PX) ** 2))
        return np.concatenate([softened, parameters / _LIKELY])

    parameters, damping = np.zeros(len(_LIKELY)), 1e-3
    missed = errors(parameters)
    for _ in range(_STEPS):
        steps = 1e-6 * np.eye(len(parameters))
        slopes = np.stack([(errors(parameters + step) - missed) / 1e-6 for step in steps], axis=1)
        normal = slopes.T @ slopes
        step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), slopes.T @ missed)
        tried = errors(parameters + step)
        if tried @ tried < missed @ missed:
            parameters, missed, damping = parameters + step, tried, damping / 10
        else:
            damping *= 10
    return parameters


def _make_warps(parameters: Float[np.ndarray, " 8"], size_px: tuple[int, int]) -> Warps:
    """Return the warps of both pictures, given the parameters of the two cameras.

    The left camera is rotated by yaw and roll, and the right one by pitch, yaw and roll. A common pitch does
    not change the alignment of rows, so the left camera has none. Both lenses have the same distortion.

    Args:
        parameters: left yaw and roll, right pitch, yaw and roll in radians, log(focal length / width), log of
            the right focal length divided by the left one, and the distortion.
        size_px: Width and height of the pictures.
    """
    left_yaw, left_roll, right_pitch, right_yaw, right_roll, log_focal, log_scale, distortion = parameters
    left, _ = cv2.Rodrigues(np.array([0.0, left_yaw, left_roll]))
    right, _ = cv2.Rodrigues(np.array([right_pitch, right_yaw, right_roll]))
    width, height = size_px
    focal_px = width * np.exp(log_focal)
    camera = np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]])
    right_camera = camera.copy()
    right_camera[[0, 1], [0, 1]] *= np.exp(log_scale)
    return Warps(
        *(
            PictureWarp(
                homography=camera @ turn @ np.linalg.inv(own), distortion=float(distortion), size_px=size_px
            )
            for turn, own in ((left, camera), (right, right_camera))
        )
    )


def _measure_sampson_px(warps: Warps, matches: Matches) -> Float[np.ndarray, " n"]:
    """Return each match's Sampson error: first-order distance, in undistorted px, from its epipolar lines."""
    across = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    fundamental = warps.right.homography.T @ across @ warps.left.homography
    ones = np.ones((len(matches.left_px), 1))
    left, right = (
        np.hstack([undistort(places_px, warp.distortion, warp.size_px), ones])
        for places_px, warp in zip(matches, warps, strict=True)
    )
    lines_right, lines_left = left @ fundamental.T, right @ fundamental
    squared = (lines_right[:, :2] ** 2).sum(1) + (lines_left[:, :2] ** 2).sum(1)
    return (right * lines_right).sum(1) / np.sqrt(squared)


def _check(parameters: Float[np.ndarray, " 8"], residual_px: float, width: int, height: int) -> None:
    largest_degrees = float(np.degrees(np.abs(parameters[:5]).max()))
    most_px = _MOST_RESIDUAL_PX * max(1.0, (width * height / _PIXELS_OF_RESIDUAL) ** 0.5)
    scale = float(np.expm1(parameters[_LOG_SCALE]))
    if residual_px > most_px or largest_degrees > _MOST_TURN_DEGREES or abs(scale) > _MOST_SCALE:
        raise StereoweaveError(
            f"expected cameras side by side, rotated by less than {_MOST_TURN_DEGREES:.0f} degrees and with "
            f"less than {_MOST_SCALE:.0%} difference in scale, found vertical errors of {residual_px:.1f} px "
            f"after a rotation of {largest_degrees:.0f} degrees, and a scale difference of {scale:+.0%}; "
            "take the pictures from two positions side by side, without moving forward",
            setting="rectify",
        )


def _align_views(warps: Warps, matches: Matches) -> tuple[Warps, float]:
    """Keep the left picture centred, and shift the right one to the left if disparities would be negative.

    Returns the warps and the sideways shift of the right picture in px.
    """
    left_px, right_px = warps.left.transform(matches.left_px), warps.right.transform(matches.right_px)
    back_x, back_y = np.median(matches.left_px, 0) - np.median(left_px, 0)
    least_px = np.percentile(left_px[:, 0] - right_px[:, 0] + back_x, _OUTER_PERCENT)
    moved_px = float(np.floor(min(least_px, 0.0)))
    return Warps(warps.left.shifted((back_x, back_y)), warps.right.shifted((moved_px, back_y))), moved_px
