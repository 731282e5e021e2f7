"""Rectification without a calibration, from feature matches."""

from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stereoweave.cameras.feature_matches import Matches, find_matches
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
# Standard deviations of the prior: of the angles in radians and of log(focal length / width). Where the
# matches do not determine the solution, the prior selects the smallest rotations.
_LIKELY_TURN, _LIKELY_LOG_FOCAL = 0.05, 0.3
_MOST_TURN_DEGREES = 20.0
_MOST_RESIDUAL_PX = 1.0
_PIXELS_OF_RESIDUAL = 1_500_000
# This percentage of the smallest disparities may come from wrong matches.
_OUTER_PERCENT = 1.0


class _Homographies(NamedTuple):
    """Homographies of the left and the right picture, after which corresponding rows coincide."""

    left: Float[np.ndarray, "3 3"]
    right: Float[np.ndarray, "3 3"]


def rectify_by_features(pair: StereoPair) -> Rectified:
    """Rectify a pair using its feature matches.

    Both pictures are warped by the smallest camera rotations that suffice; the focal length is fitted too.
    Unlike arbitrary homographies, rotations preserve shapes. The result has no camera, because neither focal
    length nor baseline is known well enough for metric depth.

    Source: "Quasi-Euclidean epipolar rectification of uncalibrated images" (Fusiello and Irsara 2011).

    Raises:
        StereoweaveError: There are too few matches, or no rotation aligns their rows.
    """
    height, width = pair.left.shape[:2]
    matches = _select_inliers(find_matches(pair.left, pair.right))
    parameters = _fit_rotations(matches, width, height)
    turns = _make_homographies(parameters, width, height)
    missed_px = np.abs(
        _transform_rows(turns.right, matches.right_px) - _transform_rows(turns.left, matches.left_px)
    )
    _check(parameters, float(np.median(missed_px)), width, height)
    turns, moved_px = _align_views(turns, matches)
    left, left_seen = _warp(pair.left, turns.left, pair.left_seen)
    right, right_seen = _warp(pair.right, turns.right, pair.right_seen)
    before_px = np.abs(matches.lower_px)
    note = Note(
        f"rectified with {len(missed_px)} matches: median vertical error {np.median(missed_px):.2f} px "
        f"({np.median(before_px):.2f} px before); the right picture was shifted sideways by "
        f"{moved_px:+.0f} px"
    )
    rectified = replace(pair, left=left, right=right, camera=None, left_seen=left_seen, right_seen=right_seen)
    return Rectified(pair=rectified, notes=(note,))


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
    if right_ones.sum() < max(_LEAST_MATCHES, _LEAST_RIGHT_SHARE * count):
        raise StereoweaveError(
            f"expected at least {_LEAST_MATCHES} feature matches that agree on the camera positions, "
            f"found {right_ones.sum()} of {count} matches; "
            "photograph a scene with more texture and with more overlap",
            setting="rectify",
            remedy=Remedy("or give a calibration", ("calibration",)),
        )
    return Matches(found.left_px[right_ones], found.right_px[right_ones])


def _fit_rotations(matches: Matches, width: int, height: int) -> Float[np.ndarray, " 6"]:
    """Fit the parameters of `_make_homographies`: five angles in radians and log(focal length / width).

    Minimises a robust loss of the Sampson errors in px by Levenberg-Marquardt with numeric derivatives.
    """
    likely = np.array([_LIKELY_TURN] * 5 + [_LIKELY_LOG_FOCAL])

    def errors(parameters: Float[np.ndarray, " 6"]) -> Float[np.ndarray, " n"]:
        missed_px = _measure_sampson_px(_make_homographies(parameters, width, height), matches)
        softened = np.sign(missed_px) * _SOFT_PX * np.sqrt(np.log1p((missed_px / _SOFT_PX) ** 2))
        return np.concatenate([softened, parameters / likely])

    parameters, damping = np.zeros(6), 1e-3
    missed = errors(parameters)
    for _ in range(_STEPS):
        slopes = np.stack([(errors(parameters + 1e-6 * unit) - missed) / 1e-6 for unit in np.eye(6)], axis=1)
        normal = slopes.T @ slopes
        step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), slopes.T @ missed)
        tried = errors(parameters + step)
        if tried @ tried < missed @ missed:
            parameters, missed, damping = parameters + step, tried, damping / 10
        else:
            damping *= 10
    return parameters


