"""Check of one frame of a stereo video: depth, differences between the eyes, and what the borders cut off."""

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from jaxtyping import Float, UInt8

from stereoweave.cameras.alignment import Alignment, check_pair
from stereoweave.cameras.auto_align import align_rows
from stereoweave.matching.estimate import match
from stereoweave.matching.matcher import Matcher
from stereoweave.rendering.comfort import CONFIDENT, Depth, measure_depth
from stereoweave.rendering.floating_windows import find_windows_px
from stereoweave.stereo import Estimate, StereoPair
from stereoweave.video.reader import StereoFrame
from stereoweave.video.survey import scale_down

_NAN = float("nan")
# Defects of a pair that are none of a frame: 3-D films have negative disparities, and titles are plain.
_NO_DEFECTS = ("negative_disparity", "too_few_matches")
# An eye is empty if its levels vary by at most this much and the other eye's by at least that much.
_EMPTY_LEVELS, _FILLED_LEVELS = 3.0, 8.0
# Levels that neither image clips, and the fewest pixels for a comparison of colours.
_BLACK_LEVEL, _WHITE_LEVEL, _LEAST_PIXELS = 8, 250, 200
_GAMMA = 2.2
_TOLERATED_COLOUR_STOPS = 0.3
# A column is black if no level is above this; compression makes black bars uneven.
_BLACKEST_LEVEL, _TOLERATED_CUT_PX = 24, 1.5


@dataclass(frozen=True, kw_only=True)
class FrameCheck:
    """What a frame of a video shows; a number is NaN if it could not be measured.

    Attributes:
        time: Time of the frame in seconds.
        depth: Disparities of the rectified frame, with the eyes as they are, swapped or not; None if unknown.
        rows_px: Median vertical error.
        shift_px: Vertical shift of the right image; positive if it is lower.
        rotation_degrees: Clockwise rotation of the right image.
        larger_percent: Size of the right image's content in comparison with the left one's, less 100 %.
        exposure_stops: Exposure of the right image in comparison with the left one; positive if brighter.
        colour_stops: Difference between the exposures of two colour channels, compared in this way.
        windows_px: Parallax of what the left and the right border cut off in front of the screen, if the
            video is shown as it is.
        defects: Names of the defects found: those of `Alignment`, and "colour", "empty_left", "empty_right".
    """

    time: Fraction
    depth: Depth | None = None
    rows_px: float = _NAN
    shift_px: float = _NAN
    rotation_degrees: float = _NAN
    larger_percent: float = _NAN
    exposure_stops: float = _NAN
    colour_stops: float = _NAN
    windows_px: tuple[float, float] = (0.0, 0.0)
    defects: tuple[str, ...] = ()


def check_frame(frame: StereoFrame, matcher: Matcher) -> FrameCheck:
    """Measure a frame: its alignment at full size, its depth and colours at a smaller one."""
    empty = find_empty_eye(frame.left, frame.right)
    if empty:
        return FrameCheck(time=frame.time, defects=(empty,))
    whole = StereoPair(left=frame.left, right=frame.right)
    alignment = check_pair(whole.left, whole.right)
    # Swapped eyes stay so: a vote on single frames would swap some of a shot and not others.
    aligned = align_rows(whole, keep_screen=True)
    pair, scale = scale_down(aligned.pair)
    estimate = match(matcher, pair)
    gains = measure_gains(pair, estimate)
    exposure_stops, colour_stops = _measure_light(alignment, gains)
    defects: list[str] = [name for name in alignment.defects if name not in _NO_DEFECTS]
    if "swapped" in aligned.alignment.defects and "swapped" not in defects:
        defects.append("swapped")
    if colour_stops > _TOLERATED_COLOUR_STOPS:
        defects.append("colour")
    depth = _find_depth(alignment, estimate, scale)
    return FrameCheck(
        time=frame.time,
        depth=depth,
        rows_px=alignment.vertical_error_px,
        shift_px=alignment.vertical_shift_px,
        rotation_degrees=alignment.rotation_degrees,
        larger_percent=100 * (alignment.scale - 1),
        exposure_stops=exposure_stops,
        colour_stops=colour_stops,
        # Without confident pixels, nothing is known to be near.
        windows_px=_find_cut_px(alignment, pair, estimate, scale) if depth else (0.0, 0.0),
        defects=tuple(defects),
    )


