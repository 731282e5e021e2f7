"""Temporal filter that averages the disparity of a video along its motion and restarts at each cut.

Each view is filtered separately. The previous estimate is warped to the new frame: where nothing but the
camera moves, by its motion (`camera_motion`), elsewhere along the optical flow. A change in disparity that a
pixel shares with its neighbourhood is treated as a true change in distance, and the rest as noise. Each pixel
becomes the mean over the frames that saw its point.

A pixel's mean restarts if the previous frame does not explain the image, or if the new disparity contradicts
the old one. Near anything that moves by itself in either view, one contradiction suffices, if it is not much
less confident; elsewhere, frames that agree with each other must outvote the mean. Moving objects therefore
leave no trail.
"""

import typing
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from stereoweave.errors import StereoweaveError
from stereoweave.matching.refine import right_confidence
from stereoweave.stereo import Estimate
from stereoweave.system.threads import thread_count
from stereoweave.video.camera_motion import find_camera_motion, find_corners
from stereoweave.video.motion import CUT_SHARE, Motion, convert_to_grey, halve, measure_motion
from stereoweave.video.moved_points import MovedPoints, move_points
from stereoweave.video.temporal_kernels import (
    LEAST_WEIGHT,
    SAME_PX,
    SAME_SHARE,
    Track,
    blend,
    carry,
    measure_drift,
)

# If at least this share of the image is at rest, a majority of contradictions cannot be due to chance.
_LEAST_ASKED_SHARE = 0.25


class FilteredFrame(typing.NamedTuple):
    """A frame of a video.

    Attributes:
        left_grey, right_grey: Both views as grey images, uint8 [H, W].
        left, right: Their filtered state.
        camera: Matrix of the camera's motion from the frame before (`find_camera_motion`), or None.
    """

    left_grey: np.ndarray
    right_grey: np.ndarray
    left: Track
    right: Track
    camera: np.ndarray | None


class Expectation(typing.NamedTuple):
    """Prediction of a view from the previous frames; `calm` and `drift_px` have half the image size.

    Attributes:
        carried: Track warped to the new frame.
        calm: bool, true where nothing moves near the pixel or near its match in the other view.
        drift_px: float32, disparity change of the surface since the previous frame.
    """

    carried: Track
    calm: np.ndarray
    drift_px: np.ndarray


class TemporalFilter:
    """Filter that averages the estimates of a video over time, frame by frame.

    Args:
        threads: Number of threads; at most two are used, one per view. Default: all cores.

    Raises:
        StereoweaveError: `threads` is out of range.
    """

    def __init__(self, threads: int | None = None) -> None:
        self._threads = min(thread_count(threads), 2)
        self._greys: list[np.ndarray] = []
        self._tracks: list[Track] = []
        self._camera: np.ndarray | None = None

    def __call__(
        self, left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"], estimate: Estimate
    ) -> Estimate:
        """Return the filtered estimate of the next frame; after a cut, the estimate is unchanged.

        Args:
            left: uint8 RGB [H, W, 3].
            right: Right image of the same size.
            estimate: Estimate of the pair.

        Returns:
            Estimate with both disparities and the confidence filtered, and `occluded` unchanged.
        """
        if left.shape != right.shape or left.shape[:2] != estimate.disparity_px.shape:
            raise StereoweaveError(
                "estimate: expected the same size as both images, found "
                f"{list(estimate.disparity_px.shape)} for images of {list(left.shape[:2])} and "
                f"{list(right.shape[:2])}; pass the estimate of this pair"
            )
        before, self._greys = self._greys, [convert_to_grey(left), convert_to_grey(right)]
        confidences = (estimate.confidence, right_confidence(estimate))
        disparities_px = (estimate.disparity_px, estimate.right_disparity_px)
        new_tracks = [_begin_track(*maps) for maps in zip(disparities_px, confidences, strict=True)]
        continued = self._filter_tracks(before, new_tracks) if before else None
        self._tracks = continued or new_tracks
        filtered, filtered_right = self._tracks
        return Estimate(
            disparity_px=filtered.disparity_px,
            right_disparity_px=filtered_right.disparity_px,
            confidence=filtered.confidence,
            occluded=estimate.occluded,
        )

    @property
    def last(self) -> FilteredFrame | None:
        """The last frame, filtered; None before the first one."""
        if not self._greys:
            return None
        (left_grey, right_grey), (left, right) = self._greys, self._tracks
        return FilteredFrame(left_grey, right_grey, left, right, self._camera)

    def replace_left(self, disparity_px: Float32[np.ndarray, "h w"]) -> None:
        """Replace the left disparity of the last frame, with which the next one is filtered."""
        self._tracks[0] = self._tracks[0]._replace(disparity_px=disparity_px)

    def state(self) -> dict[str, np.ndarray]:
        """Return the complete state as arrays for `np.savez`; a restored filter gives the same results."""
        kept = {}
        for side, grey, track in zip(("left", "right"), self._greys, self._tracks, strict=False):
            kept[f"{side}_grey"] = grey
            kept |= {f"{side}_{name}": values for name, values in track._asdict().items()}
        return kept

    @classmethod
    def from_state(cls, state: Mapping[str, np.ndarray], threads: int | None = None) -> "TemporalFilter":
        """Restore a filter from a saved `state`."""
        temporal_filter = cls(threads)
        for side in ("left", "right") if "left_grey" in state else ():
            temporal_filter._greys.append(state[f"{side}_grey"])
            temporal_filter._tracks.append(Track(*(state[f"{side}_{name}"] for name in Track._fields)))
        return temporal_filter

    def _filter_tracks(self, before: list[np.ndarray], new_tracks: list[Track]) -> list[Track] | None:
        """Return the new tracks filtered with the previous tracks, or None after a cut."""
        if new_tracks[0].frames.shape != self._tracks[0].frames.shape:
            return None
        with ThreadPoolExecutor(self._threads) as pool:
            halves, old_halves = [*map(halve, self._greys)], [*map(halve, before)]
            corners = find_corners(old_halves[0], self._tracks[0].disparity_px)
            self._camera = find_camera_motion(corners, halves[0])
            moved = list(pool.map(partial(move_points, self._camera), self._tracks, (False, True)))
            paths = [points.path for points in moved]
            motions = list(pool.map(measure_motion, old_halves, halves, paths))
            if np.mean([motion.explained_share for motion in motions]) < CUT_SHARE:
                return None
            # The match of a pixel is further left in the right view, and further right in the left view.
            views = zip(motions, moved, strict=True)
            expected = list(pool.map(_predict, self._tracks, new_tracks, views, motions[::-1], (-1, 1)))
            if _is_contradicted(new_tracks, expected):
                return None
            return list(pool.map(_update, new_tracks, expected))


