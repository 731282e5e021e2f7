"""Fit of two rotated cameras with the same lens to feature matches."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from stereoweave.cameras.feature_matches import Matches
from stereoweave.cameras.picture_warp import PictureWarp, undistort

# The fit starts from each of these distortions: none, and those of wide lenses.
_DISTORTIONS = (0.0, -0.25, -0.5)
_MOST_DISTORTION = 0.9
_STEPS = 25
# The fit ends when a step improves the loss by less than this share.
_LEAST_GAIN = 1e-6
_STEP = 1e-6
# Scale of the robust loss.
_SOFT_PX = 0.5
# Standard deviations of the prior: of the angles in radians, of log(focal length / width), of log(scale), of
# the distortion and of the right principal point. Where the matches do not determine the solution, the prior
# selects the smallest change. A standard deviation of _FIXED fixes a parameter.
_FIXED = 1e-6
_LIKELY = np.array([0.05] * 5 + [0.3, 0.05, 0.1, _FIXED])
_ANGLES, _LOG_FOCAL, _LOG_SCALE, _DISTORTION, _LOWER = slice(0, 5), 5, 6, 7, 8
# The same for cameras of known focal length. Without it, a lower principal point cannot be distinguished from
# a pitch.
_PARALLEL = 1e-4
_LIKELY_IF_KNOWN = np.array([0.05] * 5 + [_FIXED, 0.05, 0.1, 0.02])


class Warps(NamedTuple):
    """Warps of both pictures, after which corresponding rows coincide."""

    left: PictureWarp
    right: PictureWarp

    def transform(self, matches: Matches) -> Matches:
        """Return the matches' positions in the warped pictures."""
        return Matches(self.left.transform(matches.left_px), self.right.transform(matches.right_px))


@dataclass(frozen=True, kw_only=True)
class CameraFit:
    """Parameters of two cameras that took a pair.

    The left camera is rotated by yaw and roll, and the right one by pitch, yaw and roll. A common pitch does
    not change the alignment of rows, so the left camera has none. Both lenses have the same distortion.

    Attributes:
        parameters: left yaw and roll, right pitch, yaw and roll in radians, log(focal length / width), log of
            the right focal length divided by the left one, the distortion (see `PictureWarp`), and how much
            lower the right principal point is than the centre, divided by the width.
        size_px: Width and height of the pictures.
        known_focal_px: Focal length of the left camera, which is not fitted; None if it is unknown.
        parallel: Whether the cameras look into the same direction, apart from a difference in height. The
            disparities of the warped pair then give metric depth.
    """

    parameters: Float[np.ndarray, " 9"]
    size_px: tuple[int, int]
    known_focal_px: float | None = None
    parallel: bool = False

    @property
    def largest_degrees(self) -> float:
        return float(np.degrees(np.abs(self.parameters[_ANGLES]).max()))

    @property
    def scale(self) -> float:
        """Size of the right picture's content, divided by that of the left one's."""
        return float(np.exp(self.parameters[_LOG_SCALE]))

    @property
    def distortion(self) -> float:
        return float(self.parameters[_DISTORTION])

    @property
    def toe_in(self) -> float:
        """Horizontal angle between the optical axes in radians."""
        left, right = self.turns
        return float(right[0, 2] - left[0, 2])

    @property
    def turns(self) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]]:
        """Rotations of the left and the right camera to the common direction."""
        left_yaw, left_roll, right_pitch, right_yaw, right_roll = self.parameters[_ANGLES]
        left, _ = cv2.Rodrigues(np.array([0.0, left_yaw, left_roll]))
        right, _ = cv2.Rodrigues(np.array([right_pitch, right_yaw, right_roll]))
        return left, right

    def make_warps(self) -> Warps:
        """Return the warps that turn both cameras to a common direction, and remove the distortion."""
        left, right = self.turns
        width, height = self.size_px
        focal_px = width * np.exp(self.parameters[_LOG_FOCAL])
        camera = np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]])
        right_camera = camera.copy()
        right_camera[[0, 1], [0, 1]] *= self.scale
        right_camera[1, 2] += width * self.parameters[_LOWER]
        homographies = (camera @ left @ np.linalg.inv(camera), camera @ right @ np.linalg.inv(right_camera))
        return Warps(
            *(
                PictureWarp(homography=homography, distortion=self.distortion, size_px=self.size_px)
                for homography in homographies
            )
        )

    def measure_sampson_px(self, matches: Matches) -> Float[np.ndarray, " n"]:
        """Return Sampson errors: first-order distances from the epipolar lines, in undistorted px."""
        warps = self.make_warps()
        across = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
        fundamental = warps.right.homography.T @ across @ warps.left.homography
        ones = np.ones((len(matches.left_px), 1))
        left, right = (
            np.hstack([undistort(places_px, self.distortion, self.size_px), ones]) for places_px in matches
        )
        lines_right, lines_left = left @ fundamental.T, right @ fundamental
        squared = (lines_right[:, :2] ** 2).sum(1) + (lines_left[:, :2] ** 2).sum(1)
        return (right * lines_right).sum(1) / np.sqrt(squared)


