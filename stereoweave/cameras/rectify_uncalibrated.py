"""Rectification without a calibration, from feature matches."""

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float

from stereoweave.cameras.baseline_direction import STACKED, has_vertical_baseline
from stereoweave.cameras.camera_fit import CameraFit, Warps, fit_again, fit_cameras, make_parallel_cameras
from stereoweave.cameras.feature_matches import Matches, find_matches
from stereoweave.cameras.picture_warp import undistort
from stereoweave.cameras.rectify import Rectified
from stereoweave.cameras.row_field import RowField, fit_row_field
from stereoweave.errors import Note, Remedy, StereoweaveError
from stereoweave.stereo import StereoCamera, StereoPair

_LEAST_MATCHES = 40
_LEAST_RIGHT_SHARE = 0.3
# Distances in px are for pictures of this many pixels, and grow with the side length of larger ones.
_PIXELS_OF_DISTANCE = 1_500_000
# The first selection allows this distance from the epipolar lines, because it ignores distortion. Then the
# matches are selected by the fitted cameras, within smaller and smaller distances.
_FIRST_PX = 3.0
_SELECTIONS_PX = (4.0, 2.0)
_RIGHT_PX = 1.0
# Matches within this distance after warping determine the field of vertical moves.
_FIELD_PX = 6.0
# The field is used if it reduces the loss of matches that it was not fitted to to this share.
_FIELD_SHARE = 0.8
_SOFT_PX = 0.5
_MOST_TURN_DEGREES = 20.0
# Cameras are taken for parallel up to this angle between them, which is fitted freely first.
_MOST_TOE_IN_DEGREES = 0.5
# Largest difference in focal length; a larger one is taken for a camera that moved forward.
_MOST_SCALE = 0.07
_MOST_RESIDUAL_PX = 1.0
# Smaller changes are not worth a note.
_NOTABLE_DISTORTION, _NOTABLE_SCALE_PERCENT = 0.02, 0.2
# Both pictures are scaled down if more than this percentage of either would be outside the result. It is
# measured on a grid with this many points along each side.
_MOST_LOST_PERCENT, _GRID = 8.0, 33
# This percentage of the smallest disparities may come from wrong matches.
_OUTER_PERCENT = 1.0


@dataclass(frozen=True, kw_only=True)
class Fit:
    """The warps that rectify a pair, and what is known about them.

    Attributes:
        cameras: The fitted cameras.
        warps: Warps of both pictures.
        matches: The matches that agree with the warps, in px of the original pictures.
        note: Description of the warps.
    """

    cameras: CameraFit
    warps: Warps
    matches: Matches
    note: Note

    def apply(self, pair: StereoPair) -> StereoPair:
        """Warp both pictures of a pair; the result has masks, and a camera if the fit gives metric depth."""
        camera = self._warp_camera(pair.camera) if pair.camera and self.cameras.parallel else None
        return replace(apply_warps(pair, self.warps), camera=camera)

    def _warp_camera(self, camera: StereoCamera) -> StereoCamera:
        """Return the camera of the warped pair: turns keep a camera, but scaling and moving change it."""
        turned = self.cameras.make_warps().left.homography
        moved = self.warps.left.homography @ np.linalg.inv(turned)
        zoom = float(moved[0, 0])
        cx_px, cy_px, _ = (moved @ [camera.cx_px, camera.cy_px, 1.0]).tolist()
        return StereoCamera(
            focal_px=zoom * camera.focal_px,
            baseline_m=camera.baseline_m,
            cx_px=cx_px,
            cy_px=cy_px,
            doffs_px=zoom * camera.doffs_px,
        )


class _Candidate(NamedTuple):
    """Fitted cameras and their warps."""

    cameras: CameraFit
    warps: Warps


def rectify_by_features(pair: StereoPair) -> Rectified:
    """Rectify a pair using its feature matches.

    Both pictures are warped by the smallest camera rotations that suffice. The focal length, the difference
    in scale and the lens distortion are fitted too. Unlike arbitrary homographies, rotations preserve shapes.
    If rows remain apart, as with a rolling shutter, a smooth field of vertical moves aligns them.

    The result has a camera if the pair has one and the fit finds its cameras parallel. The focal length is
    then kept, and the result is not moved sideways, so that disparity gives metric depth. Otherwise, where
    infinity is remains unknown.

    Source: "Quasi-Euclidean epipolar rectification of uncalibrated images" (Fusiello and Irsara 2011).

    Raises:
        StereoweaveError: There are too few matches, no rotation aligns their rows, or one camera is above the
            other.
    """
    found = fit_warps(pair)
    return Rectified(pair=found.apply(pair), notes=(found.note,))


def apply_warps(pair: StereoPair, warps: Warps) -> StereoPair:
    """Warp both pictures of a pair; the result has masks, and no camera."""
    left, left_seen = warps.left.apply(pair.left, pair.left_seen)
    right, right_seen = warps.right.apply(pair.right, pair.right_seen)
    return replace(pair, left=left, right=right, camera=None, left_seen=left_seen, right_seen=right_seen)


