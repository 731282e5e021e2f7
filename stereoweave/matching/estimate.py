"""A pair of any size, with disparities in any range, becomes an Estimate: what `stereoweave.estimate` does.

A network compares disparities of 0 to so many px, in a picture of so many pixels. What lies elsewhere is
brought there: the right picture is moved along the rows, or both are made smaller. A disparity found in
smaller pictures is brought to the full size by `enlarging`.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped

from stereoweave.errors import StereoweaveError
from stereoweave.io.arrays import as_rgb
from stereoweave.io.files import SMALLEST_SIDE_PX
from stereoweave.matching.backend import Backend
from stereoweave.matching.disparity_range import find_range, goes_beyond
from stereoweave.matching.left_right_check import at_match, find_occluded
from stereoweave.matching.matcher import (
    PIXEL_PAIRS_AT_ONCE,
    Matcher,
)
from stereoweave.matching.options import DEFAULT_OPTIONS, MatchOptions
from stereoweave.matching.providers import CPU
from stereoweave.matching.refine import right_confidence
from stereoweave.matching.upsample import enlarge
from stereoweave.stereo import LONGEST_SIDE_PX, Estimate, StereoPair

# A network that is shown what is beyond its range often believes in the end of it, but not quite.
_CONFIDENT, _CONFIDENT_AT_END = 0.5, 0.9
# A range is looked for unless all of the picture but so much is certain.
_DOUBTFUL_PERCENT = 1.0
# A network is less exact near the ends of its range.
_MARGIN_PX = 4
# Disparities this far outside of a range that was given are no rounding, but wrong.
_OUTSIDE_PX = 1
# Of the pixel pairs that are matched at once: rows are counted in multiples.
_FILLED = 0.95
# How much a width and a move, both rounded, may be too large together.
_ROUNDED_PX = 2
# A closer look at less than this magnification is not worth its time; the range that it has to see is that of
# all but so much of some pixels.
_LEAST_MAGNIFICATION = 1.1
_ENDS_PERCENT, _STEP_PX = 0.5, 4
# Disparities of the larger picture that differ by more are of two surfaces.
_OTHER_SURFACE_PX = 3.0
# The median window of a larger estimate, of which one pixel is taken for each of the pair's.
_MEDIAN_PX = 3


class _Shown(NamedTuple):
    """What a network is shown of a pair: it made small, and by how much its right picture is moved, if so."""

    small: StereoPair
    least_px: int | None = None


def estimate(  # noqa: PLR0913 - each has a name, and all but the pictures can be left out
    left: object,
    right: object,
    *,
    model: str | Path = "small",
    threads: int | None = None,
    provider: str = CPU,
    refined: bool = False,
    raw: bool = False,
    range_px: tuple[float, float] | None = None,
) -> Estimate:
    """Disparity of both views, confidence and occlusion of a rectified pair.

    Args:
        left: The left photograph, at least 32x32: uint8 RGB [H, W, 3], or what else `arrays.as_rgb` takes,
            such as a PIL image or a PyTorch tensor.
        right: The right one, of the same size.
        model: A shipped name, `best` (the network base, once more at 1.5 times the size, and refined), or the
            path of an .onnx matcher; loaded at the first call, and kept.
        threads: How many threads may be used; all cores if left out.
        provider: What the network is run on: cpu, cuda, tensorrt, openvino, coreml or directml.
        refined: As in `MatchOptions`.
        raw: As in `MatchOptions`.
        range_px: As in `MatchOptions`.

    Raises:
        ValueError: MatcherError for an unknown model or an unavailable provider, ProviderError for one that
            fails, StereoweaveError for invalid images or options.
    """
    options = MatchOptions(range_px=range_px, refined=refined, raw=raw)
    pair = StereoPair(left=as_rgb(left, "left"), right=as_rgb(right, "right"))
    matcher = Backend(model=model, threads=threads, provider=provider).matcher()
    return match(matcher, pair, options)


def match(matcher: Matcher, pair: StereoPair, options: MatchOptions = DEFAULT_OPTIONS) -> Estimate:
    """The estimate of a pair of any size; equals `matcher.estimate` where the network sees all of it at once.

    Args:
        matcher: The network.
        pair: The photographs, rectified. Where the left one shows nothing the confidence is 0, and what has
            its match where the right one shows nothing is occluded.
        options: How it is matched; `refined` and `raw` apply at the size that the network sees. A larger
            pair's disparities are upsampled even if `raw`.

    Raises:
        StereoweaveError: The range is outside the pictures' width, or a picture is under 32 px in a
            direction.
    """
    (found,) = match_many(matcher, [pair], options)
    return found


def match_many(
    matcher: Matcher, pairs: Sequence[StereoPair], options: MatchOptions = DEFAULT_OPTIONS
) -> list[Estimate]:
    """Estimates of pairs of any sizes, as by `match`; those of one size for the network share a batch."""
    every_shown = [_shown_first(matcher, pair, options.range_px) for pair in pairs]
    moved = [_moved(shown) for shown in every_shown]
    of_size: dict[tuple[int, ...], list[int]] = {}
    for i, pair in enumerate(moved):
        of_size.setdefault(pair.left.shape, []).append(i)
    found: dict[int, Estimate] = {}
    for alike in of_size.values():
        found |= zip(alike, matcher.estimate_many([moved[i] for i in alike], raw=True), strict=True)
    return [
        _finished(matcher, pair, shown, found[i], options)
        for i, (pair, shown) in enumerate(zip(pairs, every_shown, strict=True))
    ]


def _within_width(range_px: tuple[float, float], width_px: int) -> tuple[float, float]:
    """The part of a range that pictures of this width can have."""
    low_px, high_px = range_px
    if low_px >= width_px or high_px <= -width_px:
        raise StereoweaveError(
            f"expected disparities of {-width_px} to {width_px} px, the width of the pictures, "
            f"got {low_px:g} and {high_px:g}; omit it for automatic detection",
            setting="range_px",
        )
    return max(low_px, -width_px), min(high_px, width_px)


def _shown_first(matcher: Matcher, pair: StereoPair, range_px: tuple[float, float] | None) -> _Shown:
    """What the network is shown before anything is known of the pair but the range, if that is given."""
    seen = _seen_whole(matcher, pair)
    if range_px is None:
        return _Shown(seen)
    width = pair.left.shape[1]
    low_px, high_px = (px * seen.left.shape[1] / width for px in _within_width(range_px, width))
    return _shown_within(matcher, pair, seen, (low_px, high_px))


def _finished(
    matcher: Matcher, pair: StereoPair, shown: _Shown, found: Estimate, options: MatchOptions
) -> Estimate:
    """The estimate of a pair from the network's own of what it was shown first; shown again if need be."""
    found = _unmoved(shown, found)
    if options.range_px is None:
        beyond_px = _range_beyond(shown.small, found, matcher.max_disparity_px)
        if beyond_px is not None:
            shown = _shown_within(matcher, pair, shown.small, beyond_px)
            (found,) = matcher.estimate_many([_moved(shown)], raw=True)
            found = _unmoved(shown, found)
    small = shown.small
    if matcher.magnification > 1:
        small, found = _look_closer(matcher, pair, small, found)
    if not options.raw:
        found = matcher.finish(small, _as_seen(found, small), refined=options.refined)
    if small.left.shape[1] > pair.left.shape[1]:
        found = _shrunk(found, pair)
    elif small.left.shape != pair.left.shape:
        found = enlarge(pair.left, pair.right, found, matcher.threads)
    if options.range_px is not None:
        found = _clipped(found, *options.range_px)
    return _as_seen(found, pair)


