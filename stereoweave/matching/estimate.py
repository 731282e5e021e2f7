"""Matching of pairs of any size and disparity range.

A network covers disparities from 0 to its maximum, in images up to a certain size. For other disparities, the
right image is shifted along its rows. For wider ranges and larger images, both images are scaled down, and
`upsample` restores the estimate to full size.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped

from stereoweave.errors import Note, Remedy, StereoweaveError
from stereoweave.io.images import SMALLEST_SIDE_PX
from stereoweave.matching.disparity_range import find_range, goes_beyond
from stereoweave.matching.edge_vote.vote import rehearse_voting
from stereoweave.matching.left_right_check import find_occluded
from stereoweave.matching.matcher import (
    PIXEL_PAIRS_AT_ONCE,
    Matcher,
    apply_masks,
    rehearse_finishing,
)
from stereoweave.matching.options import DEFAULT_OPTIONS, OMIT_RANGE, MatchOptions
from stereoweave.matching.refine import rehearse_refining, right_confidence
from stereoweave.matching.upsample import enlarge, rehearse_upsampling
from stereoweave.stereo import LONGEST_SIDE_PX, Estimate, StereoPair
from stereoweave.system.compiling_ahead import compile_ahead
from stereoweave.system.steps import step

# Where the true disparity is outside a network's range, the network often predicts the end of the range, with
# a confidence between these two values.
_CONFIDENT, _CONFIDENT_AT_END = 0.5, 0.9
# The disparity range is searched if at least this percentage of pixels is doubtful.
_DOUBTFUL_PERCENT = 1.0
# Share of occluded pixels from which an estimate is wrong as a whole.
_MOSTLY_OCCLUDED = 0.5
# A network is less accurate near the ends of its range.
_MARGIN_PX = 4
# Disparities that are outside a given range by more than this are wrong, not just rounded.
_OUTSIDE_PX = 1
_TOLERATED_OUTSIDE_PERCENT = 5.0
# Only this share of PIXEL_PAIRS_AT_ONCE is usable, because the number of rows is rounded to a multiple.
_FILLED = 0.95
# Greatest combined rounding error of width and shift.
_ROUNDED_PX = 2
# Below this magnification, a second, magnified run is not worthwhile. The disparity range of the magnified
# run is measured on a grid of pixels with this spacing, ignoring this percentage at each end.
_LEAST_MAGNIFICATION = 1.1
_ENDS_PERCENT, _STEP_PX = 0.5, 4
# Disparities of the magnified pair that differ by more than this belong to different surfaces.
_OTHER_SURFACE_PX = 3.0
# Size of the median filter applied to a magnified estimate before sampling it at the pair's size.
_MEDIAN_PX = 3


class _NetworkInput(NamedTuple):
    """Network input for a pair: the scaled pair, and the shift of the right image in px, if any."""

    small: StereoPair
    least_px: int | None = None


def match(matcher: Matcher, pair: StereoPair, options: MatchOptions = DEFAULT_OPTIONS) -> Estimate:
    """Match a pair of any size.

    If one run of the network suffices, the result is the same as from `matcher.estimate`.

    Args:
        matcher: The network.
        pair: The rectified pair. Left pixels without content get confidence 0, and pixels whose match has no
            content in the right image are marked as occluded.
        options: Matching options; `refined` and `raw` apply at the network's input size. The disparities of
            larger pairs are upsampled even if `raw` is set.

    Raises:
        StereoweaveError: The disparity range lies beyond the images' width, or a side is shorter than 32 px.
    """
    (found,) = match_many(matcher, [pair], options)
    return found


@step("matching")
def match_many(
    matcher: Matcher, pairs: Sequence[StereoPair], options: MatchOptions = DEFAULT_OPTIONS
) -> list[Estimate]:
    """Match pairs of any size as `match` does, in batches of pairs with the same network input size."""
    _compile_ahead(matcher, pairs, options)
    every_shown = [_prepare_first_input(matcher, pair, options.range_px) for pair in pairs]
    moved = [_shift(shown) for shown in every_shown]
    of_size: dict[tuple[int, ...], list[int]] = {}
    for i, pair in enumerate(moved):
        of_size.setdefault(pair.left.shape, []).append(i)
    found: dict[int, Estimate] = {}
    for alike in of_size.values():
        found |= zip(alike, matcher.estimate_many([moved[i] for i in alike], raw=True), strict=True)
    return [
        _finish(matcher, pair, shown, found[i], options)
        for i, (pair, shown) in enumerate(zip(pairs, every_shown, strict=True))
    ]


def _compile_ahead(matcher: Matcher, pairs: Sequence[StereoPair], options: MatchOptions) -> None:
    """Start to compile what follows the network."""
    refined = options.refined or matcher.refines
    if not options.raw:
        compile_ahead(rehearse_finishing)
        if refined or matcher.searches:
            compile_ahead(rehearse_refining)
        if refined:
            compile_ahead(rehearse_voting)
    if not all(matcher.sees_whole(*pair.left.shape[1::-1]) for pair in pairs):
        compile_ahead(rehearse_upsampling)


def load_kernels() -> None:
    """Load all kernels of matching, so that the first pair does not wait for them."""
    for rehearse in (rehearse_finishing, rehearse_refining, rehearse_voting, rehearse_upsampling):
        rehearse()


def _clip_to_width(range_px: tuple[float, float], width_px: int) -> tuple[float, float]:
    """Clip a disparity range to the disparities that are possible in images of this width."""
    low_px, high_px = range_px
    if low_px >= width_px or high_px <= -width_px:
        raise StereoweaveError(
            f"expected disparities between {-width_px} and {width_px} px, the width of the pictures, "
            f"got {low_px:g} and {high_px:g}",
            setting="range_px",
            remedy=OMIT_RANGE,
        )
    return max(low_px, -width_px), min(high_px, width_px)


def _prepare_first_input(
    matcher: Matcher, pair: StereoPair, range_px: tuple[float, float] | None
) -> _NetworkInput:
    """Return the network's first input, prepared for the given range (None: the network's own range)."""
    seen = _fit_network(matcher, pair)
    if range_px is None:
        return _NetworkInput(seen)
    width = pair.left.shape[1]
    low_px, high_px = (px * seen.left.shape[1] / width for px in _clip_to_width(range_px, width))
    return _prepare_for_range(matcher, pair, seen, (low_px, high_px))


def _finish(
    matcher: Matcher, pair: StereoPair, shown: _NetworkInput, found: Estimate, options: MatchOptions
) -> Estimate:
    """Return the pair's estimate, given the output of the first run; run the network again if needed."""
    found = _undo_shift(shown, found)
    if options.range_px is None:
        beyond_px = _find_wider_range(shown.small, found, matcher.max_disparity_px)
        if beyond_px is not None:
            shown = _prepare_for_range(matcher, pair, shown.small, beyond_px)
            (found,) = matcher.estimate_many([_shift(shown)], raw=True)
            found = _undo_shift(shown, found)
    small = shown.small
    if matcher.magnification > 1:
        small, found = _match_magnified(matcher, pair, small, found)
    if not options.raw:
        found = matcher.finish(small, apply_masks(found, small), refined=options.refined)
    if small.left.shape[1] > pair.left.shape[1]:
        found = _downsample(found, pair)
    elif small.left.shape != pair.left.shape:
        found = enlarge(pair.left, pair.right, found, matcher.threads)
    if options.range_px is not None:
        found = _clip(found, *options.range_px)
    return apply_masks(found, pair)