def _make_homographies(parameters: Float[np.ndarray, " 6"], width: int, height: int) -> _Homographies:
    """Return the homographies of two camera rotations.

    The left camera is rotated by yaw and roll, and the right camera by pitch, yaw and roll. A common pitch
    does not change the alignment of rows, so the left camera keeps its pitch.
    """
    left_yaw, left_roll, right_pitch, right_yaw, right_roll, log_focal = parameters
    focal_px = width * np.exp(log_focal)
    camera = np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]])
    back = np.linalg.inv(camera)
    left, _ = cv2.Rodrigues(np.array([0.0, left_yaw, left_roll]))
    right, _ = cv2.Rodrigues(np.array([right_pitch, right_yaw, right_roll]))
    return _Homographies(camera @ left @ back, camera @ right @ back)


def _measure_sampson_px(turns: _Homographies, matches: Matches) -> Float[np.ndarray, " n"]:
    """Return each match's Sampson error, the first-order distance to its epipolar lines, in source px."""
    across = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    fundamental = turns.right.T @ across @ turns.left
    ones = np.ones((len(matches.left_px), 1))
    left, right = np.hstack([matches.left_px, ones]), np.hstack([matches.right_px, ones])
    lines_right, lines_left = left @ fundamental.T, right @ fundamental
    squared = (lines_right[:, :2] ** 2).sum(1) + (lines_left[:, :2] ** 2).sum(1)
    return (right * lines_right).sum(1) / np.sqrt(squared)


def _check(parameters: Float[np.ndarray, " 6"], residual_px: float, width: int, height: int) -> None:
    largest_degrees = float(np.degrees(np.abs(parameters[:5]).max()))
    most_px = _MOST_RESIDUAL_PX * max(1.0, (width * height / _PIXELS_OF_RESIDUAL) ** 0.5)
    if residual_px > most_px or largest_degrees > _MOST_TURN_DEGREES:
        raise StereoweaveError(
            f"expected cameras side by side, rotated by less than {_MOST_TURN_DEGREES:.0f} degrees, found "
            f"vertical errors of {residual_px:.1f} px after a rotation of {largest_degrees:.0f} degrees; "
            "take the pictures from two positions side by side, without moving forward",
            setting="rectify",
        )


def _align_views(turns: _Homographies, matches: Matches) -> tuple[_Homographies, float]:
    """Keep the left picture centred, and shift the right one to the left if needed for disparities >= 0.

    Returns the homographies and the sideways shift of the right picture in px.
    """
    left_px, right_px = _transform(turns.left, matches.left_px), _transform(turns.right, matches.right_px)
    centre_px = np.median(matches.left_px, 0)
    back_px = centre_px - np.median(left_px, 0)
    least_px = np.percentile(left_px[:, 0] - right_px[:, 0] + back_px[0], _OUTER_PERCENT)
    moved_px = float(np.floor(min(least_px, 0.0)))
    left_shift, right_shift = np.eye(3), np.eye(3)
    left_shift[:2, 2] = back_px
    right_shift[:2, 2] = moved_px, back_px[1]
    return _Homographies(left_shift @ turns.left, right_shift @ turns.right), moved_px


def _warp(
    image: UInt8[np.ndarray, "h w 3"],
    turn: Float[np.ndarray, "3 3"],
    seen: Bool[np.ndarray, "h w"] | None,
) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Warp a picture, repeating its border; return it with the mask of its valid pixels."""
    size = image.shape[1::-1]
    before = np.ones(image.shape[:2], np.uint8) if seen is None else seen.astype(np.uint8)
    warped = cv2.warpPerspective(image, turn, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    shown = cv2.warpPerspective(255 * before, turn, size, flags=cv2.INTER_LINEAR)
    return warped, shown == 255


def _transform(
    turn: Float[np.ndarray, "3 3"], places_px: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    return cv2.perspectiveTransform(places_px[None], turn)[0]


def _transform_rows(
    turn: Float[np.ndarray, "3 3"], places_px: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, " n"]:
    return _transform(turn, places_px)[:, 1]
