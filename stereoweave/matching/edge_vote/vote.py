"""Vote of the neighbourhood on disparities at depth edges, in speckles and where confidence is low.

At an edge, an estimate may lie between both surfaces, or on the wrong one; on a plain surface it may have
speckles. Such pixels take the weighted median of the sound disparities around them. A neighbour of similar
colour, nearby and confident, has a large weight, so that edges come to lie on the edges of the image.
"""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from stereoweave.stereo import Estimate
from stereoweave.system.threads import in_bands, thread_count

# A pixel is at an edge if disparity spans more than this over its 3x3 neighbourhood.
_STEP_PX = 3.0
# Areas of at most this many pixels whose disparity differs from their surroundings by more are speckles.
_SPECKLE_PIXELS, _SPECKLE_STEP_PX = 100, 1
# Disparities less confident than this are replaced.
_UNSURE = 0.2
# Number of rounds; each one reaches areas without sound disparities that are farther inside.
_ROUNDS = 4
# cv2.filterSpeckles takes whole numbers.
_PARTS_OF_PX = 16


def vote_at_edges(
    image: UInt8[np.ndarray, "h w 3"], estimate: Estimate, threads: int | None = None
) -> Estimate:
    """Replace the left disparities at edges, in speckles and of low confidence by their neighbours' vote.

    The confidence does not change, so that a replaced disparity of low confidence remains marked. The right
    view does not change, because the vote makes new views worse there, by 0.3 dB.

    Args:
        image: Left image, uint8 RGB [H, W, 3].
        estimate: The pair's estimate.
        threads: Maximum number of threads; default: all cores.
    """
    confidence = np.asarray(estimate.confidence, np.float32)
    return replace(estimate, disparity_px=_vote(image, estimate.disparity_px, confidence, threads))


def rehearse_voting() -> None:
    """Vote on a small estimate, to compile the kernel (`compiling_ahead.compile_ahead`)."""
    image, px = np.zeros((32, 32, 3), np.uint8), np.zeros((32, 32), np.float32)
    estimate = Estimate(disparity_px=px, right_disparity_px=px, confidence=px, occluded=px > 0)
    vote_at_edges(image, estimate, 1)


def _vote(
    image: UInt8[np.ndarray, "h w 3"],
    disparity_px: Float32[np.ndarray, "h w"],
    confidence: Float32[np.ndarray, "h w"],
    threads: int | None,
) -> Float32[np.ndarray, "h w"]:
    from stereoweave.matching.edge_vote.vote_kernels import vote  # it loads LLVM

    lab = cv2.cvtColor(image.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    disparity_px = np.array(disparity_px, np.float32)
    unsound = _find_unsound(disparity_px) | (confidence < _UNSURE)
    bands = thread_count(threads)
    for _ in range(_ROUNDS):
        before_px, sound = disparity_px.copy(), ~unsound
        work = partial(vote, lab, before_px, confidence, sound, disparity_px, unsound)
        in_bands(work, len(disparity_px), bands, bands)
        if not unsound.any():
            break
    return disparity_px


def _find_unsound(disparity_px: Float32[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the mask of the pixels at edges and in speckles."""
    around = np.ones((3, 3), np.uint8)
    steps = cv2.dilate(disparity_px, around) - cv2.erode(disparity_px, around) > _STEP_PX
    parts = np.rint(_PARTS_OF_PX * (disparity_px - disparity_px.min() + 1))
    kept = np.minimum(parts, np.iinfo(np.int16).max).astype(np.int16)
    cv2.filterSpeckles(kept, 0, _SPECKLE_PIXELS, _PARTS_OF_PX * _SPECKLE_STEP_PX)
    return steps | (kept == 0)
