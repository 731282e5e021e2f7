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
from jaxtyping import Float32, Float64, Int32, UInt8

from stereoweave.matching.edge_vote.vote import sharpen_edges
from stereoweave.matching.left_right_check import find_occluded
from stereoweave.stereo import Estimate, StereoPair
from stereoweave.video.camera_motion import TrackedCorners, find_camera_motion, find_corners
from stereoweave.video.carried_kernels import Source, locate, take_pixels
from stereoweave.video.frame_groups import FrameGroup
from stereoweave.video.motion import convert_to_grey, halve, measure_motion
from stereoweave.video.moved_points import move_points
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
        filtered = temporal_filter(last.left, last.right, sharpen_edges(last.left, estimate, threads))
        # Pixels are filtered one by one, which frays edges.
        steady = sharpen_edges(last.left, filtered, threads)
        temporal_filter.replace_left(steady.disparity_px)
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
    corners = find_corners(halve(before.left_grey), before.left.disparity_px)
    with ThreadPoolExecutor(min(threads, len(pairs))) as pool:
        return list(pool.map(_carry, pairs, repeat((before, after)), repeat(corners), shares))


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
    # The camera rests here, so that nothing has moved its points.
    move_points(np.eye(4), Track(px, px, px, np.zeros((32, 32, 2), np.float32), px, px), right=False)


def _carry(
    pair: StereoPair, matched: tuple[FilteredFrame, FilteredFrame], corners: TrackedCorners, share: float
) -> Estimate:
    """Return the estimate of the frame at this share of the time between two matched frames.

    `corners` are those of the frame before.
    """
    left, right = convert_to_grey(pair.left), convert_to_grey(pair.right)
    from_before, between = find_camera_motion(corners, halve(left)), matched[1].camera
    from_after = None
    if from_before is not None and between is not None:
        from_after = from_before @ np.linalg.inv(between)
    of_left = [(frame.left_grey, frame.left) for frame in matched]
    of_right = [(frame.right_grey, frame.right) for frame in matched]
    disparity_px, confidence = _carry_view((left, right), -1, of_left, (from_before, from_after), share)
    # To move the right view's points takes as long, and only its own edges gain by it.
    right_disparity_px, _ = _carry_view((right, left), 1, of_right, (None, None), share)
    return Estimate(
        disparity_px=disparity_px,
        right_disparity_px=right_disparity_px,
        confidence=confidence,
        occluded=find_occluded(disparity_px, right_disparity_px),
    )


def _carry_view(
    greys: tuple[UInt8[np.ndarray, "h w"], UInt8[np.ndarray, "h w"]],
    towards: int,
    matched: Sequence[tuple[np.ndarray, Track]],
    cameras: Sequence[np.ndarray | None],
    share: float,
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Return a view's disparity and confidence.

    Args:
        greys: This view and the other one.
        towards: Direction to the match in the other view: -1 for left, 1 for right.
        matched: This view's grey image and track in the matched frames before and after.
        cameras: Camera motions from these frames to this one (`find_camera_motion`).
        share: Time of the frame between the two.
    """
    own, other = greys
    before, after = (
        Source(
            grey, track.disparity_px, track.confidence, _find_places(own, grey, track, camera, towards > 0)
        )
        for (grey, track), camera in zip(matched, cameras, strict=True)
    )
    disparity_px, confidence = np.empty(own.shape, np.float32), np.empty(own.shape, np.float32)
    take_pixels(own, other, towards, before, after, share, WEIGHTS, disparity_px, confidence)
    return disparity_px, confidence


def _find_places(
    own: UInt8[np.ndarray, "h w"],
    grey: UInt8[np.ndarray, "h w"],
    track: Track,
    camera: Float64[np.ndarray, "4 4"] | None,
    right: bool,
) -> Int32[np.ndarray, "h w"]:
    """Return the index of the pixel of a matched frame that each pixel of a view shows."""
    moved = move_points(camera, track, right)
    motion = measure_motion(halve(grey), halve(own), moved.path, paths_only=True)
    places = np.empty(own.shape, np.int32)
    locate(motion, moved.source, places)
    return places
