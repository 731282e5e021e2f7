"""Errors by class: which known pixels are hidden, near depth edges, plain or textured, and how wrong each is.

The classes come from the truth and the left picture alone, so that two matchers are compared on the same
pixels. Every known pixel is in exactly one class, the first that it fits:

    outside        its match lies left of the right picture
    occluded       in the right picture a nearer surface covers it
    thin_or_edge   within 3 px of a depth edge (edges.py), or on something less than 15 px wide
    plain          the grey levels change by less than 1 a pixel
    weak_texture   by less than 2
    textured       by 2 or more
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stereoweave.bench.edge_metrics import EDGE_STEP_PX, near_edge
from stereoweave.bench.metrics import bad_percent, epe_px

CLASSES = ("outside", "occluded", "thin_or_edge", "plain", "weak_texture", "textured")
ALL = "all"
THIN_PX = 15
PLAIN_LEVELS_PER_PX = 1.0
WEAK_LEVELS_PER_PX = 2.0
# With it, plain noise of 3 levels stays under 1 level a pixel in 93 % of the pixels: it is no texture.
_SMOOTHING_PX = 1.0
# A slanted surface covers itself by less than this; a nearer one by more.
_COVERED_STEP_PX = 1.0


@dataclass(frozen=True, kw_only=True)
class ClassErrors:
    """Errors of an estimate in one class of pixels; NaN where the class is empty.

    Attributes:
        share_percent: Known pixels that are in the class.
        bad1_percent, bad2_percent: Known pixels that are in the class and off by over 1 or 2 px. Those of all
            classes add up to the estimate's bad-1 and bad-2; 0 in an empty class.
        bad1_within_percent, bad2_within_percent: Pixels of the class that are off by over 1 or 2 px.
        epe_px: Mean absolute error in the class.
    """

    share_percent: float
    bad1_percent: float
    bad2_percent: float
    bad1_within_percent: float
    bad2_within_percent: float
    epe_px: float


def classify(
    left: UInt8[np.ndarray, "h w 3"],
    truth_px: Float[np.ndarray, "h w"],
    occluded: Bool[np.ndarray, "h w"] | None = None,
) -> dict[str, Bool[np.ndarray, "h w"]]:
    """Masks of the classes by name, in their order; each known pixel is in exactly one.

    Args:
        left: RGB.
        truth_px: True disparity of the left view; NaN and infinity are unknown.
        occluded: True occlusion of the left view, with or without the pixels outside the right picture; found
            from truth_px unless given, where an occluder of unknown disparity hides nothing.
    """
    known = np.isfinite(truth_px)
    known_px = np.where(known, truth_px, np.nan)
    gradient = _measure_gradient(left)
    fitting = {
        "outside": np.arange(truth_px.shape[1]) - known_px < 0,
        "occluded": find_covered(known_px) if occluded is None else occluded,
        "thin_or_edge": near_edge(truth_px) | _find_thin(known_px),
        "plain": gradient < PLAIN_LEVELS_PER_PX,
        "weak_texture": gradient < WEAK_LEVELS_PER_PX,
        "textured": known,
    }
    masks, left_over = {}, known
    for name in CLASSES:
        masks[name] = left_over & fitting[name]
        left_over = left_over & ~masks[name]
    return masks


def class_errors(
    estimate_px: Float[np.ndarray, "h w"],
    truth_px: Float[np.ndarray, "h w"],
    masks: dict[str, Bool[np.ndarray, "h w"]],
) -> dict[str, ClassErrors]:
    """Errors of an estimate in each class and, last, in `ALL` known pixels.

    Args:
        estimate_px: Disparity of the left view; NaN is bad.
        truth_px: As for `classify`.
        masks: From `classify`.
    """
    known = np.isfinite(truth_px)
    return {
        name: _measure_errors(mask, estimate_px, truth_px, int(known.sum()))
        for name, mask in {**masks, ALL: known}.items()
    }


def find_covered(truth_px: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Known pixels whose column in the right picture shows a surface over 1 px nearer.

    Found from the left truth alone: every known pixel is moved to the closest column of the right picture,
    where the nearest surface stays.
    """
    width = truth_px.shape[1]
    target = np.rint(np.arange(width) - truth_px)
    rows, columns = np.nonzero((target >= 0) & (target < width))
    targets = target[rows, columns].astype(np.intp)
    disparity_px = truth_px[rows, columns]
    nearest_px = np.full(truth_px.shape, -np.inf, truth_px.dtype)
    np.maximum.at(nearest_px, (rows, targets), disparity_px)
    found = np.zeros(truth_px.shape, bool)
    found[rows, columns] = nearest_px[rows, targets] > disparity_px + _COVERED_STEP_PX
    return found


def _find_thin(known_px: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels over an edge's step nearer than both their sides, which are less than THIN_PX apart."""
    # Unknown pixels are taken as near, so that they bound nothing.
    surface_px = np.where(np.isnan(known_px), np.inf, known_px).astype(np.float32)
    behind_px = np.full_like(surface_px, np.inf)
    for window in ((1, THIN_PX), (THIN_PX, 1)):
        opened_px = cv2.morphologyEx(surface_px, cv2.MORPH_OPEN, np.ones(window, np.uint8))
        behind_px = np.minimum(behind_px, opened_px)
    return known_px - behind_px > EDGE_STEP_PX


def _measure_gradient(left: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """Gradient magnitude of the smoothed grey picture, in levels of 0..255 a pixel."""
    grey = cv2.cvtColor(left, cv2.COLOR_RGB2GRAY).astype(np.float32)
    smooth = cv2.GaussianBlur(grey, (0, 0), _SMOOTHING_PX)
    # Sobel's weights sum to 8 over a difference of two pixels' distance.
    along_x, along_y = (cv2.Sobel(smooth, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
    return np.hypot(along_x, along_y)


def _measure_errors(
    mask: Bool[np.ndarray, "h w"],
    estimate_px: Float[np.ndarray, "h w"],
    truth_px: Float[np.ndarray, "h w"],
    known: int,
) -> ClassErrors:
    truth_within_px = np.where(mask, truth_px, np.nan)
    count = int(mask.sum())
    share = count / known if known else float("nan")
    bad1, bad2 = (bad_percent(estimate_px, truth_within_px, threshold_px) for threshold_px in (1, 2))
    return ClassErrors(
        share_percent=100 * share,
        bad1_percent=share * bad1 if count else share,
        bad2_percent=share * bad2 if count else share,
        bad1_within_percent=bad1,
        bad2_within_percent=bad2,
        epe_px=epe_px(estimate_px, truth_within_px),
    )
