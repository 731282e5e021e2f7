"""How an estimate does at depth edges, where new views tear and smear: errors near them, and flying pixels.

An edge runs between two neighbours, in a row or a column, whose known true disparities differ by over 2 px: a
surface that both cameras see well changes by less than 1 px from pixel to pixel. A known pixel is near an
edge if it is one of the three on either side. Where a sparse truth, as a laser gives it, has no neighbours,
there is no edge, and without any edge each number is NaN.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float

from stereoweave.bench.metrics import bad_percent, epe_px

EDGE_STEP_PX = 2.0
NEAR_PX = 3
FLYING_PX = 2.0


def near_edge(truth_px: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Known pixels among the three on either side of an edge, in rows, in columns and around its corners."""
    known_px = np.where(np.isfinite(truth_px), truth_px, np.nan).astype(np.float64)
    at_edge = np.zeros(truth_px.shape, np.uint8)
    for axis in (0, 1):
        # Unknown is NaN, which is no step.
        step = np.abs(np.diff(known_px, axis=axis)) > EDGE_STEP_PX
        before, after = ([(0, 0), (0, 0)] for _ in range(2))
        before[axis], after[axis] = (0, 1), (1, 0)
        at_edge |= np.pad(step, before) | np.pad(step, after)
    # The pixels on either side of the edge are the first of the three.
    band = cv2.dilate(at_edge, np.ones((2 * NEAR_PX - 1, 2 * NEAR_PX - 1), np.uint8))
    return (band > 0) & np.isfinite(truth_px)


def edge_epe_px(estimate_px: Float[np.ndarray, "h w"], truth_px: Float[np.ndarray, "h w"]) -> float:
    """Mean absolute error of disparity in pixels, of the known pixels near an edge."""
    return epe_px(estimate_px, _truth_near_edges(truth_px))


def edge_bad_percent(
    estimate_px: Float[np.ndarray, "h w"], truth_px: Float[np.ndarray, "h w"], threshold_px: float
) -> float:
    """Percent of the known pixels near an edge whose disparity is off by more than threshold_px."""
    return bad_percent(estimate_px, _truth_near_edges(truth_px), threshold_px)


def flying_percent(estimate_px: Float[np.ndarray, "h w"], truth_px: Float[np.ndarray, "h w"]) -> float:
    """Percent of the known pixels near an edge whose estimate lies on none of the surfaces there.

    It lies on none when it is over 2 px away from every known true disparity in the 7x7 pixels around it,
    which reach over the edge: between the two sides, before both or behind both. A slanted side does no harm,
    and an edge that is moved by up to 3 px has errors and no flying pixels.
    """
    near = near_edge(truth_px)
    # Within 2 px of its own truth a pixel is on a surface; only the few others have to be looked at.
    rows, columns = np.nonzero(near & ~(np.abs(estimate_px - truth_px.astype(np.float64)) <= FLYING_PX))
    around_px = np.pad(truth_px.astype(np.float64), NEAR_PX, constant_values=np.nan)
    windows_px = np.lib.stride_tricks.sliding_window_view(around_px, (2 * NEAR_PX + 1, 2 * NEAR_PX + 1))
    distances_px = np.abs(windows_px[rows, columns] - estimate_px[rows, columns, None, None])
    flying = ~(distances_px <= FLYING_PX).any(axis=(1, 2))
    return 100 * float(flying.sum() / near.sum()) if near.any() else float("nan")


def _truth_near_edges(truth_px: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """The truth where it is near an edge, and elsewhere NaN, which is unknown."""
    return np.where(near_edge(truth_px), truth_px, np.nan)
