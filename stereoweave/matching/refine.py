"""Refinement of an estimate by matching once more at full resolution, with the network's disparity as prior.

The method is semi-global matching (Hirschmueller 2008) over all disparities between the network's least and
greatest disparity, at and around pixels of which the network is not certain. A candidate's cost is the colour
and census difference, plus the confidence-weighted distance to the network's disparity. Disparities on which
both views agree replace the network's disparities. This recovers edges, as well as thin structures that are
below the network's resolution.
"""

import math
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8, UInt16

from stereoweave.matching.exposure import match_exposure, recolour
from stereoweave.matching.left_right_check import at_match, find_occluded
from stereoweave.stereo import Estimate, StereoPair, check_fits
from stereoweave.system.steps import step
from stereoweave.system.threads import in_bands, thread_count

if TYPE_CHECKING:
    from stereoweave.matching.refine_kernels import Cues

# Candidates extend this far beyond the estimate's disparities; their number is a multiple of the vector
# length.
_MARGIN_PX = 4
_CANDIDATES_MULTIPLE = 16
# Each candidate of a pixel takes 3 bytes, so larger images are refined in strips, which overlap by this many
# rows on each side.
_CANDIDATES_AT_ONCE = 100_000_000
_OVERLAP_PX = 24
# Penalty for a large disparity step: greatest between equal grey levels, halved at this grey difference.
_LARGEST_STEP, _LEAST_LARGE_STEP = 125, 30
_HALVING_LEVELS = 30
# Disparities are searched up to this far from those that are not certain: 36 % of the pixels of real pairs.
# New views gain 0.1 dB from a search everywhere, and lose 0.3 dB without the pixels around.
_REACH_PX = 4
_AROUND = np.ones((2 * _REACH_PX + 1, 2 * _REACH_PX + 1), np.uint8)
# Factor on a pixel's confidence where the network's disparities for the two views disagree.
_DOUBTED = 0.2
_SAME_PX = 1.0
_MOST_THREADS = 4


class _View(NamedTuple):
    """A view to match.

    Attributes:
        own: Cues of the view.
        other: Cues of the other image, aligned for the kernels.
        towards: -1 for the left view, whose matches are to the left, and 1 for the right view.
    """

    own: "Cues"
    other: "Cues"
    towards: int

    def take(self, rows: slice) -> "_View":
        """Return a strip of rows of the view."""
        own, other = (type(cues)(*(cue[rows] for cue in cues)) for cues in self[:2])
        return _View(own, other, self.towards)


@step("refining")
def refine(
    left: UInt8[np.ndarray, "h w 3"],
    right: UInt8[np.ndarray, "h w 3"],
    estimate: Estimate,
    threads: int | None = None,
) -> Estimate:
    """Correct the disparities of both views by semi-global matching at full resolution.

    The network's disparity is kept where matching confirms it to within 1 px (the network is then more
    precise), where its confidence is high, and where the two views disagree. The confidence does not change.
    Different exposures are equalised first.

    Args:
        left: Left image, uint8 RGB [H, W, 3].
        right: Right image of the same size.
        estimate: The pair's estimate (`stereoweave.estimate`).
        threads: Maximum number of threads; default: all cores. At most four are used.
    """
    pair = StereoPair(left=left, right=right)
    check_fits(estimate, pair)
    looks = match_exposure(left, right, estimate)
    if looks is not None:
        pair = StereoPair(left=left, right=recolour(right, looks.tables(0)[1]))
    trust, right_trust = np.asarray(estimate.confidence, np.float32, order="C"), right_confidence(estimate)
    count = min(_MOST_THREADS, thread_count(threads))
    found_px, right_found_px = _match_views(pair, estimate, right_trust, count)
    disparity_px = _settle(estimate.disparity_px, found_px, right_found_px, trust, -1)
    right_disparity_px = _settle(estimate.right_disparity_px, right_found_px, found_px, right_trust, 1)
    return Estimate(
        disparity_px=disparity_px,
        right_disparity_px=right_disparity_px,
        confidence=estimate.confidence,
        occluded=find_occluded(disparity_px, right_disparity_px),
    )


