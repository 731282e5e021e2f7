"""Depth of the frames between two matched ones, carried along the motion of the video.

A network is slow, and consecutive frames of a video hardly differ. Matching every third frame and carrying
depth to the frames between is three times as fast. A point that one of the two matched frames does not show
is visible in the other one, so both are asked.
"""

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import repeat
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, UInt8

from stereoweave.matching.left_right_check import find_occluded
from stereoweave.stereo import Estimate, StereoPair
from stereoweave.video.carried_kernels import Source, take_pixels
from stereoweave.video.frame_groups import FrameGroup
from stereoweave.video.motion import convert_to_grey, find_flow, halve
from stereoweave.video.reader import StereoFrame
from stereoweave.video.temporal_filter import FilteredFrame, TemporalFilter
from stereoweave.video.temporal_kernels import Track

# A window's pixel weighs less, the more its grey level differs from the centre's, because it may then belong
# to another surface (K.-J. Yoon and I. S. Kweon, "Adaptive Support-Weight Approach for Correspondence
# Search", 2006).
WEIGHTS = np.exp(-np.arange(256) / 10).astype(np.float32)


class EstimatedFrame(NamedTuple):
    """A frame as read, its aligned pair, and the pair's estimate."""

    frame: StereoFrame
    pair: StereoPair
    estimate: Estimate


def carry_depth(
    matched: Iterable[tuple[FrameGroup, Estimate]], temporal_filter: TemporalFilter, threads: int
) -> Iterator[EstimatedFrame]:
    """Yield all frames of a video with steady estimates.

    Args:
        matched: Groups of frames, each with the estimate of its last frame.
        temporal_filter: Filter of the matched frames.
        threads: Maximum number of threads.
    """
    for (frames, pairs), estimate in matched:
        before, last = temporal_filter.last, pairs[-1]
        steady = temporal_filter(last.left, last.right, estimate)
        carried = carry_between(pairs[:-1], before, temporal_filter.last, threads)
        yield from map(EstimatedFrame, frames, pairs, [*carried, steady])


def carry_between(
    pairs: Sequence[StereoPair], before: FilteredFrame | None, after: FilteredFrame | None, threads: int
) -> list[Estimate]:
    """Return the estimates of the frames between two matched frames, which are evenly spaced in time.

    Args:
        pairs: The frames between, in order.
        before: The matched frame before them; may be None if there are none between, like the next one.
        after: The matched frame after them, of the same size.
        threads: Maximum number of threads; at most one is used for each frame.
    """
    if not pairs or before is None or after is None:
        return []
    shares = [number / (len(pairs) + 1) for number in range(1, len(pairs) + 1)]
    with ThreadPoolExecutor(min(threads, len(pairs))) as pool:
        return list(pool.map(_carry, pairs, repeat(before), repeat(after), shares))


def rehearse_carrying() -> None:
    """Carry depth between small frames, to compile all kernels (`compiling_ahead.compile_ahead`)."""
    image, px = np.zeros((32, 32, 3), np.uint8), np.zeros((32, 32), np.float32)
    pair, temporal_filter = StereoPair(left=image, right=image), TemporalFilter(1)
    estimate = Estimate(disparity_px=px, right_disparity_px=px, confidence=px, occluded=px > 0)
    matched = []
    for _ in range(2):
        temporal_filter(pair.left, pair.right, estimate)
        matched.append(temporal_filter.last)
    carry_between([pair], matched[0], matched[1], 1)


def _carry(pair: StereoPair, before: FilteredFrame, after: FilteredFrame, share: float) -> Estimate:
    """Return the estimate of the frame at this share of the time between two matched frames."""
    left, right = convert_to_grey(pair.left), convert_to_grey(pair.right)
    of_left = (before.left_grey, before.left), (after.left_grey, after.left)
    of_right = (before.right_grey, before.right), (after.right_grey, after.right)
    disparity_px, confidence = _carry_view((left, right), -1, of_left, share)
    right_disparity_px, _ = _carry_view((right, left), 1, of_right, share)
    return Estimate(
        disparity_px=disparity_px,
        right_disparity_px=right_disparity_px,
        confidence=confidence,
        occluded=find_occluded(disparity_px, right_disparity_px),
    )


def _carry_view(
    greys: tuple[UInt8[np.ndarray, "h w"], UInt8[np.ndarray, "h w"]],
    towards: int,
    matched: tuple[tuple[np.ndarray, Track], tuple[np.ndarray, Track]],
    share: float,
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Return a view's disparity and confidence.

    Args:
        greys: This view and the other one.
        towards: Direction to the match in the other view: -1 for left, 1 for right.
        matched: This view's grey image and track in the matched frames before and after.
        share: Time of the frame between the two.
    """
    own, other = greys
    half = halve(own)
    before, after = (
        Source(grey, track.disparity_px, track.confidence, find_flow(halve(grey), half))
        for grey, track in matched
    )
    disparity_px, confidence = np.empty(own.shape, np.float32), np.empty(own.shape, np.float32)
    take_pixels(own, other, towards, before, after, share, WEIGHTS, disparity_px, confidence)
    return disparity_px, confidence
