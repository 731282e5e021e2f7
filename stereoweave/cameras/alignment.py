"""Measurement of a stereo pair's alignment, with remedies for its defects."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stereoweave.cameras.baseline_direction import STACKED, has_vertical_baseline
from stereoweave.cameras.disparity_sign import estimate_depth_order, find_negative_disparities
from stereoweave.cameras.feature_matches import Matches, find_matches
from stereoweave.cameras.vertical_errors import VerticalErrors, fit_vertical_errors
from stereoweave.errors import Note, Remedy

Defect = Literal[
    "too_few_matches",
    "unrelated",
    "stacked",
    "same_picture",
    "swapped",
    "vertical_shift",
    "rotation",
    "scale",
    "not_rectified",
    "exposure",
    "negative_disparity",
]
DEFECTS: tuple[Defect, ...] = get_args(Defect)
ROW_DEFECTS: tuple[Defect, ...] = ("vertical_shift", "rotation", "scale", "not_rectified")

SWAPPED = Note("left and right are swapped", Remedy("give them the other way round"))
RECTIFY = Remedy("rectify the pair", ("rectify",))

# Tolerated vertical error; the tolerance grows with the side length of larger pictures.
_TOLERATED_PX = 0.75
_TOLERATED_DEGREES = 0.3
_TOLERATED_STOPS = 0.58
_PIXELS_OF_TOLERANCE = 1_500_000

_LEAST_MATCHES = 20
# A match's disparity counts if it agrees with the disparities of at least this many neighbours.
_NEIGHBOURS, _LEAST_AGREEING = 8, 4
_AGREE_PX, _AGREE_SHARE = 2.0, 0.05
_OUTER_PERCENT = 1.0
# From this percentage of negative disparities on, infinity is not at a disparity of 0. A converged 3-D lens
# gave 82 %.
_LEAST_NEGATIVE_PERCENT = 5.0

# Exposure is compared in windows of this size, and only at levels that neither image clips.
_LIGHT_WINDOW_PX = 7
_BLACK_LEVEL, _WHITE_LEVEL = 8, 250
_GAMMA = 2.2

# A pair whose disparities are all smaller than this shows no depth.
_LEAST_PARALLAX_PX = 0.5
# Texture is measured in windows of this size; pictures have texture if this share of them has.
_TEXTURE_WINDOW_PX, _TEXTURED_LEVELS, _LEAST_TEXTURED_SHARE = 9, 2.0, 0.2

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
        scale: Size of the right image's content divided by that of the left one's.
        range_px: Least and greatest disparity, without the outermost 1 % at each end.
        negative_percent: Share of the matches whose disparity is negative; 0 if none is reliably so.
        exposure_ratio: Exposure of the right image divided by that of the left image; NaN if unknown.
        defects: Names of the defects found, from `DEFECTS`; empty for a sound pair.
    """

    matches: int
    vertical_error_px: float
    vertical_error_95_px: float
    vertical_shift_px: float
    rotation_degrees: float
    scale: float
    range_px: tuple[float, float]
    negative_percent: float
    exposure_ratio: float
    defects: tuple[Defect, ...]

    @property
    def is_known(self) -> bool:
        """Whether enough points match, and along the rows; if not, all numbers but `matches` are NaN."""
        return not math.isnan(self.vertical_error_px)

    @property
    def is_rectified(self) -> bool:
        """Whether enough points match, and all corresponding points lie in the same image rows."""
        return self.is_known and not set(self.defects) & set(ROW_DEFECTS)

    @property
    def needs_doffs(self) -> bool:
        """Whether so many disparities are negative that focal length and baseline alone give no metres."""
        return "negative_disparity" in self.defects and self.negative_percent >= _LEAST_NEGATIVE_PERCENT

    def lines(self) -> list[Note]:
        """Return all findings as notes, each once, with remedies for the defects."""
        if not self.is_known:
            return self.warnings()
        least_px, greatest_px = self.range_px
        exposure = f"the right picture has {self.exposure_ratio:.2f} times the exposure of the left one"
        if math.isnan(self.exposure_ratio):
            exposure = "unknown, because matching areas are too dark or too bright"
        found = [
            f"vertical error at {self.matches} matches: median {self.vertical_error_px:.2f} px, "
            f"95 % below {self.vertical_error_95_px:.2f} px",
            f"disparities: {least_px:.0f} to {greatest_px:.0f} px",
        ]
        if "exposure" not in self.defects:
            found.append(f"exposure: {exposure}")
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
                    f"expected pictures with more texture, found {self._describe_matches()}; the alignment "
                    "of plain pictures cannot be checked"
                )
            case "unrelated":
                return Note(
                    f"expected two pictures of the same scene, found {self._describe_matches()}; the "
                    "pictures show different scenes, or were taken from points too far apart",
                    Remedy("give the two pictures of one pair"),
                )
            case "stacked":
                return STACKED
            case "same_picture":
                return Note(
                    f"left and right show the same view: all disparities are {self._describe_range()} px, "
                    "so no depth can be seen",
                    Remedy("give two pictures from two positions"),
                )
            case "swapped":
                return SWAPPED
            case "vertical_shift" | "rotation" | "scale" | "not_rectified":
                return Note(self._describe_rows(defect), RECTIFY)
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

    def _describe_matches(self) -> str:
        found = f"{self.matches} matching points"
        if self.matches < _LEAST_MATCHES:
            return f"{found} of the {_LEAST_MATCHES} that are needed"
        return f"{found}, of which fewer than the {_LEAST_MATCHES} that are needed agree"

    def _describe_range(self) -> str:
        # Adding 0 turns -0.0 into 0.0.
        least, greatest = (f"{round(px, 1) + 0.0:.1f}" for px in self.range_px)
        return least if least == greatest else f"{least} to {greatest}"

    def _describe_rows(self, defect: Defect) -> str:
        match defect:
            case "vertical_shift":
                lower = "lower" if self.vertical_shift_px > 0 else "higher"
                return f"the right picture is {abs(self.vertical_shift_px):.1f} px {lower} than the left one"
            case "rotation":
                way = "clockwise" if self.rotation_degrees > 0 else "anticlockwise"
                return f"the right picture is rotated {abs(self.rotation_degrees):.1f} degrees {way}"
            case "scale":
                which = "larger" if self.scale > 1 else "smaller"
                return f"the right picture is {100 * abs(self.scale - 1):.1f} % {which} than the left one"
        return (
            "the pair is not rectified: vertical errors vary over the picture, and 95 % of them are below "
            f"{self.vertical_error_95_px:.1f} px"
        )