def find_empty_eye(left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"]) -> str | None:
    """Return "empty_left" or "empty_right" if one image is uniform and the other one is not."""
    left_levels, right_levels = (float(image[::4, ::4].std()) for image in (left, right))
    if left_levels <= _EMPTY_LEVELS and right_levels >= _FILLED_LEVELS:
        return "empty_left"
    if right_levels <= _EMPTY_LEVELS and left_levels >= _FILLED_LEVELS:
        return "empty_right"
    return None


def measure_gains(pair: StereoPair, estimate: Estimate) -> Float[np.ndarray, " 3"] | None:
    """Return the exposure of the right image divided by the left one's, for red, green and blue.

    It is compared at the confident pixels that no image clips; None if they are too few.
    """
    rows, columns = np.nonzero((estimate.confidence >= CONFIDENT) & ~estimate.occluded)
    there = np.rint(columns - estimate.disparity_px[rows, columns]).astype(int)
    inside = (there >= 0) & (there < pair.left.shape[1])
    rows, columns, there = rows[inside], columns[inside], there[inside]
    left, right = pair.left[rows, columns].astype(float), pair.right[rows, there].astype(float)
    gains = []
    for channel in range(3):
        levels = left[:, channel], right[:, channel]
        usable = np.logical_and(*((level > _BLACK_LEVEL) & (level < _WHITE_LEVEL) for level in levels))
        if usable.sum() < _LEAST_PIXELS:
            return None
        gains.append(float(np.median(levels[1][usable] / levels[0][usable]) ** _GAMMA))
    return np.array(gains)


def _measure_light(alignment: Alignment, gains: Float[np.ndarray, " 3"] | None) -> tuple[float, float]:
    """Return the differences of the right image from the left one in exposure and in colour, in stops."""
    colour_stops = _NAN if gains is None else float(np.ptp(np.log2(gains)))
    if math.isfinite(alignment.exposure_ratio):
        return math.log2(alignment.exposure_ratio), colour_stops
    if gains is None:
        return _NAN, colour_stops
    return float(np.median(np.log2(gains))), colour_stops


def _find_depth(alignment: Alignment, estimate: Estimate, scale: float) -> Depth | None:
    if "same_picture" in alignment.defects:
        return Depth(0.0, 0.0, 0.0)
    found = measure_depth(estimate)
    return found and Depth(*(scale * px for px in found))


def measure_bars(pair: StereoPair) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the widths in px of the black bars at the left and at the right border, of both images."""
    bars = []
    for image in (pair.left, pair.right):
        bright = np.flatnonzero(image.max((0, 2)) > _BLACKEST_LEVEL)
        ends = (int(bright[0]), image.shape[1] - 1 - int(bright[-1])) if len(bright) else (0, 0)
        bars.append(ends)
    return bars[0], bars[1]


def _find_cut_px(
    alignment: Alignment, pair: StereoPair, estimate: Estimate, scale: float
) -> tuple[float, float]:
    if "same_picture" in alignment.defects:
        return 0.0, 0.0
    left_px, right_px = find_windows_px(estimate, strength=1.0, convergence_px=0.0)
    bars = measure_bars(pair)
    # A bar of one eye, a floating window, brings the border forward by its width.
    windows_px = max(bars[0][0] - bars[1][0], 0), max(bars[1][1] - bars[0][1], 0)
    left_px, right_px = (
        0.0 if px <= window_px + _TOLERATED_CUT_PX else px
        for px, window_px in zip((left_px, right_px), windows_px, strict=True)
    )
    return scale * left_px, scale * right_px
