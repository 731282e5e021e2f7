"""Strength, convergence and floating windows of a video's frames for a screen, smooth in time.

The path follows the frames in order and knows none of the frames to come, so that a conversion needs no
second pass, and an interrupted one continues as if it had not been interrupted.

Within a shot, convergence moves at most by 1 % of the picture's width a second, a third of a degree a
second on the television of `rendering.comfort`; strength falls by at most a quarter a second, and rises more
slowly. At a cut, strength changes at once, and convergence is set so that the middle of the new shot appears
where the middle of the old one was, as far as the screen's budget allows; it then moves on as within a shot.
Source: K. Templin, P. Didyk, K. Myszkowski, M. M. Hefeeda, H.-P. Seidel and W. Matusik, "Modeling and
Optimizing Eye Vergence Response to Stereoscopic Cuts", 2014: the farther depth jumps, the longer eyes take.
"""

import math
from collections.abc import Mapping
from dataclasses import astuple, dataclass
from fractions import Fraction

import numpy as np

from stereoweave.rendering.comfort import (
    SCREENS,
    Depth,
    ScreenChoice,
    ScreenFit,
    fit_depth,
    format_depth,
    measure_depth,
)
from stereoweave.rendering.floating_windows import find_windows_px
from stereoweave.stereo import Estimate

# Time constants, and the fastest changes a second.
_PLANE_S, _PLANE_PERCENT_PER_S = 0.5, 1.0
_STRENGTH_S, _FALL_PER_S, _RISE_PER_S = 0.5, 0.25, 0.05
_WINDOW_S, _WINDOW_PERCENT_PER_S = 0.2, 6.0
_LEAST_STRENGTH = 1e-3
# What is written as 0.0 % more than the budget is no more.
_TOLERATED_PERCENT = 0.05


@dataclass(frozen=True, kw_only=True)
class FrameComfort:
    """Strength, convergence and widths of the floating windows of one frame."""

    strength: float
    convergence_px: float
    windows_px: tuple[float, float]


@dataclass
class _Pose:
    """What the last frame showed, with lengths in percent of the picture's width.

    `is_settled` is 1 once the depth of a frame of the shot is known, else 0.
    """

    time_s: float = 0.0
    strength: float = 1.0
    plane: float = 0.0
    middle: float = 0.0
    left_window: float = 0.0
    right_window: float = 0.0
    is_settled: float = 0.0


@dataclass
class _Extent:
    """Least and greatest values so far, in percent of the picture's width."""

    least_strength: float = math.inf
    greatest_strength: float = -math.inf
    least_plane: float = math.inf
    greatest_plane: float = -math.inf
    front: float = -math.inf
    behind: float = -math.inf