def _fit_network(matcher: Matcher, pair: StereoPair) -> StereoPair:
    """Scale the pair to a size that one run of the network can take, because strips would leave seams."""
    height, width = pair.left.shape[:2]
    return _resize(pair, _find_downscale(matcher, width, height))


def _find_downscale(
    matcher: Matcher, width: int, height: int, moved_px: int = 0, largest: float = 1.0
) -> float:
    """Return the factor by which to scale down an image of this size so that one network run suffices.

    A factor below 1 magnifies the image. The factor is 1 / largest if the network can take an image `largest`
    times as large. A shift of moved_px makes the image wider by moved_px.
    """
    width += moved_px
    if matcher.sees_whole(round(width * largest), round(height * largest)):
        return 1 / largest
    if matcher.fixed_size is not None:
        rows, columns = matcher.fixed_size
        return max(height / rows, width / (columns - (_ROUNDED_PX if moved_px else 0)))
    too_many = (width * width * height / (_FILLED * PIXEL_PAIRS_AT_ONCE)) ** (1 / 3)
    scale = max(too_many, height / LONGEST_SIDE_PX, width / LONGEST_SIDE_PX)
    # The network takes a multiple of rows, which in a wide image may be far fewer than fit into memory.
    while not matcher.sees_whole(round(width / scale), round(height / scale)):
        scale *= 1.01
    return scale