def find_matching_costs(pair: StereoPair, count: int) -> UInt8[np.ndarray, "h w d"]:
    """Return the left view's matching costs without a network's disparity, 0..108 [H, W, count].

    Candidate i is a disparity of i px. Matches outside the right image are compared with its border column.
    """
    from stereoweave.matching import refine_kernels as kernels  # it loads LLVM

    nothing = np.zeros(pair.left.shape[:2], np.float32)
    own, other = (_cues(image, nothing, nothing) for image in (pair.left, pair.right))
    costs = np.empty((*nothing.shape, count), np.uint8)
    kernels.match(own, _align(other, 0, count, -1), -1, 0, len(costs), costs)
    return costs


def rehearse_refining() -> None:
    """Refine a small estimate, to compile all kernels (`compiling_ahead.compile_ahead`)."""
    image, px = np.zeros((32, 32, 3), np.uint8), np.zeros((32, 32), np.float32)
    refine(image, image, Estimate(disparity_px=px, right_disparity_px=px, confidence=px, occluded=px > 0), 1)


def _settle(
    disparity_px: Float[np.ndarray, "h w"],
    found_px: Float32[np.ndarray, "h w"],
    other_px: Float32[np.ndarray, "h w"],
    trust: Float32[np.ndarray, "h w"],
    towards: int,
) -> Float32[np.ndarray, "h w"]:
    """Replace a view's disparities with the matched disparities at which both views agree."""
    from stereoweave.matching import refine_kernels as kernels  # it loads LLVM

    settled_px = np.array(disparity_px, np.float32, order="C")
    agreed = np.empty(settled_px.shape, bool)
    kernels.settle(found_px, other_px, trust, towards, settled_px, agreed)
    kernels.extend(agreed, trust, towards, settled_px)
    return settled_px