def _begin_track(disparity_px: Float[np.ndarray, "h w"], confidence: Float[np.ndarray, "h w"]) -> Track:
    """Return the track of a view of the first frame."""
    weights = np.maximum(confidence, LEAST_WEIGHT).astype(np.float32)
    nothing, offset_px = np.zeros_like(weights), np.zeros((*weights.shape, 2), np.float32)
    return Track(disparity_px, confidence.astype(np.float32), weights, offset_px, nothing, nothing)


def _predict(
    track: Track, new: Track, view: tuple[Motion, MovedPoints], other: Motion, towards: int
) -> Expectation:
    """Predict the new frame of a view from its track.

    `view` is how the view moved, and `towards` the direction to the match in the other view: -1 for left, 1
    for right.
    """
    carried = Track(*(np.empty_like(values) for values in track))
    motion, moved = view
    carry(new.disparity_px, track, motion, moved.source, moved.offset_px, carried)
    drift_px = np.empty(motion.calm.shape, np.float32)
    measure_drift(new.disparity_px, carried, drift_px)
    calm = motion.calm & _find_calm_matches(other.calm, carried.disparity_px[::2, ::2], towards)
    return Expectation(carried, calm, drift_px)


def _find_calm_matches(
    other_calm: Bool[np.ndarray, "h2 w2"], disparity_px: Float[np.ndarray, "h2 w2"], towards: int
) -> Bool[np.ndarray, "h2 w2"]:
    """Return the mask of pixels whose match in the other view is calm.

    For a match outside the other view, the nearest border pixel counts.
    """
    height, width = other_calm.shape
    rows, columns = np.indices((height, width), np.float32)
    there = columns + np.float32(towards / 2) * disparity_px
    calm = other_calm.astype(np.uint8)
    return cv2.remap(calm, there, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE) > 0


def _is_contradicted(new_tracks: list[Track], expected: list[Expectation]) -> bool:
    """Return whether the new disparity contradicts most known pixels at rest, judging by a sample."""
    asked, contradicted = [], []
    for new, (carried, calm, drift_px) in zip(new_tracks, expected, strict=True):
        new_px, old_px, frames = (
            values[::4, ::4] for values in (new.disparity_px, carried.disparity_px, carried.frames)
        )
        apart_px = np.abs(new_px - old_px - drift_px[::2, ::2])
        asked.append(calm[::2, ::2] & (frames > 0))
        contradicted.append(asked[-1] & (apart_px > SAME_PX + SAME_SHARE * np.abs(new_px)))
    asked_share = np.mean(asked)
    return bool(asked_share >= _LEAST_ASKED_SHARE and np.mean(contradicted) > 0.5 * asked_share)


def _update(new: Track, expected: Expectation) -> Track:
    """Return the track updated with a new frame."""
    mean = Track(*(np.empty_like(values) for values in new))
    blend(new, expected.carried, expected.calm, expected.drift_px, mean)
    return mean
