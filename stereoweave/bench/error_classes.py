"""Disparity errors by class of pixel: occluded, near depth edges, plain or textured.

The classes depend only on the ground truth and the left image, so all matchers are compared on the same
pixels. Every known pixel belongs to exactly one class, the first that applies:

    outside        its match lies beyond the right image's left border
    occluded       a nearer surface covers it in the right image
    thin_or_edge   within 3 px of a depth edge (edge_metrics.py), or on an object less than 15 px wide
    plain          gradient below 1 grey level per pixel
    weak_texture   gradient below 2
    textured       gradient of 2 or more
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
# After this smoothing, noise of 3 levels has a gradient below 1 in 93 % of pixels, so it is not texture.
_SMOOTHING_PX = 1.0
# Points of a slanted surface that land together differ by less than this; a nearer surface differs by more.
_COVERED_STEP_PX = 1.0


@dataclass(frozen=True, kw_only=True)
class ClassErrors:
    """Errors of an estimate in one class of pixels; errors within an empty class are NaN.

    Attributes:
        share_percent: Share of known pixels that are in the class.
        bad1_percent, bad2_percent: Share of known pixels that are in the class and off by more than 1 or
            2 px. Summed over the classes, they give the estimate's bad-1 and bad-2. In an empty class, they
            are 0.
        bad1_within_percent, bad2_within_percent: Share of the class that is off by more than 1 or 2 px.
        epe_px: Mean absolute error within the class.
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
    """Return a mask per class, in the order of `CLASSES`; each known pixel is in exactly one mask.

    Args:
        left: Left image in RGB.
        truth_px: True disparity of the left view; NaN and infinity mean unknown.
        occluded: True occlusion of the left view, with or without the pixels outside the right image.
            Default: computed from truth_px, where surfaces of unknown disparity occlude nothing.
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
    """Return an estimate's errors in each class, followed by those over all known pixels (`ALL`).

    Args:
        estimate_px: Disparity of the left view; NaN counts as bad.
        truth_px: See `classify`.
        masks: Masks from `classify`.
    """
    known = np.isfinite(truth_px)
    return {
        name: _measure_errors(mask, estimate_px, truth_px, int(known.sum()))
        for name, mask in {**masks, ALL: known}.items()
    }


def find_covered(truth_px: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the mask of the known pixels covered in the right image by a surface over 1 px nearer.

    Only the left truth is used: every known pixel is projected to the nearest column of the right image,
    where the nearest surface is kept.
    """
    width = truth_px.shape[1]
    # Not np.rint, which rounds halves to even: a surface at 0.5 px would cover every second column only.
    target = np.floor(np.arange(width) - truth_px + 0.5)
    rows, columns = np.nonzero((target >= 0) & (target < width))
    targets = target[rows, columns].astype(np.intp)
    disparity_px = truth_px[rows, columns]
    nearest_px = np.full(truth_px.shape, -np.inf, truth_px.dtype)
    np.maximum.at(nearest_px, (rows, targets), disparity_px)
    found = np.zeros(truth_px.shape, bool)
    found[rows, columns] = nearest_px[rows, targets] > disparity_px + _COVERED_STEP_PX
    return found


def _find_thin(known_px: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the mask of thin objects.

    A thin object is narrower than THIN_PX, and nearer than the surfaces on both sides by more than
    EDGE_STEP_PX.
    """
    # Unknown pixels count as infinitely near, so they never bound an object.
    surface_px = np.where(np.isnan(known_px), np.inf, known_px).astype(np.float32)
    behind_px = np.full_like(surface_px, np.inf)
    for window in ((1, THIN_PX), (THIN_PX, 1)):
        opened_px = cv2.morphologyEx(surface_px, cv2.MORPH_OPEN, np.ones(window, np.uint8))
        behind_px = np.minimum(behind_px, opened_px)
    return known_px - behind_px > EDGE_STEP_PX


def _measure_gradient(left: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """Return the gradient magnitude of the smoothed grey image, in levels of 0..255 per pixel."""
    grey = cv2.cvtColor(left, cv2.COLOR_RGB2GRAY).astype(np.float32)
    smooth = cv2.GaussianBlur(grey, (0, 0), _SMOOTHING_PX)
    # The Sobel kernel amplifies by 8: weights of 1, 2 and 1, each on a difference over two pixels.
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
