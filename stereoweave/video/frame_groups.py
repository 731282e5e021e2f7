"""Frames of a video in groups, each of which ends with a frame to match; aligned, shot by shot."""

from collections.abc import Iterable, Iterator, Mapping
from itertools import islice
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from stereoweave.stereo import StereoPair
from stereoweave.video.motion import CUT_SHARE, convert_to_grey, halve, measure_motion
from stereoweave.video.reader import StereoFrame
from stereoweave.video.shot_alignment import ShotAligner

MATCHED_EVERY = 3
"""Every frame with this distance is matched, unless a shot begins in between."""


class FrameGroup(NamedTuple):
    """Consecutive frames, of which only the last one is matched.

    Attributes:
        frames: The frames as read.
        pairs: The aligned pairs of the frames.
    """

    frames: list[StereoFrame]
    pairs: list[StereoPair]


class FrameGrouper:
    """Grouper of a video's frames.

    A group has a single frame at the start of the video, and up to `MATCHED_EVERY` frames in which a shot
    begins are matched one by one, since depth is not carried across a cut.

    Args:
        aligner: Aligner of the frames; None to leave them as they are.
        last_grey: Left image of the frame before, aligned, grey and at half size; None at the start.
    """

    def __init__(
        self, aligner: ShotAligner | None, last_grey: UInt8[np.ndarray, "h w"] | None = None
    ) -> None:
        self._aligner, self._last_grey = aligner, last_grey

    def __call__(self, frames: Iterable[StereoFrame]) -> Iterator[FrameGroup]:
        """Yield the frames in groups. The last frame ends a group, so that it is matched in any case."""
        iterator = iter(frames)
        while several := list(islice(iterator, 1 if self._last_grey is None else MATCHED_EVERY)):
            last = self._align(several[-1])
            if len(several) > 1 and not self._begins_shot(last):
                yield FrameGroup(several, [*map(self._align, several[:-1]), last])
                self._last_grey = _thumbnail(last)
                continue
            for frame in several:
                yield FrameGroup([frame], [self._begin(frame)])

    def state(self) -> dict[str, np.ndarray]:
        """Return the complete state as arrays; a restored grouper gives the same results."""
        kept = {} if self._last_grey is None else {"last_grey": self._last_grey}
        return kept | (self._aligner.state() if self._aligner else {})

    @classmethod
    def from_state(cls, state: Mapping[str, np.ndarray]) -> "FrameGrouper":
        """Restore a grouper from a saved `state`."""
        return cls(ShotAligner.from_state(state) if "aligner" in state else None, state.get("last_grey"))

    def _begin(self, frame: StereoFrame) -> StereoPair:
        """Return a frame's aligned pair; if it begins a shot, its rows are measured first."""
        pair = self._align(frame)
        if self._aligner and self._last_grey is not None and self._begins_shot(pair):
            self._aligner.begin_shot()
            pair = self._align(frame)
        self._last_grey = _thumbnail(pair)
        return pair

    def _begins_shot(self, pair: StereoPair) -> bool:
        grey = _thumbnail(pair)
        if self._last_grey is None or self._last_grey.shape != grey.shape:
            return True
        return measure_motion(self._last_grey, grey).explained_share < CUT_SHARE

    def _align(self, frame: StereoFrame) -> StereoPair:
        pair = StereoPair(left=frame.left, right=frame.right)
        return self._aligner(pair) if self._aligner else pair


def _thumbnail(pair: StereoPair) -> UInt8[np.ndarray, "h w"]:
    return halve(convert_to_grey(pair.left))