def _resize(pair: StereoPair, scale: float) -> StereoPair:
    """Scale the pair down by a factor; return it unchanged if its size stays the same."""
    height, width = pair.left.shape[:2]
    size = max(round(width / scale), SMALLEST_SIDE_PX), max(round(height / scale), SMALLEST_SIDE_PX)
    if size == (width, height) or min(width, height) < SMALLEST_SIDE_PX:
        return pair
    way = cv2.INTER_AREA if scale > 1 else cv2.INTER_CUBIC
    left, right = (cv2.resize(image, size, interpolation=way) for image in (pair.left, pair.right))
    left_seen, right_seen = (
        None if seen is None else cv2.resize(seen.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        for seen in (pair.left_seen, pair.right_seen)
    )
    return StereoPair(left=left, right=right, left_seen=left_seen, right_seen=right_seen)


def _match_magnified(
    matcher: Matcher, pair: StereoPair, small: StereoPair, found: Estimate
) -> tuple[StereoPair, Estimate]:
    """Run the network on the pair magnified by up to `matcher.magnification`, and merge both estimates.

    The disparity range or memory may limit the magnification. Where the two estimates differ, the first one
    is kept if it is more confident, as happens beyond the network's range and on textureless surfaces.

    Args:
        matcher: The matcher, with a magnification above 1.
        pair: The pair at its own size.
        small: The pair at the size of the first run.
        found: The first run's estimate.

    Returns:
        The magnified pair and the merged estimate; `small` and `found` if magnification is not worthwhile.
    """
    height, width = pair.left.shape[:2]
    seen = _resize(pair, _find_downscale(matcher, width, height, largest=matcher.magnification))
    range_px = np.percentile(found.disparity_px[::_STEP_PX, ::_STEP_PX], [_ENDS_PERCENT, 100 - _ENDS_PERCENT])
    low_px, high_px = range_px * seen.left.shape[1] / small.left.shape[1]
    shown = _prepare_for_range(matcher, pair, seen, (float(low_px), float(high_px)))
    if shown.small.left.shape[1] < _LEAST_MAGNIFICATION * small.left.shape[1]:
        return small, found
    (closer,) = matcher.estimate_many([_shift(shown)], raw=True)
    return shown.small, _merge(_undo_shift(shown, closer), found)


def _merge(closer: Estimate, found: Estimate) -> Estimate:
    """Return `closer`, except where `found` has a different surface with higher confidence."""
    size = closer.disparity_px.shape[::-1]
    scale = np.float32(size[0] / found.disparity_px.shape[1])
    found_px, right_found_px, confidence, right_trust = (
        _resize_nearest(values, size)
        for values in (
            scale * found.disparity_px,
            scale * found.right_disparity_px,
            found.confidence,
            right_confidence(found),
        )
    )
    kept = _is_other(closer.disparity_px, found_px) & (confidence > closer.confidence)
    right_kept = _is_other(closer.right_disparity_px, right_found_px)
    right_kept &= right_trust > right_confidence(closer)
    disparity_px = np.where(kept, found_px, closer.disparity_px)
    right_disparity_px = np.where(right_kept, right_found_px, closer.right_disparity_px)
    return Estimate(
        disparity_px=disparity_px,
        right_disparity_px=right_disparity_px,
        confidence=np.where(kept, confidence, closer.confidence),
        occluded=find_occluded(disparity_px, right_disparity_px),
    )


def _is_other(
    one_px: Float[np.ndarray, "h w"], other_px: Float[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return the mask of pixels where the two disparities belong to different surfaces."""
    return np.abs(one_px - other_px) > _OTHER_SURFACE_PX


def _downsample(found: Estimate, pair: StereoPair) -> Estimate:
    """Scale a magnified estimate down to the pair's size without mixing surfaces within a pixel."""
    size = pair.left.shape[1::-1]
    scale = np.float32(size[0] / found.disparity_px.shape[1])
    disparity_px, right_disparity_px = (
        scale * _resize_nearest(cv2.medianBlur(view, _MEDIAN_PX), size)
        for view in (found.disparity_px, found.right_disparity_px)
    )
    return Estimate(
        disparity_px=disparity_px,
        right_disparity_px=right_disparity_px,
        confidence=_resize_nearest(found.confidence, size),
        occluded=_resize_nearest(found.occluded.astype(np.uint8), size) > 0,
    )


def _resize_nearest(values: Shaped[np.ndarray, "h w"], size: tuple[int, int]) -> Shaped[np.ndarray, "h2 w2"]:
    return cv2.resize(values, size, interpolation=cv2.INTER_NEAREST_EXACT)


def _find_wider_range(
    pair: StereoPair, found: Estimate, max_disparity_px: float
) -> tuple[float, float] | None:
    """Return the pair's disparity range if it exceeds the network's range; None otherwise.

    `found` is the estimate within the network's range.
    """
    doubtful = _find_doubtful(found, max_disparity_px)
    if 100 * _share(doubtful) < _DOUBTFUL_PERCENT or not goes_beyond(pair, doubtful, (0, max_disparity_px)):
        return None
    return find_range(pair)


def _find_doubtful(found: Estimate, max_disparity_px: float) -> Bool[np.ndarray, "h w"]:
    """Return the mask of uncertain pixels, whose true disparity may be outside the network's range."""
    inside = cv2.inRange(found.disparity_px, _MARGIN_PX, max_disparity_px - _MARGIN_PX) > 0
    doubtful = found.confidence < _CONFIDENT
    # Where the matches of most pixels lie outside the right picture, the range is wrong.
    if _share(found.occluded) < _MOSTLY_OCCLUDED:
        doubtful &= ~found.occluded
    doubtful |= (~inside & (found.confidence < _CONFIDENT_AT_END)) | (found.disparity_px <= 0)
    # Keep larger areas only: a network is uncertain at every edge.
    small = cv2.resize(doubtful.astype(np.float32), None, fx=1 / 8, fy=1 / 8, interpolation=cv2.INTER_AREA)
    return cv2.resize(small, doubtful.shape[::-1], interpolation=cv2.INTER_LINEAR) > 0.5


def _share(mask: Bool[np.ndarray, "h w"]) -> float:
    # Several times as fast as the mean of a mask.
    return np.count_nonzero(mask) / mask.size


def _prepare_for_range(
    matcher: Matcher, pair: StereoPair, seen: StereoPair, range_px: tuple[float, float]
) -> _NetworkInput:
    """Scale and shift a pair so that the network covers a disparity range.

    `seen` is the pair at a size that one run of the network can take; `range_px` is in pixels of `seen`.
    """
    low_px, high_px = range_px
    most_px = matcher.max_disparity_px
    if low_px >= 0 and high_px <= most_px:
        return _NetworkInput(seen)
    scale = max((high_px - low_px) / (most_px - _MARGIN_PX), 1.0)
    small = seen
    if scale > 1:
        small = _resize(pair, scale * pair.left.shape[1] / seen.left.shape[1])
    # Shift by exactly the least disparity, because a network assigns the end of its range to a plain sky.
    least_px = math.floor(low_px * small.left.shape[1] / seen.left.shape[1])
    height, width = small.left.shape[:2]
    smaller = _find_downscale(matcher, width, height, abs(least_px))
    if smaller > 1:
        small = _resize(pair, smaller * pair.left.shape[1] / width)
        least_px = math.floor(low_px * small.left.shape[1] / seen.left.shape[1])
    return _NetworkInput(small, least_px)


def _shift(shown: _NetworkInput) -> StereoPair:
    """Return the pair that the network receives, with the right image shifted by padding both images."""
    if shown.least_px is None:
        return shown.small
    (left_at, right_at), more = _start_columns(shown.least_px), abs(shown.least_px)
    return StereoPair(
        left=_pad_columns(shown.small.left, left_at, more - left_at),
        right=_pad_columns(shown.small.right, right_at, more - right_at),
    )


def _undo_shift(shown: _NetworkInput, found: Estimate) -> Estimate:
    """Undo the input's shift and padding in the network's estimate."""
    if shown.least_px is None:
        return found
    width, least_px = shown.small.left.shape[1], np.float32(shown.least_px)
    left, right = (np.s_[:, at : at + width] for at in _start_columns(shown.least_px))
    disparity_px = np.ascontiguousarray(found.disparity_px[left]) + least_px
    right_disparity_px = np.ascontiguousarray(found.right_disparity_px[right]) + least_px
    return Estimate(
        disparity_px=disparity_px,
        right_disparity_px=right_disparity_px,
        confidence=np.ascontiguousarray(found.confidence[left]),
        occluded=find_occluded(disparity_px, right_disparity_px),
    )


def _start_columns(least_px: int) -> tuple[int, int]:
    """Return the columns at which the left and right image start within their padded versions."""
    return (-least_px, 0) if least_px < 0 else (0, least_px)


def _pad_columns(image: np.ndarray, before: int, behind: int) -> np.ndarray:
    return cv2.copyMakeBorder(image, 0, 0, before, behind, cv2.BORDER_REPLICATE)


def _clip(found: Estimate, low_px: float, high_px: float) -> Estimate:
    """Clip disparities to a range; pixels outside it by more than _OUTSIDE_PX get confidence 0.

    The estimate gets a note if they are many.
    """
    outside = np.maximum(low_px - found.disparity_px, found.disparity_px - high_px) > _OUTSIDE_PX
    outside_percent = 100 * float(outside.mean())
    cut = Note(
        f"{outside_percent:.0f} % of the disparities are outside the range of {low_px:g} to {high_px:g} px",
        Remedy("widen it, or leave it out", ("range_px",)),
    )
    return replace(
        found,
        notes=(*found.notes, cut) if outside_percent > _TOLERATED_OUTSIDE_PERCENT else found.notes,
        disparity_px=np.clip(found.disparity_px, low_px, high_px),
        right_disparity_px=np.clip(found.right_disparity_px, low_px, high_px),
        confidence=np.where(outside, np.float32(0), found.confidence),
    )