def _seen_whole(matcher: Matcher, pair: StereoPair) -> StereoPair:
    """The pair, smaller where the network would else see it in strips, whose seams would show."""
    height, width = pair.left.shape[:2]
    return _resized(pair, _times_smaller(matcher, width, height))


def _times_smaller(
    matcher: Matcher, width: int, height: int, moved_px: int = 0, largest: float = 1.0
) -> float:
    """By how much the network has to be shown less, to see a picture of this size whole.

    It sees one `largest` times larger, 1 / largest, if it can. The picture is wider by what the other one is
    moved by.
    """
    width += moved_px
    if matcher.sees_whole(round(width * largest), round(height * largest)):
        return 1 / largest
    if matcher.fixed_size is not None:
        rows, columns = matcher.fixed_size
        return max(height / rows, width / (columns - (_ROUNDED_PX if moved_px else 0)))
    too_many = (width * width * height / (_FILLED * PIXEL_PAIRS_AT_ONCE)) ** (1 / 3)
    return max(too_many, height / LONGEST_SIDE_PX, width / LONGEST_SIDE_PX)


def _resized(pair: StereoPair, scale: float) -> StereoPair:
    """The photographs so many times smaller, or the pair itself where that is as large."""
    height, width = pair.left.shape[:2]
    size = max(round(width / scale), SMALLEST_SIDE_PX), max(round(height / scale), SMALLEST_SIDE_PX)
    if size == (width, height) or min(width, height) < SMALLEST_SIDE_PX:
        return pair
    way = cv2.INTER_AREA if scale > 1 else cv2.INTER_CUBIC
    left, right = (cv2.resize(photo, size, interpolation=way) for photo in (pair.left, pair.right))
    left_seen, right_seen = (
        None if seen is None else cv2.resize(seen.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        for seen in (pair.left_seen, pair.right_seen)
    )
    return StereoPair(left=left, right=right, left_seen=left_seen, right_seen=right_seen)


def _look_closer(
    matcher: Matcher, pair: StereoPair, small: StereoPair, found: Estimate
) -> tuple[StereoPair, Estimate]:
    """A pair as it is shown for a matcher's magnification, and the network's own estimate of that.

    It is enlarged by less where the range or the memory allow no more. Where the estimate at hand is surer
    and says something else, that counts: beyond the network's range, and on plain surfaces.

    Args:
        matcher: Its network looks closer.
        pair: At its own size.
        small: As it was shown before.
        found: What was found then.
    """
    height, width = pair.left.shape[:2]
    seen = _resized(pair, _times_smaller(matcher, width, height, largest=matcher.magnification))
    range_px = np.percentile(found.disparity_px[::_STEP_PX, ::_STEP_PX], [_ENDS_PERCENT, 100 - _ENDS_PERCENT])
    low_px, high_px = range_px * seen.left.shape[1] / small.left.shape[1]
    shown = _shown_within(matcher, pair, seen, (float(low_px), float(high_px)))
    if shown.small.left.shape[1] < _LEAST_MAGNIFICATION * small.left.shape[1]:
        return small, found
    (closer,) = matcher.estimate_many([_moved(shown)], raw=True)
    return shown.small, _surer(_unmoved(shown, closer), found)


def _surer(closer: Estimate, found: Estimate) -> Estimate:
    """The closer look, but what was found at a smaller size where that is another surface, and surer."""
    size = closer.disparity_px.shape[::-1]
    scale = np.float32(size[0] / found.disparity_px.shape[1])
    found_px, right_found_px, confidence, right_trust = (
        _nearest(values, size)
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
    """Where two disparities are not of one surface."""
    return np.abs(one_px - other_px) > _OTHER_SURFACE_PX


def _shrunk(found: Estimate, pair: StereoPair) -> Estimate:
    """The estimate of a larger copy of a pair, at its size; no pixel is a mix of two surfaces."""
    size = pair.left.shape[1::-1]
    scale = np.float32(size[0] / found.disparity_px.shape[1])
    disparity_px, right_disparity_px = (
        scale * _nearest(cv2.medianBlur(view, _MEDIAN_PX), size)
        for view in (found.disparity_px, found.right_disparity_px)
    )
    return Estimate(
        disparity_px=disparity_px,
        right_disparity_px=right_disparity_px,
        confidence=_nearest(found.confidence, size),
        occluded=_nearest(found.occluded.astype(np.uint8), size) > 0,
    )


def _nearest(values: Shaped[np.ndarray, "h w"], size: tuple[int, int]) -> Shaped[np.ndarray, "h2 w2"]:
    return cv2.resize(values, size, interpolation=cv2.INTER_NEAREST_EXACT)


def _range_beyond(pair: StereoPair, found: Estimate, max_disparity_px: float) -> tuple[float, float] | None:
    """The range of a pair where it goes beyond the network's, within which the estimate was found."""
    doubtful = _doubtful(found, max_disparity_px)
    if 100 * doubtful.mean() < _DOUBTFUL_PERCENT or not goes_beyond(pair, doubtful, (0, max_disparity_px)):
        return None
    return find_range(pair)


def _doubtful(found: Estimate, max_disparity_px: float) -> Bool[np.ndarray, "h w"]:
    """Where the network is not certain, and what it finds may be beyond its range."""
    near_end = np.abs(found.disparity_px - max_disparity_px / 2) > max_disparity_px / 2 - _MARGIN_PX
    doubtful = (found.confidence < _CONFIDENT) & ~found.occluded
    doubtful |= (near_end & (found.confidence < _CONFIDENT_AT_END)) | (found.disparity_px <= 0)
    # Only what is of some size: a network is unsure of every edge.
    small = cv2.resize(doubtful.astype(np.float32), None, fx=1 / 8, fy=1 / 8, interpolation=cv2.INTER_AREA)
    return cv2.resize(small, doubtful.shape[::-1], interpolation=cv2.INTER_LINEAR) > 0.5


def _shown_within(
    matcher: Matcher, pair: StereoPair, seen: StereoPair, range_px: tuple[float, float]
) -> _Shown:
    """A smaller pair, if need be, in which the range fits into the network's, and how it is moved to fit.

    `seen` is what the network can see at once of the pair, and the range is in its pixels.
    """
    low_px, high_px = range_px
    most_px = matcher.max_disparity_px
    if low_px >= 0 and high_px <= most_px:
        return _Shown(seen)
    scale = max((high_px - low_px) / (most_px - _MARGIN_PX), 1.0)
    small = seen
    if scale > 1:
        small = _resized(pair, scale * pair.left.shape[1] / seen.left.shape[1])
    # Not farther than the least: a network takes a plain sky for what is at the lower end of its range.
    least_px = math.floor(low_px * small.left.shape[1] / seen.left.shape[1])
    height, width = small.left.shape[:2]
    smaller = _times_smaller(matcher, width, height, abs(least_px))
    if smaller > 1:
        small = _resized(pair, smaller * pair.left.shape[1] / width)
        least_px = math.floor(low_px * small.left.shape[1] / seen.left.shape[1])
    return _Shown(small, least_px)


def _moved(shown: _Shown) -> StereoPair:
    """The pair as the network gets it: both pictures wider, so that the right one can be moved."""
    if shown.least_px is None:
        return shown.small
    (left_at, right_at), more = _places(shown.least_px), abs(shown.least_px)
    return StereoPair(
        left=_widened(shown.small.left, left_at, more - left_at),
        right=_widened(shown.small.right, right_at, more - right_at),
    )


def _unmoved(shown: _Shown, found: Estimate) -> Estimate:
    """The estimate of a pair from that of its pictures as the network got them."""
    if shown.least_px is None:
        return found
    width, least_px = shown.small.left.shape[1], np.float32(shown.least_px)
    left, right = (np.s_[:, at : at + width] for at in _places(shown.least_px))
    disparity_px = np.ascontiguousarray(found.disparity_px[left]) + least_px
    right_disparity_px = np.ascontiguousarray(found.right_disparity_px[right]) + least_px
    return Estimate(
        disparity_px=disparity_px,
        right_disparity_px=right_disparity_px,
        confidence=np.ascontiguousarray(found.confidence[left]),
        occluded=find_occluded(disparity_px, right_disparity_px),
    )


def _places(least_px: int) -> tuple[int, int]:
    """The columns of the wider pictures at which the left and the right one begin."""
    return (-least_px, 0) if least_px < 0 else (0, least_px)


def _widened(photo: np.ndarray, before: int, behind: int) -> np.ndarray:
    return cv2.copyMakeBorder(photo, 0, 0, before, behind, cv2.BORDER_REPLICATE)


def _clipped(found: Estimate, low_px: float, high_px: float) -> Estimate:
    """The estimate within a range; what was found outside is not believed."""
    outside_px = np.maximum(low_px - found.disparity_px, found.disparity_px - high_px)
    return replace(
        found,
        disparity_px=np.clip(found.disparity_px, low_px, high_px),
        right_disparity_px=np.clip(found.right_disparity_px, low_px, high_px),
        confidence=np.where(outside_px > _OUTSIDE_PX, np.float32(0), found.confidence),
    )


def _as_seen(found: Estimate, pair: StereoPair) -> Estimate:
    """The estimate with what the pair's masks say."""
    confidence, occluded = found.confidence, found.occluded
    if pair.left_seen is not None:
        confidence = np.where(pair.left_seen, confidence, np.float32(0))
    if pair.right_seen is not None:
        seen, _ = at_match(pair.right_seen.astype(np.uint8), found.disparity_px, -1)
        occluded = occluded | (seen == 0)
    return replace(found, confidence=confidence, occluded=occluded)