def fit_warps(pair: StereoPair, *, parallel: bool = False, keep_screen: bool = False) -> Fit:
    """Fit the warps of `rectify_by_features`; raises the same errors.

    With `keep_screen`, for a pair without a camera, the right picture is moved so that the median disparity
    stays, scaled as the pictures are: the same things are then in front of the screen as before.
    With `parallel`, the maker of the pair's camera states parallel axes and no distortion: rows are then only
    bent, which keeps the disparities, unless this leaves them too far apart.
    """
    height, width = pair.left.shape[:2]
    scale = max(1.0, (width * height / _PIXELS_OF_DISTANCE) ** 0.5)
    found = find_matches(pair.left, pair.right)
    if len(found.left_px) >= _LEAST_MATCHES and has_vertical_baseline(found, scale):
        raise StereoweaveError(STACKED.text, remedy=STACKED.remedy)
    first = _select_inliers(found, scale * _FIRST_PX)
    if pair.camera and parallel:
        with suppress(StereoweaveError):
            stated = make_parallel_cameras((width, height), pair.camera.focal_px)
            unturned = _Candidate(stated, stated.make_warps())
            return _make_fit(_bend_rows(unturned, found, scale) or unturned, found, scale)
    if pair.camera:
        with suppress(StereoweaveError):
            cameras = fit_cameras(first, (width, height), pair.camera.focal_px)
            cameras = _fit_closely(cameras, found, scale)
            if abs(np.degrees(cameras.toe_in)) < _MOST_TOE_IN_DEGREES:
                return _finish(replace(cameras, parallel=True), found, scale)
    cameras = _fit_closely(fit_cameras(first, (width, height)), found, scale)
    return _finish(cameras, found, scale, keep_screen=keep_screen)


def _fit_closely(cameras: CameraFit, found: Matches, scale: float) -> CameraFit:
    """Fit the cameras to the matches within smaller and smaller distances."""
    for within_px in _SELECTIONS_PX:
        cameras = _fit_again(cameras, found, scale * within_px)
    return cameras


def _finish(cameras: CameraFit, found: Matches, scale: float, *, keep_screen: bool = False) -> Fit:
    if cameras.parallel:
        cameras = _fit_again(cameras, found, scale * _SELECTIONS_PX[-1])
    place = partial(_place, found=found, scale=scale, keep_screen=keep_screen)
    smooth = _bend_rows(place(cameras), found, scale)
    chosen = smooth or place(_fit_again(cameras, found, scale * _RIGHT_PX))
    return _make_fit(chosen, found, scale)


def _make_fit(chosen: _Candidate, found: Matches, scale: float) -> Fit:
    """Return the fit of these warps; raise a StereoweaveError if they leave the rows apart."""
    missed_px = np.abs(chosen.warps.transform(found).lower_px)
    agreeing = _require_enough(found, missed_px < scale * _RIGHT_PX)
    _check(chosen.cameras, float(np.median(missed_px[missed_px < scale * _SELECTIONS_PX[-1]])), scale)
    return Fit(cameras=chosen.cameras, warps=chosen.warps, matches=agreeing, note=_describe(chosen, agreeing))


def _select_inliers(found: Matches, within_px: float) -> Matches:
    """Return the matches that are consistent with the same epipolar geometry."""
    count = len(found.left_px)
    right_ones = np.zeros(count, bool)
    if count >= _LEAST_MATCHES:
        with suppress(cv2.error):  # raised if no geometry explains any match
            _, mask = cv2.findFundamentalMat(
                found.left_px, found.right_px, cv2.USAC_MAGSAC, within_px, 0.9999, 5000
            )
            right_ones = right_ones if mask is None else mask.ravel() > 0
    return _require_enough(found, right_ones)


def _fit_again(cameras: CameraFit, found: Matches, within_px: float) -> CameraFit:
    """Fit the cameras to the matches within this distance of their epipolar lines."""
    matches = _require_enough(found, np.abs(cameras.measure_sampson_px(found)) < within_px)
    return fit_again(cameras, matches)


def _require_enough(found: Matches, right_ones: Bool[np.ndarray, " n"]) -> Matches:
    """Return the matches that agree; raise a StereoweaveError if there are too few."""
    count = len(right_ones)
    needed = max(_LEAST_MATCHES, math.ceil(_LEAST_RIGHT_SHARE * count))
    if right_ones.sum() < needed:
        raise StereoweaveError(
            f"expected at least {needed} feature matches that agree on the camera positions, "
            f"found {right_ones.sum()} of {count} matches; "
            "photograph a scene with more texture and with more overlap",
            setting="rectify",
            remedy=Remedy("or give a calibration", ("calibration",)),
        )
    return found.select(right_ones)