class ComfortPath:
    """Finder of strength, convergence and windows, called with a video's frames in order.

    Args:
        choice: The screen, and the values that the user gave.
    """

    def __init__(self, choice: ScreenChoice) -> None:
        self._choice, self._screen = choice, SCREENS[choice.name]
        self._pose: _Pose | None = None
        self._extent = _Extent()

    def __call__(self, estimate: Estimate, time: Fraction, *, begins_shot: bool) -> FrameComfort:
        """Return the values for the next frame.

        Args:
            estimate: The frame's estimate.
            time: The frame's time in seconds.
            begins_shot: Whether the frame is the first one of a shot.
        """
        width_px = estimate.disparity_px.shape[1]
        depth = _measure_percent(estimate)
        pose = self._pose or _Pose(time_s=float(time))
        passed_s = max(float(time) - pose.time_s, 0.0)
        if begins_shot:
            pose.is_settled = 0.0
        begins = not pose.is_settled
        if depth:
            # After a fade, the first frame whose depth is known counts as the first one of the shot.
            given_px = self._choice.convergence_px
            given = None if given_px is None else 100 * given_px / width_px
            self._move(pose, depth, given, None if begins else passed_s)
            pose.is_settled = 1.0
        pose.time_s = float(time)
        self._pose = pose
        windows = 0.0, 0.0
        if depth:
            windows = self._find_windows(estimate, pose, None if begins else passed_s)
            self._note(pose, depth)
        return FrameComfort(
            strength=pose.strength,
            convergence_px=pose.plane / 100 * width_px,
            windows_px=(windows[0] / 100 * width_px, windows[1] / 100 * width_px),
        )

    def state(self) -> dict[str, np.ndarray]:
        """Return the complete state as arrays; a restored path gives the same results."""
        kept = {"comfort_extent": np.array(astuple(self._extent))}
        return kept | ({"comfort_pose": np.array(astuple(self._pose), float)} if self._pose else {})

    @classmethod
    def from_state(cls, choice: ScreenChoice, state: Mapping[str, np.ndarray]) -> "ComfortPath":
        """Restore a path from a saved `state`."""
        path = cls(choice)
        path._extent = _Extent(*state["comfort_extent"].tolist())
        if "comfort_pose" in state:
            path._pose = _Pose(*state["comfort_pose"].tolist())
        return path

    def describe(self, width_px: int) -> str:
        """Return a line about the values of all frames so far, for pictures of this width."""
        extent = self._extent
        if extent.least_strength > extent.greatest_strength:
            return f"{self._choice.name}: no depth was found, so nothing was changed"
        planes_px = (extent.least_plane / 100 * width_px, extent.greatest_plane / 100 * width_px)
        strength = _format_ends("{:.2f}", extent.least_strength, extent.greatest_strength)
        plane = _format_ends("{:.1f}", *planes_px)
        depth = format_depth(extent.front, extent.behind)
        screen = self._screen
        fits = (
            extent.front <= screen.front_percent + _TOLERATED_PERCENT
            and extent.behind <= screen.behind_percent + _TOLERATED_PERCENT
        )
        ending = self._choice.describe_rest(fits=fits)
        return f"{self._choice.name}: strength {strength}, convergence {plane} px, depth {depth}{ending}"

    def _move(self, pose: _Pose, depth: Depth, given: float | None, passed_s: float | None) -> None:
        """Move strength and convergence towards what fits; `passed_s` is None where a shot begins."""
        aim = self._fit(depth, self._choice.strength, given)
        if passed_s is None:
            shown = pose.strength * (pose.middle - pose.plane)
            pose.strength = aim.strength
            # Where the middle of the new shot appears as far from the screen as that of the old one.
            plane = depth.middle_px - shown / max(pose.strength, _LEAST_STRENGTH)
            pose.plane = self._fit(depth._replace(middle_px=plane), pose.strength, given).convergence_px
        else:
            limits = _FALL_PER_S, _RISE_PER_S
            pose.strength = _follow(pose.strength, aim.strength, passed_s / _STRENGTH_S, limits, passed_s)
            most = _PLANE_PERCENT_PER_S / max(pose.strength, _LEAST_STRENGTH)
            plane = self._fit(depth, pose.strength, given).convergence_px
            pose.plane = _follow(pose.plane, plane, passed_s / _PLANE_S, (most, most), passed_s)
        pose.middle = depth.middle_px

    def _fit(self, depth: Depth, strength: float | None, plane: float | None) -> ScreenFit:
        """Fit disparities in percent of the width to the screen; the convergence is in percent too."""
        return fit_depth(depth, 100, self._screen, strength=strength, convergence_px=plane)

    def _find_windows(self, estimate: Estimate, pose: _Pose, passed_s: float | None) -> tuple[float, float]:
        """Return the widths of the windows in percent; they follow those that the frame needs."""
        width_px = estimate.disparity_px.shape[1]
        needed_px = find_windows_px(
            estimate, strength=pose.strength, convergence_px=pose.plane / 100 * width_px
        )
        left, right = (100 * px / width_px for px in needed_px)
        if passed_s is not None:
            share, limits = passed_s / _WINDOW_S, (_WINDOW_PERCENT_PER_S, _WINDOW_PERCENT_PER_S)
            left = _follow(pose.left_window, left, share, limits, passed_s)
            right = _follow(pose.right_window, right, share, limits, passed_s)
        pose.left_window, pose.right_window = left, right
        return left, right

    def _note(self, pose: _Pose, depth: Depth) -> None:
        extent = self._extent
        extent.least_strength = min(extent.least_strength, pose.strength)
        extent.greatest_strength = max(extent.greatest_strength, pose.strength)
        extent.least_plane = min(extent.least_plane, pose.plane)
        extent.greatest_plane = max(extent.greatest_plane, pose.plane)
        extent.front = max(extent.front, pose.strength * (depth.near_px - pose.plane))
        extent.behind = max(extent.behind, pose.strength * (pose.plane - depth.far_px))


def _measure_percent(estimate: Estimate) -> Depth | None:
    """Return a frame's disparities in percent of its width; None if too few are known."""
    found = measure_depth(estimate)
    width_px = estimate.disparity_px.shape[1]
    return found and Depth(*(100 * px / width_px for px in found))


def _follow(
    value: float, aim: float, share: float, limits_per_s: tuple[float, float], passed_s: float
) -> float:
    """Return a value that has followed an aim for some time.

    Args:
        value: The value before.
        aim: The value that it approaches.
        share: The passed time divided by the time constant.
        limits_per_s: How much it falls and rises at most in a second.
        passed_s: The passed time in seconds.
    """
    fall, rise = limits_per_s
    step = (aim - value) * (1 - math.exp(-share))
    return value + min(max(step, -fall * passed_s), rise * passed_s)


def _format_ends(form: str, low: float, high: float) -> str:
    ends = form.format(low), form.format(high)
    return ends[0] if ends[0] == ends[1] else " to ".join(ends)
