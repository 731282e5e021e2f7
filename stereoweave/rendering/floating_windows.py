"""Floating windows: black bars at the borders of the two eyes' views where near objects are cut off.

An object in front of the screen that the picture's left or right border cuts off is seen farther by one eye
than by the other one, and the border hides what is nearer than it. A bar at the left border of the left eye's
view, or at the right border of the right eye's view, as wide as the object's parallax, brings the border of
the picture forward to the object. Source: B. Mendiburu, "3D Movie Making", 2009.
"""

import math

import numpy as np
from jaxtyping import Float, Num

from stereoweave.rendering.comfort import CONFIDENT, find_grid
from stereoweave.stereo import Estimate

# Columns at each border that are looked at, in percent of the picture's width, but at least two columns.
_BORDER_PERCENT = 1.0
# Smaller parallaxes in front of the screen, in percent of the width, disturb nobody.
_LEAST_PERCENT = 0.2
# An object must reach the border in this share of the rows.
_LEAST_ROWS_SHARE = 0.02
_WIDEST_PERCENT = 6.0
# About this many rows, evenly spread, are enough.
_MOST_ROWS = 240
_NEAREST_PERCENT = 0.2


def find_windows_px(estimate: Estimate, *, strength: float, convergence_px: float) -> tuple[float, float]:
    """Return the widths of the bars at the left and at the right border; 0 where nothing is cut off.

    Args:
        estimate: The pair's estimate.
        strength: Strength of the views, which are from the positions 0 and 1 (see `Renderer`).
        convergence_px: Convergence of the views.
    """
    left = _find_bar_px(estimate.disparity_px, strength, convergence_px)
    # The right view's own disparities, mirrored, so that its right border is the first column.
    right = _find_bar_px(estimate.right_disparity_px[:, ::-1], strength, convergence_px)
    most_px = max(strength * (_find_nearest_px(estimate) - convergence_px), 0.0)
    return min(left, most_px), min(right, most_px)


def cut_windows(
    eyes: tuple[Num[np.ndarray, "h w 3"], Num[np.ndarray, "h w 3"]], windows_px: tuple[float, float]
) -> list[Num[np.ndarray, "h w 3"]]:
    """Return the left and the right eye's views with the bars; the inner column of a bar may be grey."""
    left, right = eyes
    cut = [left, right]
    if windows_px[0] > 0:
        cut[0] = _blacken(left, windows_px[0])
    if windows_px[1] > 0:
        cut[1] = np.ascontiguousarray(_blacken(right[:, ::-1], windows_px[1])[:, ::-1])
    return cut


def _find_nearest_px(estimate: Estimate) -> float:
    """Return the disparity of the nearest confident pixels; infinity if there are none.

    At the borders, only one camera sees the scene, and disparities may be wrong.
    """
    grid = find_grid(estimate)
    sure = (estimate.confidence[grid] >= CONFIDENT) & ~estimate.occluded[grid]
    if not sure.any():
        return math.inf
    return float(np.percentile(estimate.disparity_px[grid][sure], 100 - _NEAREST_PERCENT))


def _find_bar_px(disparity_px: Float[np.ndarray, "h w"], strength: float, convergence_px: float) -> float:
    """Return the width of the bar at the left border of the left eye's view.

    The view's columns are those of the left image, moved as `Renderer` moves them.
    """
    disparity_px = disparity_px[:: max(1, len(disparity_px) // _MOST_ROWS)]
    height, width = disparity_px.shape
    border_px = max(2.0, _BORDER_PERCENT / 100 * width)
    position = 0.5 - strength / 2
    offset_px = (position - 0.5) * convergence_px
    # Beyond this column, no surface is near enough to be moved to the border.
    reach = int(np.clip(border_px + abs(offset_px) + position * np.abs(disparity_px).max() + 1, 1, width))
    seen_px = disparity_px[:, :reach]
    columns = np.arange(reach) - position * seen_px + offset_px
    parallax_px = strength * (seen_px - convergence_px)
    at_border = (columns >= 0) & (columns < border_px)
    nearest_px = np.where(at_border, parallax_px, -np.inf).max(1)
    counted = max(1, round(_LEAST_ROWS_SHARE * height))
    bar_px = float(np.partition(nearest_px, height - counted)[height - counted])
    if not bar_px >= _LEAST_PERCENT / 100 * width:
        return 0.0
    return min(bar_px, _WIDEST_PERCENT / 100 * width)


def _blacken(eye: Num[np.ndarray, "h w 3"], bar_px: float) -> Num[np.ndarray, "h w 3"]:
    """Return a view with a bar at its left border, whose last column is as grey as it is covered."""
    whole = min(int(bar_px), eye.shape[1])
    cut = eye.copy()
    cut[:, :whole] = 0
    if whole < eye.shape[1]:
        cut[:, whole] = np.rint(cut[:, whole] * (1 - (bar_px - whole))).astype(eye.dtype)
    return cut