def _place(cameras: CameraFit, found: Matches, scale: float, *, keep_screen: bool) -> _Candidate:
    """Return the cameras' warps, moved and scaled so that little of the pictures is lost.

    The left picture stays centred. The right one is shifted so that the median disparity stays with
    `keep_screen`; otherwise to the left if disparities would be negative, unless they give metric depth.
    """
    warps = cameras.make_warps()
    matches = _require_enough(found, np.abs(cameras.measure_sampson_px(found)) < scale * _SELECTIONS_PX[-1])
    moved = warps.transform(matches)
    back_x, back_y = np.median(matches.left_px, 0) - np.median(moved.left_px, 0)
    warps = Warps(warps.left.shifted((back_x, back_y)), warps.right.shifted((back_x, back_y)))
    zoom = _find_zoom(warps)
    warps = Warps(*(warp.scaled(zoom) for warp in warps))
    if cameras.parallel:
        return _Candidate(cameras, warps)
    aligned_px = warps.transform(matches).disparity_px
    if keep_screen:
        moved_px = float(np.median(aligned_px) - zoom * np.median(matches.disparity_px))
    else:
        moved_px = float(np.floor(min(np.percentile(aligned_px, _OUTER_PERCENT), 0.0)))
    return _Candidate(cameras, Warps(warps.left, warps.right.shifted((moved_px, 0.0))))


def _find_zoom(warps: Warps) -> float:
    """Return the largest scale, at most 1, at which little of both pictures is lost."""
    width, height = warps.left.size_px
    columns, rows = np.meshgrid(np.linspace(0, width - 1, _GRID), np.linspace(0, height - 1, _GRID))
    grid_px = np.column_stack([columns.ravel(), rows.ravel()])
    centre_px = (np.array(warps.left.size_px) - 1) / 2
    away = np.abs([warp.transform(grid_px) - centre_px for warp in warps]) / centre_px
    away[1, :, 0] = 0  # the right picture may leave sideways, as its disparities require
    farthest = np.percentile(away.max(2), 100 - _MOST_LOST_PERCENT, axis=1).max()
    return float(min(1.0, 1 / farthest))


def _bend_rows(candidate: _Candidate, found: Matches, scale: float) -> _Candidate | None:
    """Return the candidate with a field of vertical moves; None if the field is of little use."""
    moved = candidate.warps.transform(found)
    near = moved.select(np.abs(moved.lower_px) < scale * _FIELD_PX)
    places_px, lower_px = np.stack([near.right_px[:, 0], near.left_px[:, 1]], axis=1), near.lower_px / scale
    half = np.arange(len(lower_px)) % 2 == 0
    left_px = np.empty(len(lower_px))
    size_px = candidate.cameras.size_px
    for fitted in (half, ~half):
        field = fit_row_field(places_px[fitted], lower_px[fitted], size_px)
        left_px[~fitted] = lower_px[~fitted] - field.measure_lower_px(places_px[~fitted])
    if _sum_loss(left_px) > _FIELD_SHARE * _sum_loss(lower_px):
        return None
    field = fit_row_field(places_px, lower_px, size_px)
    field = RowField(terms_px=scale * field.terms_px, size_px=size_px)
    left, right = candidate.warps
    return candidate._replace(warps=Warps(left, replace(right, field=field)))


def _sum_loss(missed_px: Float[np.ndarray, " n"]) -> float:
    return float(np.log1p((missed_px / _SOFT_PX) ** 2).sum())


def _check(cameras: CameraFit, residual_px: float, size_scale: float) -> None:
    if (
        residual_px > _MOST_RESIDUAL_PX * size_scale
        or cameras.largest_degrees > _MOST_TURN_DEGREES
        or abs(cameras.scale - 1) > _MOST_SCALE
    ):
        raise StereoweaveError(
            f"expected cameras side by side, rotated by less than {_MOST_TURN_DEGREES:.0f} degrees and with "
            f"less than {_MOST_SCALE:.0%} difference in scale, found vertical errors of {residual_px:.1f} px "
            f"after a rotation of {cameras.largest_degrees:.0f} degrees, and a scale difference of "
            f"{cameras.scale - 1:+.0%}; take the pictures from two positions side by side, without moving "
            "forward",
            setting="rectify",
        )


def _describe(chosen: _Candidate, matches: Matches) -> Note:
    moved = chosen.warps.transform(matches)
    scaled_percent = 100 * (1 / chosen.cameras.scale - 1)
    changes = []
    if abs(scaled_percent) > _NOTABLE_SCALE_PERCENT:
        way = "larger" if scaled_percent > 0 else "smaller"
        changes.append(f"the right picture was made {abs(scaled_percent):.1f} % {way}")
    if abs(chosen.cameras.distortion) > _NOTABLE_DISTORTION:
        corner_px = np.zeros((1, 2))
        moved_px = undistort(corner_px, chosen.cameras.distortion, chosen.cameras.size_px) - corner_px
        by_px = float(np.hypot(*moved_px[0]))
        changes.append(f"lens distortion was removed, which moved the corners by {by_px:.0f} px")
    if chosen.warps.right.field:
        turned = chosen.cameras.largest_degrees > 0
        changes.append("rows were bent" + (" where the rotation left them apart" if turned else ""))
    rows = (
        f"rectified: rows are off by {np.median(np.abs(moved.lower_px)):.2f} px, the median of "
        f"{len(matches.left_px)} matches ({np.median(np.abs(matches.lower_px)):.2f} px before)"
    )
    return Note("; ".join([rows, *changes]))