def check_pair(left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"]) -> Alignment:
    """Measure the alignment of a pair, rectified or not.

    This takes 0.1 to 0.2 s at 640x480.
    """
    found = find_matches(left, right)
    scale = max(1.0, (left.shape[0] * left.shape[1] / _PIXELS_OF_TOLERANCE) ** 0.5)
    count = len(found.left_px)
    centre_px = (np.array(right.shape[1::-1]) - 1) / 2
    errors = fit_vertical_errors(found, centre_px, scale) if count >= _LEAST_MATCHES else None
    if errors is None:
        return _make_unknown(count, _explain_few_matches(left, right))
    if has_vertical_baseline(found, scale):
        return _make_unknown(count, "stacked")
    matches = found.select(errors.inliers)
    # A rotation also moves the upper and lower parts of the picture sideways.
    disparity_px = matches.disparity_px - errors.slope * (matches.right_px[:, 1] - centre_px[1])
    shared = _find_supported(matches, disparity_px, scale)
    disparity_px = disparity_px[shared]
    if len(disparity_px) < _LEAST_MATCHES:
        return _make_unknown(count, _explain_few_matches(left, right))
    small = _shrink(left, scale), _level(_shrink(right, scale), errors.shift_px / scale, errors.slope)
    negative_px = scale * find_negative_disparities(
        *small, matches.left_px[shared] / scale, disparity_px / scale
    )
    least_px, greatest_px = _measure_range(disparity_px, negative_px)
    is_negative = disparity_px < -scale * _LEAST_PARALLAX_PX
    ratio = _measure_light_ratio(left, right, matches)
    defects = _find_row_defects(errors, disparity_px, centre_px[1], scale)
    if abs(np.log2(ratio)) > _TOLERATED_STOPS:
        defects.add("exposure")
    if max(-least_px, greatest_px) < scale * _LEAST_PARALLAX_PX:
        defects.add("same_picture")
    elif len(negative_px):
        order = estimate_depth_order(*small, (least_px / scale, greatest_px / scale))
        usual = _CLEAR_VOTE * (2 * float((disparity_px < 0).mean()) - 1)
        swapped = greatest_px < -least_px and order < usual
        defects.add("swapped" if swapped else "negative_disparity")
    rows_px = np.abs(matches.lower_px)
    return Alignment(
        matches=count,
        vertical_error_px=float(np.median(rows_px)),
        vertical_error_95_px=float(np.percentile(rows_px, 95)),
        vertical_shift_px=errors.shift_px,
        rotation_degrees=float(np.degrees(errors.slope)),
        scale=1 / (1 - errors.growth),
        range_px=(least_px, greatest_px),
        negative_percent=100 * float(is_negative.mean()) if len(negative_px) else 0.0,
        exposure_ratio=ratio,
        defects=tuple(defect for defect in DEFECTS if defect in defects),
    )


def _find_row_defects(
    errors: VerticalErrors, disparity_px: Float[np.ndarray, " n"], half_height_px: float, scale: float
) -> set[Defect]:
    # A rotation about a point other than the centre of the right picture also looks like a shift.
    tolerated_px = scale * _TOLERATED_PX + abs(errors.slope) * float(np.median(np.abs(disparity_px)))
    is_present: dict[Defect, bool] = {
        "vertical_shift": abs(errors.shift_px) > tolerated_px,
        "rotation": abs(np.degrees(errors.slope)) > _TOLERATED_DEGREES,
        "scale": abs(errors.growth) * half_height_px > 2 * scale * _TOLERATED_PX,
        "not_rectified": errors.uneven_px > 2 * scale * _TOLERATED_PX,
    }
    return {defect for defect, present in is_present.items() if present}


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


def _explain_few_matches(left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"]) -> Defect:
    """Return why a pair has too few matches: it is plain, or of two scenes."""
    textured = min(_measure_textured_share(image) for image in (left, right)) > _LEAST_TEXTURED_SHARE
    return "unrelated" if textured else "too_few_matches"


def _make_unknown(matches: int, defect: Defect) -> Alignment:
    """Return the alignment of a pair whose rows cannot be compared."""
    nan = float("nan")
    return Alignment(
        matches=matches,
        vertical_error_px=nan,
        vertical_error_95_px=nan,
        vertical_shift_px=nan,
        rotation_degrees=nan,
        scale=nan,
        range_px=(nan, nan),
        negative_percent=nan,
        exposure_ratio=nan,
        defects=(defect,),
    )


def _measure_textured_share(image: UInt8[np.ndarray, "h w 3"]) -> float:
    """Return the share of an image where grey levels vary."""
    slope = cv2.Sobel(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.CV_32F, 1, 0, scale=1 / 8)
    return float((cv2.blur(np.abs(slope), (_TEXTURE_WINDOW_PX,) * 2) > _TEXTURED_LEVELS).mean())


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
