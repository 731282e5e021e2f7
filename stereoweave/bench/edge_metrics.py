"""Disparity errors and flying pixels near depth edges, where new views tear and smear.

An edge lies between two neighbours, in a row or a column, whose known true disparities differ by more than
2 px. On a surface that both cameras see well, disparity changes by less than 1 px from pixel to pixel. A
known pixel is near an edge if it is one of the three pixels on either side. Sparse ground truth, such as from
a laser scanner, has edges only between known neighbours. If there are no edges, every metric is NaN.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float

from stereoweave.bench.metrics import bad_percent, epe_px

EDGE_STEP_PX = 2.0
NEAR_PX = 3
FLYING_PX = 2.0


def near_edge(truth_px: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the mask of the known pixels within three pixels of an edge, including diagonally."""
    known_px = np.where(np.isfinite(truth_px), truth_px, np.nan).astype(np.float64)
    at_edge = np.zeros(truth_px.shape, np.uint8)
    for axis in (0, 1):
        # Unknown pixels are NaN, and NaN never counts as a step.
        step = np.abs(np.diff(known_px, axis=axis)) > EDGE_STEP_PX
        before, after = ([(0, 0), (0, 0)] for _ in range(2))
        before[axis], after[axis] = (0, 1), (1, 0)
        at_edge |= np.pad(step, before) | np.pad(step, after)
    # The pixels on either side of the edge are the first of the three.
    band = cv2.dilate(at_edge, np.ones((2 * NEAR_PX - 1, 2 * NEAR_PX - 1), np.uint8))
    return (band > 0) & np.isfinite(truth_px)


def edge_epe_px(estimate_px: Float[np.ndarray, "h w"], truth_px: Float[np.ndarray, "h w"]) -> float:
    """Return the mean absolute disparity error, in pixels, over the known pixels near an edge."""
    return epe_px(estimate_px, _truth_near_edges(truth_px))


def edge_bad_percent(
    estimate_px: Float[np.ndarray, "h w"], truth_px: Float[np.ndarray, "h w"], threshold_px: float
) -> float:
    """Return the percentage of known pixels near an edge whose disparity is off by more than threshold_px."""
    return bad_percent(estimate_px, _truth_near_edges(truth_px), threshold_px)


def flying_percent(estimate_px: Float[np.ndarray, "h w"], truth_px: Float[np.ndarray, "h w"]) -> float:
    """Return the percentage of known pixels near an edge whose estimate lies on neither surface.

    A pixel is flying if its estimate differs by more than 2 px from every known true disparity in the 7x7
    neighbourhood, which reaches across the edge. The estimate then lies between the two surfaces, in front
    of both or behind both. Slanted surfaces do not count as flying. An edge that is displaced by up to 3 px
    causes errors but no flying pixels.
    """
    near = near_edge(truth_px)
    # A pixel within 2 px of its own truth is on a surface; only the few others need the search.
    rows, columns = np.nonzero(near & ~(np.abs(estimate_px - truth_px.astype(np.float64)) <= FLYING_PX))
    around_px = np.pad(truth_px.astype(np.float64), NEAR_PX, constant_values=np.nan)
    windows_px = np.lib.stride_tricks.sliding_window_view(around_px, (2 * NEAR_PX + 1, 2 * NEAR_PX + 1))
    distances_px = np.abs(windows_px[rows, columns] - estimate_px[rows, columns, None, None])
    flying = ~(distances_px <= FLYING_PX).any(axis=(1, 2))
    return 100 * float(flying.sum() / near.sum()) if near.any() else float("nan")


def _truth_near_edges(truth_px: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Return the truth near edges, and NaN (unknown) elsewhere."""
    return np.where(near_edge(truth_px), truth_px, np.nan)