def fit_cameras(matches: Matches, size_px: tuple[int, int], known_focal_px: float | None = None) -> CameraFit:
    """Fit two cameras to matches of which few are wrong.

    The fit starts from several distortions; the best result is returned.

    Args:
        matches: The matches.
        size_px: Width and height of the pictures.
        known_focal_px: Focal length of the left camera, if known.
    """
    log_focal = np.log(known_focal_px / size_px[0]) if known_focal_px else 0.0
    starts = (
        CameraFit(
            parameters=np.array([0.0] * _LOG_FOCAL + [log_focal, 0.0, distortion, 0.0]),
            size_px=size_px,
            known_focal_px=known_focal_px,
        )
        for distortion in _DISTORTIONS
    )
    return min((_fit_from(start, matches) for start in starts), key=lambda found: found[1])[0]


def make_parallel_cameras(size_px: tuple[int, int], focal_px: float) -> CameraFit:
    """Return cameras that look into the same direction, without distortion; their warps change nothing."""
    parameters = np.zeros(len(_LIKELY))
    parameters[_LOG_FOCAL] = np.log(focal_px / size_px[0])
    return CameraFit(parameters=parameters, size_px=size_px, known_focal_px=focal_px, parallel=True)


def fit_again(start: CameraFit, matches: Matches) -> CameraFit:
    """Fit the cameras to other matches, starting from an earlier fit."""
    return _fit_from(start, matches)[0]


def _fit_from(fit: CameraFit, matches: Matches) -> tuple[CameraFit, float]:
    """Minimise the robust loss by Levenberg-Marquardt with numeric derivatives; return fit and loss."""
    missed, damping = _list_errors(fit, matches), 1e-3
    for _ in range(_STEPS):
        moves = _STEP * np.eye(len(fit.parameters))
        slopes = np.stack([(_list_errors(_move(fit, move), matches) - missed) / _STEP for move in moves], 1)
        normal = slopes.T @ slopes
        step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), slopes.T @ missed)
        tried = _move(fit, step)
        errors = _list_errors(tried, matches)
        gain = missed @ missed - errors @ errors
        if abs(tried.distortion) > _MOST_DISTORTION or not gain > 0:
            damping *= 10
            continue
        done = gain < _LEAST_GAIN * (missed @ missed)
        fit, missed, damping = tried, errors, damping / 10
        if done:
            break
    return fit, float(missed @ missed)


def _move(fit: CameraFit, step: Sequence[float] | Float[np.ndarray, " 9"]) -> CameraFit:
    return replace(fit, parameters=fit.parameters + step)


def _list_errors(fit: CameraFit, matches: Matches) -> Float[np.ndarray, " n"]:
    """Return the roots of the terms of the loss: one for each match, and one for each parameter's prior."""
    missed_px = fit.measure_sampson_px(matches)
    softened = np.sign(missed_px) * _SOFT_PX * np.sqrt(np.log1p((missed_px / _SOFT_PX) ** 2))
    return np.concatenate([softened, _list_prior_errors(fit)])


def _list_prior_errors(fit: CameraFit) -> Float[np.ndarray, " m"]:
    if fit.known_focal_px is None:
        return fit.parameters / _LIKELY
    middle = np.zeros(len(fit.parameters))
    middle[_LOG_FOCAL] = np.log(fit.known_focal_px / fit.size_px[0])
    errors = (fit.parameters - middle) / _LIKELY_IF_KNOWN
    # Rows tell little about the angle between the cameras, but all disparities depend on it.
    return np.append(errors, fit.toe_in / _PARALLEL) if fit.parallel else errors