def _match_views(
    pair: StereoPair, estimate: Estimate, right_trust: Float32[np.ndarray, "h w"], threads: int
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Match both views, and return the disparities of least cost in each view."""
    first_px, count = _candidates(estimate)
    left = _cues(pair.left, estimate.disparity_px - first_px, estimate.confidence)
    right = _cues(pair.right, estimate.right_disparity_px - first_px, right_trust)
    views = [
        _View(left, _align(right, first_px, count, -1), -1),
        _View(right, _align(left, first_px, count, 1), 1),
    ]
    height, width = left.grey.shape
    found_px = np.empty((2, height, width), np.float32)
    step = max(_CANDIDATES_AT_ONCE // (width * count), 4 * _OVERLAP_PX) - 2 * _OVERLAP_PX
    for top in range(0, height, step):
        rows = slice(max(top - _OVERLAP_PX, 0), min(top + step + _OVERLAP_PX, height))
        strip = [view.take(rows) for view in views]
        strip_px = _match_strip(strip, first_px, count, threads)
        found_px[:, top : top + step] = strip_px[:, top - rows.start :][:, :step]
    return found_px[0], found_px[1]


def _match_strip(views: list[_View], first_px: int, count: int, threads: int) -> Float32[np.ndarray, "2 h w"]:
    """Match a strip of rows of both views."""
    size = (*views[0].own.grey.shape, count)
    # Both views share the buffers, because allocating new memory takes as long as aggregating one path.
    costs, sums = np.empty(size, np.uint8), np.empty(size, np.uint16)
    return np.stack([_match_view(view, (costs, sums), first_px, threads) for view in views])


def _match_view(
    view: _View,
    volumes: tuple[UInt8[np.ndarray, "h w d"], UInt16[np.ndarray, "h w d"]],
    first_px: int,
    threads: int,
) -> Float32[np.ndarray, "h w"]:
    """Match a view; `volumes` are buffers for the matching costs and their sums over all paths."""
    from stereoweave.matching import refine_kernels as kernels

    own, other, towards = view
    height, width = own.grey.shape
    costs, sums = volumes
    steps_along, steps_down = (_large_steps(own.grey, axis) for axis in (1, 0))
    found_px = first_px + own.prior / np.float32(kernels.SUBSTEPS)

    def match(first: int, last: int) -> None:
        kernels.match(own, other, towards, first, last, costs)
        kernels.along_rows(costs, own, steps_along, first, last, sums)

    def pick(first: int, last: int) -> None:
        kernels.along_columns(costs, own, steps_down, first_px, first, last, sums, found_px)

    in_bands(match, height, threads, threads)
    in_bands(pick, width, threads, threads)
    return found_px


def _candidates(estimate: Estimate) -> tuple[int, int]:
    """Return the first candidate disparity in px and the number of candidates."""
    both = estimate.disparity_px, estimate.right_disparity_px
    least_px = math.floor(min(view.min() for view in both))
    # Parallel cameras have no disparities below 0, and candidates below 0 would attract a plain sky.
    first_px = least_px - _MARGIN_PX if least_px < 0 else max(least_px - _MARGIN_PX, 0)
    last_px = math.ceil(max(view.max() for view in both)) + _MARGIN_PX
    count = last_px - first_px + 1
    return first_px, count + -count % _CANDIDATES_MULTIPLE


def _cues(image: UInt8[np.ndarray, "h w 3"], above_first_px: np.ndarray, trust: np.ndarray) -> "Cues":
    from stereoweave.matching import refine_kernels as kernels

    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    codes = np.empty(grey.shape, np.uint32)
    kernels.census(grey, codes)
    colour = np.ascontiguousarray(image.transpose(0, 2, 1))
    around = np.pad(colour, ((0, 0), (0, 0), (1, 1)), mode="edge").astype(np.uint16)
    halfway = ((around[..., 1:] + around[..., :-1]) // 2).astype(np.uint8)
    return kernels.Cues(
        grey=grey,
        census=codes,
        colour=colour,
        darkest=np.minimum(colour, np.minimum(halfway[..., :-1], halfway[..., 1:])),
        brightest=np.maximum(colour, np.maximum(halfway[..., :-1], halfway[..., 1:])),
        prior=np.rint(above_first_px * kernels.SUBSTEPS).astype(np.uint16),
        trust=np.rint(trust * kernels.MOST_TRUST).astype(np.uint16),
        searched=cv2.dilate((trust < kernels.CERTAIN).astype(np.uint8), _AROUND) > 0,
    )


def _align(cues: "Cues", first_px: int, count: int, towards: int) -> "Cues":
    """Place the other image's columns as the kernels read them, between copies of the border columns.

    Only what the kernels read of the other image is placed: `grey` and `searched` stay as they are.
    """
    width = cues.grey.shape[1]
    columns = first_px + np.arange(width + count - 1)
    inside = slice(*np.searchsorted(columns, [0, width]))
    placed = {
        name: _place(cue[..., ::towards], columns, inside)
        for name, cue in cues._asdict().items()
        if name not in ("grey", "searched")
    }
    return cues._replace(**placed)


def _place(cue: np.ndarray, columns: np.ndarray, inside: slice) -> np.ndarray:
    """Take these columns, of which those `inside` exist; the others are copies of the border columns."""
    placed = np.empty((*cue.shape[:-1], len(columns)), cue.dtype)
    placed[..., : inside.start], placed[..., inside.stop :] = cue[..., :1], cue[..., -1:]
    placed[..., inside] = cue[..., columns[0] + inside.start : columns[0] + inside.stop]
    return placed


def right_confidence(estimate: Estimate) -> Float32[np.ndarray, "h w"]:
    """Return the confidence of the right view's disparities, taken from the left view at their matches."""
    seen_px, inside = at_match(estimate.disparity_px, estimate.right_disparity_px, 1)
    confidence, _ = at_match(np.asarray(estimate.confidence, np.float32), estimate.right_disparity_px, 1)
    agreed = inside & (np.abs(seen_px - estimate.right_disparity_px) <= _SAME_PX)
    return np.where(agreed, confidence, np.float32(_DOUBTED) * confidence)


def _large_steps(grey: UInt8[np.ndarray, "h w"], axis: int) -> UInt8[np.ndarray, "h w"]:
    """Return the penalty for a large step from the previous pixel to each pixel, lower at grey edges."""
    before = grey.take([0, *range(grey.shape[axis] - 1)], axis)
    by_difference = _LARGEST_STEP / (1 + np.arange(256, dtype=np.float32) / _HALVING_LEVELS)
    return cv2.LUT(cv2.absdiff(grey, before), np.maximum(by_difference, _LEAST_LARGE_STEP).astype(np.uint8))
