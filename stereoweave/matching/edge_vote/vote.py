"""Vote of the neighbourhood on disparities at depth edges, in speckles and where confidence is low.

At an edge, an estimate may lie between both surfaces, or on the wrong one; on a plain surface it may have
speckles. Such pixels take the weighted median of the sound disparities around them. A neighbour of similar
colour, nearby and confident, has a large weight, so that edges come to lie on the edges of the image.
"""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int16, UInt8

from stereoweave.stereo import Estimate
from stereoweave.system.threads import in_bands, thread_count

# A pixel is at an edge if disparity spans more than this over its 3x3 neighbourhood.
_STEP_PX = 3.0
# Areas of at most this many pixels whose disparity differs from their surroundings by more are speckles.
_SPECKLE_PIXELS, _SPECKLE_STEP_PX = 100, 1
# So are larger ones, where the confidence is below this.
_LARGE_SPECKLE_PIXELS, _DOUBTED = 400, 0.5
# Disparities less confident than this are replaced.
_UNSURE = 0.2
# Things into which no square of this size fits are thin, if the image shows lines there: of at least this
# difference in grey levels from what is around them, several times the noise of a video.
_THIN_PX, _LINE_LEVELS = 7, 24
# Number of rounds; each one reaches 4 px farther into areas without sound disparities, as on plain surfaces.
_ROUNDS = 16
# Confidence of a replaced disparity if both cameras see the pixel, and if one does, plus these shares of its
# neighbours' agreement and of the confidence before. Fitted to rendered pairs, as is the share of the doubt
# that remains where neither an edge nor a speckle was found.
_SEEN, _OCCLUDED, _SHARE_AGREED, _SHARE_CLAIMED = map(np.float32, (0.29, 0.18, 0.32, 0.25))
_DOUBT_LEFT = np.float32(0.75)
# cv2.filterSpeckles takes whole numbers.
_PARTS_OF_PX = 16


def vote_at_edges(
    image: UInt8[np.ndarray, "h w 3"], estimate: Estimate, threads: int | None = None
) -> Estimate:
    """Replace the left disparities at edges, in speckles and of low confidence by their neighbours' vote.

    A replaced disparity's confidence follows from its neighbours' agreement, and the other confidences rise a
    little; a confidence of 0 stays 0. The right view does not change, because the vote makes new views worse
    there, by 0.3 dB.

    Args:
        image: Left image, uint8 RGB [H, W, 3].
        estimate: The pair's estimate.
        threads: Maximum number of threads; default: all cores.
    """
    unsound = _find_unsound(
        np.asarray(estimate.disparity_px, np.float32), np.asarray(estimate.confidence, np.float32)
    )
    disparity_px, confidence = _vote(image, estimate, unsound, threads)
    return replace(estimate, disparity_px=disparity_px, confidence=confidence)


def sharpen_edges(
    image: UInt8[np.ndarray, "h w 3"], estimate: Estimate, threads: int | None = None
) -> Estimate:
    """Replace the left disparities at edges by their neighbours' vote, but for thin things.

    Confidences do not change. One round is enough, because an edge is narrower than the vote's reach. This
    takes half the time of `vote_at_edges`, which removes thin things as speckles.

    Args:
        image: Left image, uint8 RGB [H, W, 3].
        estimate: The pair's estimate.
        threads: Maximum number of threads; default: all cores.
    """
    disparity_px = np.array(estimate.disparity_px, np.float32)
    unsound = _find_steps(disparity_px) & ~_find_thin(image, disparity_px, estimate.confidence)
    _vote_once(_to_lab(image), disparity_px, np.array(estimate.confidence, np.float32), unsound, threads)
    return replace(estimate, disparity_px=disparity_px)


def rehearse_voting() -> None:
    """Vote on a small estimate, to compile the kernel (`compiling_ahead.compile_ahead`)."""
    image, px = np.zeros((32, 32, 3), np.uint8), np.zeros((32, 32), np.float32)
    estimate = Estimate(disparity_px=px, right_disparity_px=px, confidence=px, occluded=px > 0)
    vote_at_edges(image, estimate, 1)


