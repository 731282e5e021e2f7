"""Measurement of a stereo pair's alignment, with remedies for its defects."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stereoweave.cameras.disparity_sign import estimate_depth_order, find_negative_disparities
from stereoweave.cameras.feature_matches import Matches, find_matches
from stereoweave.errors import Note, Remedy

Defect = Literal[
    "too_few_matches",
    "swapped",
    "vertical_shift",
    "rotation",
    "not_rectified",
    "exposure",
    "negative_disparity",
]
DEFECTS: tuple[Defect, ...] = get_args(Defect)

SWAPPED = Note("left and right are swapped", Remedy("give them the other way round"))
_RECTIFY = Remedy("rectify the pair", ("rectify",))

# Tolerated vertical error; the tolerance grows with the side length of larger pictures.
_TOLERATED_PX = 0.75
_TOLERATED_DEGREES = 0.3
_TOLERATED_STOPS = 0.58
_PIXELS_OF_TOLERANCE = 1_500_000

# Inliers lie within this distance of the fitted field of vertical errors.
_INLIER_PX = 1.5
_FIRST_INLIER_PX = 2.5
_TRIALS, _POLISHING = 400, 6
_LEAST_MATCHES, _LEAST_INLIER_SHARE = 20, 0.2
# A match's disparity counts if it agrees with the disparities of at least this many neighbours.
_NEIGHBOURS, _LEAST_AGREEING = 8, 4
_AGREE_PX, _AGREE_SHARE = 2.0, 0.05
_OUTER_PERCENT = 1.0

# Exposure is compared in windows of this size, and only at levels that neither image clips.
_LIGHT_WINDOW_PX = 7
_BLACK_LEVEL, _WHITE_LEVEL = 8, 250
_GAMMA = 2.2

# The vote on the depth order must be this clear to overrule the signs of the disparities.
_CLEAR_VOTE = 0.15


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """Alignment of a pair, measured at feature matches.

    Attributes:
        matches: Number of matches.
        vertical_error_px, vertical_error_95_px: Median and 95th percentile of the vertical error.
        vertical_shift_px: Vertical shift of the right image at its centre; positive if that image is lower.
        rotation_degrees: Clockwise rotation of the right image.
        range_px: Least and greatest disparity, without the outermost 1 % at each end.
        exposure_ratio: Exposure of the right image divided by that of the left image; NaN if unknown.
        defects: Names of the defects found, from `DEFECTS`; empty for a sound pair.
    """

    matches: int
    vertical_error_px: float
    vertical_error_95_px: float
    vertical_shift_px: float
    rotation_degrees: float
    range_px: tuple[float, float]
    exposure_ratio: float
    defects: tuple[Defect, ...]

    def lines(self) -> list[Note]:
        """Return all findings as notes, with remedies for the defects."""
        if "too_few_matches" in self.defects:
            return [self._note("too_few_matches")]
        least_px, greatest_px = self.range_px
        exposure = f"the right picture has {self.exposure_ratio:.2f} times the exposure of the left one"
        if math.isnan(self.exposure_ratio):
            exposure = "unknown, because matching areas are too dark or too bright"
        found = [
            f"vertical error at {self.matches} matches: median {self.vertical_error_px:.2f} px, "
            f"95 % below {self.vertical_error_95_px:.2f} px",
            f"disparities: {least_px:.0f} to {greatest_px:.0f} px",
            f"exposure: {exposure}",
        ]
        defects = [self._note(defect) for defect in self.defects]
        sound = Note("no defects: the pair is rectified, and left and right are not swapped")
        return [*map(Note, found), *(defects or [sound])]

    def warnings(self) -> list[Note]:
        """Return notes on the defects that impair depth: all except negative disparities."""
        return [self._note(defect) for defect in self.defects if defect != "negative_disparity"]

    def _note(self, defect: Defect) -> Note:
        match defect:
            case "too_few_matches":
                return Note(
                    f"expected two pictures of the same scene, found {self.matches} matching points; the "
                    "pictures may be too plain, too different or taken from points too far apart"
                )
            case "swapped":
                return SWAPPED
            case "vertical_shift":
                lower = "lower" if self.vertical_shift_px > 0 else "higher"
                return Note(
                    f"the right picture is {abs(self.vertical_shift_px):.1f} px {lower} than the left one",
                    _RECTIFY,
                )
            case "rotation":
                way = "clockwise" if self.rotation_degrees > 0 else "anticlockwise"
                return Note(
                    f"the right picture is rotated {abs(self.rotation_degrees):.1f} degrees {way}", _RECTIFY
                )
            case "not_rectified":
                return Note(
                    "the pair is not rectified: vertical errors vary over the picture, and 95 % of them are "
                    f"below {self.vertical_error_95_px:.1f} px",
                    _RECTIFY,
                )
            case "exposure":
                ratio = max(self.exposure_ratio, 1 / self.exposure_ratio)
                which = "right" if self.exposure_ratio > 1 else "left"
                return Note(
                    f"the {which} picture has {ratio:.1f} times the exposure of the other: depth is less "
                    "reliable where either picture is too dark or too bright",
                    Remedy("lock the exposure of both cameras"),
                )
            case "negative_disparity":
                return Note(
                    f"disparities go down to {self.range_px[0]:.0f} px, as in 3-D films: matching supports "
                    "this, but metric depth requires doffs besides focal length and baseline"
                )


def check_pair(left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"]) -> Alignment:
    """Measure the alignment of a pair, rectified or not.

    This takes 0.1 to 0.2 s at 640x480.
    """
    matches = find_matches(left, right)
    scale = max(1.0, (left.shape[0] * left.shape[1] / _PIXELS_OF_TOLERANCE) ** 0.5)
    count = len(matches.left_px)
    centre_px = (np.array(right.shape[1::-1]) - 1) / 2
    field = _fit_vertical_error(matches, centre_px, scale) if count >= _LEAST_MATCHES else None
    if field is None:
        return _make_unrelated(count)
    inliers, shift_px, slope, uneven_px = field
    matches = Matches(matches.left_px[inliers], matches.right_px[inliers])
    # A rotation also moves the upper and lower parts of the picture sideways.
    disparity_px = matches.disparity_px - slope * (matches.right_px[:, 1] - centre_px[1])
    shared = _find_supported(matches, disparity_px, scale)
    disparity_px = disparity_px[shared]
    if len(disparity_px) < _LEAST_MATCHES:
        return _make_unrelated(count)
    small = _shrink(left, scale), _level(_shrink(right, scale), shift_px / scale, slope)
    negative_px = scale * find_negative_disparities(
        *small, matches.left_px[shared] / scale, disparity_px / scale
    )
    least_px, greatest_px = _measure_range(disparity_px, negative_px)
    ratio = _measure_light_ratio(left, right, matches)
    # A rotation about a point other than the centre of the right picture also looks like a shift.
    tolerated_px = scale * _TOLERATED_PX + abs(slope) * float(np.median(np.abs(disparity_px)))
    is_present = {
        "vertical_shift": abs(shift_px) > tolerated_px,
        "rotation": abs(np.degrees(slope)) > _TOLERATED_DEGREES,
        "not_rectified": uneven_px > 2 * scale * _TOLERATED_PX,
        "exposure": abs(np.log2(ratio)) > _TOLERATED_STOPS,
    }
    if len(negative_px):
        order = estimate_depth_order(*small, (least_px / scale, greatest_px / scale))
        usual = _CLEAR_VOTE * (2 * float((disparity_px < 0).mean()) - 1)
        swapped = greatest_px < -least_px and order < usual
        is_present["swapped" if swapped else "negative_disparity"] = True
    rows_px = np.abs(matches.lower_px)
    return Alignment(
        matches=count,
        vertical_error_px=float(np.median(rows_px)),
        vertical_error_95_px=float(np.percentile(rows_px, 95)),
        vertical_shift_px=shift_px,
        rotation_degrees=float(np.degrees(slope)),
        range_px=(least_px, greatest_px),
        exposure_ratio=ratio,
        defects=tuple(defect for defect in DEFECTS if is_present.get(defect)),
    )


def _measure_range(
    disparity_px: Float[np.ndarray, " n"], negative_px: Float[np.ndarray, " m"]
) -> tuple[float, float]:
    """Return the disparity range, less 1 % at each end; ignore negative values if none are reliable."""
    at_least_0 = disparity_px[disparity_px >= 0]
    counted_px = disparity_px if len(negative_px) or not len(at_least_0) else at_least_0
    least_px, greatest_px = np.percentile(counted_px, [_OUTER_PERCENT, 100 - _OUTER_PERCENT])
    if len(negative_px):
        least_px = min(least_px, np.median(negative_px))
    return float(least_px), float(greatest_px)


def _make_unrelated(matches: int) -> Alignment:
    nan = float("nan")
    return Alignment(
        matches=matches,
        vertical_error_px=nan,
        vertical_error_95_px=nan,
        vertical_shift_px=nan,
        rotation_degrees=nan,
        range_px=(nan, nan),
        exposure_ratio=nan,
        defects=("too_few_matches",),
    )


def _fit_vertical_error(
    matches: Matches, centre_px: Float[np.ndarray, " 2"], scale: float
) -> tuple[Bool[np.ndarray, " n"], float, float, float] | None:
    """Fit the vertical error; return inliers, shift in px, slope and the size of the other terms in px.

    The vertical error is modelled as a quadratic function of the position in the right picture. The constant
    term is a shift, and the term in x is a rotation; scale, pitch and convergence cause the other terms.
    Returns None if no such function explains enough matches.
    """
    x, y = ((matches.right_px - centre_px) / centre_px[0]).T
    terms = np.stack([np.ones_like(x), x, y, x * y, x * x, y * y], axis=1)
    lower_px = matches.lower_px
    inliers = _find_plane_inliers(terms[:, :3], lower_px, scale * _FIRST_INLIER_PX)
    for _ in range(_POLISHING):
        # The ridge limits terms that only a few matches support.
        weights, ridge = terms[inliers], 0.1 * np.eye(6)
        field = np.linalg.solve(weights.T @ weights + ridge, weights.T @ lower_px[inliers])
        inliers = np.abs(terms @ field - lower_px) <= scale * _INLIER_PX
    if inliers.sum() < max(_LEAST_MATCHES, _LEAST_INLIER_SHARE * len(x)):
        return None
    uneven_px = np.abs(terms[inliers, 2:] @ field[2:])
    return inliers, float(field[0]), float(field[1] / centre_px[0]), float(np.percentile(uneven_px, 95))


def _find_plane_inliers(
    terms: Float[np.ndarray, "n 3"], values: Float[np.ndarray, " n"], tolerated: float
) -> Bool[np.ndarray, " n"]:
    """Return the inliers of the best plane found by RANSAC; the zero plane is one of the candidates."""
    rng = np.random.default_rng(0)
    picked = rng.integers(0, len(values), (_TRIALS, 3))
    through = terms[picked]
    picked, through = (array[np.abs(np.linalg.det(through)) > 0.01] for array in (picked, through))
    planes = np.linalg.solve(through, values[picked][..., None])[..., 0]
    planes = np.concatenate([np.zeros((1, 3)), planes])
    missed = np.minimum(np.abs(planes @ terms.T - values), tolerated)
    best = missed.sum(1).argmin()
    return missed[best] < tolerated


def _find_supported(
    matches: Matches, disparity_px: Float[np.ndarray, " n"], scale: float
) -> Bool[np.ndarray, " n"]:
    """Return the mask of matches whose disparity agrees with the disparities of enough neighbours."""
    squared = (matches.left_px**2).sum(1)
    apart = squared[:, None] + squared - 2 * matches.left_px @ matches.left_px.T
    count = min(_NEIGHBOURS + 1, len(apart))
    nearest = np.argpartition(apart, count - 1, axis=1)[:, :count]
    tolerated_px = _AGREE_PX * scale + _AGREE_SHARE * np.abs(disparity_px)
    agreeing = np.abs(disparity_px[nearest] - disparity_px[:, None]) <= tolerated_px[:, None]
    return agreeing.sum(1) - 1 >= _LEAST_AGREEING  # each match agrees with itself


def _measure_light_ratio(
    left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"], matches: Matches
) -> float:
    """Return the median ratio of right to left exposure over the matches; NaN if too few are usable."""
    levels = _sample_levels(left, matches.left_px), _sample_levels(right, matches.right_px)
    usable = np.logical_and(*((level > _BLACK_LEVEL) & (level < _WHITE_LEVEL) for level in levels))
    if usable.sum() < _LEAST_MATCHES:
        return float("nan")
    return float(np.median(levels[1][usable] / levels[0][usable]) ** _GAMMA)


def _sample_levels(
    image: UInt8[np.ndarray, "h w 3"], places_px: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "3 n"]:
    """Return the 15th, 50th and 85th percentiles of the strongest channel around each point."""
    offsets = np.arange(_LIGHT_WINDOW_PX) - _LIGHT_WINDOW_PX // 2
    height, width = image.shape[:2]
    nearest = np.rint(places_px).astype(int)
    columns = np.clip(nearest[:, 0, None, None] + offsets, 0, width - 1)
    rows = np.clip(nearest[:, 1, None, None] + offsets[:, None], 0, height - 1)
    return np.percentile(image[rows, columns].max(3), [15, 50, 85], axis=(1, 2))


def _shrink(image: UInt8[np.ndarray, "h w 3"], scale: float) -> UInt8[np.ndarray, "h2 w2 3"]:
    if scale == 1:
        return image
    size = max(round(image.shape[1] / scale), 1), max(round(image.shape[0] / scale), 1)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _level(image: UInt8[np.ndarray, "h w 3"], shift_px: float, slope: float) -> UInt8[np.ndarray, "h w 3"]:
    """Undo the vertical shift and the rotation of the right image."""
    height, width = image.shape[:2]
    x, y = (width - 1) / 2, (height - 1) / 2
    source = np.array([[1, -slope, slope * y], [slope, 1, shift_px - slope * x]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(image, source, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