def _vote(
    image: UInt8[np.ndarray, "h w 3"],
    estimate: Estimate,
    unsound: Bool[np.ndarray, "h w"],
    threads: int | None,
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Return the disparities and confidences after all rounds; `unsound` keeps the pixels without a vote."""
    lab = _to_lab(image)
    disparity_px = np.array(estimate.disparity_px, np.float32)
    claimed = np.array(estimate.confidence, np.float32)
    confidence = claimed.copy()
    kept = ~unsound
    for _ in range(_ROUNDS):
        sound = ~unsound
        _vote_once(lab, disparity_px, confidence, unsound, threads)
        voted = ~(sound | unsound)
        least = np.where(estimate.occluded[voted], _OCCLUDED, _SEEN)
        confidence[voted] = least + _SHARE_AGREED * confidence[voted] + _SHARE_CLAIMED * claimed[voted]
        if not (voted.any() and unsound.any()):
            break
    confidence[kept] = 1 - _DOUBT_LEFT * (1 - confidence[kept])
    # Nothing is known where there is no content or no texture.
    confidence[claimed == 0] = 0
    return disparity_px, confidence


def _to_lab(image: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
    return cv2.cvtColor(image.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)


def _vote_once(
    lab: Float32[np.ndarray, "h w 3"],
    disparity_px: Float32[np.ndarray, "h w"],
    confidence: Float32[np.ndarray, "h w"],
    unsound: Bool[np.ndarray, "h w"],
    threads: int | None,
) -> None:
    """Replace unsound disparities, and their confidences by the neighbours' agreement, in place.

    Pixels with a vote are removed from `unsound`.
    """
    from stereoweave.matching.edge_vote.vote_kernels import vote  # it loads LLVM

    work = partial(
        vote, lab, disparity_px.copy(), confidence.copy(), ~unsound, disparity_px, confidence, unsound
    )
    count = thread_count(threads)
    in_bands(work, len(disparity_px), count, count)


def _find_unsound(
    disparity_px: Float32[np.ndarray, "h w"], confidence: Float32[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return the mask of the pixels at edges, in speckles and of low confidence."""
    parts = np.rint(_PARTS_OF_PX * (disparity_px - disparity_px.min() + 1))
    whole = np.minimum(parts, np.iinfo(np.int16).max).astype(np.int16)
    speckles = _find_speckles(whole, _SPECKLE_PIXELS)
    speckles |= (confidence < _DOUBTED) & _find_speckles(whole, _LARGE_SPECKLE_PIXELS)
    return _find_steps(disparity_px) | speckles | (confidence < _UNSURE)


def _find_steps(disparity_px: Float32[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the mask of the pixels at edges."""
    around = np.ones((3, 3), np.uint8)
    return cv2.dilate(disparity_px, around) - cv2.erode(disparity_px, around) > _STEP_PX


def _find_thin(
    image: UInt8[np.ndarray, "h w 3"],
    disparity_px: Float32[np.ndarray, "h w"],
    confidence: Float32[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    """Return the mask of the pixels of thin things that are not quite unsure and that the image shows too."""
    around = np.ones((_THIN_PX, _THIN_PX), np.uint8)
    before_px = disparity_px - cv2.morphologyEx(disparity_px, cv2.MORPH_OPEN, around)
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    lines = [cv2.morphologyEx(grey, kind, around) for kind in (cv2.MORPH_TOPHAT, cv2.MORPH_BLACKHAT)]
    return (before_px > _STEP_PX) & (np.maximum(*lines) > _LINE_LEVELS) & (confidence > _UNSURE)


def _find_speckles(parts: Int16[np.ndarray, "h w"], pixels: int) -> Bool[np.ndarray, "h w"]:
    """Return the mask of the speckles of at most `pixels`, given positive disparities in parts of a pixel."""
    kept = parts.copy()
    cv2.filterSpeckles(kept, 0, pixels, _PARTS_OF_PX * _SPECKLE_STEP_PX)
    return kept == 0
