"""Frames of a video in groups, each of which ends with a frame to match; aligned, shot by shot."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from fractions import Fraction
from itertools import islice
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from stereoweave.stereo import StereoPair
from stereoweave.video.cuts import begins_shot, make_small_grey
from stereoweave.video.reader import StereoFrame
from stereoweave.video.shot_alignment import ShotAligner

MATCHED_EVERY = 3
"""Every frame with this distance is matched, unless a shot begins in between."""


class FrameGroup(NamedTuple):
    """Consecutive frames, of which only the last one is matched.

    Attributes:
        frames: The frames as read; only their fine pictures are aligned.
        pairs: The aligned pairs of the frames.
    """

    frames: list[StereoFrame]
    pairs: list[StereoPair]


class FrameGrouper:
    """Grouper of a video's frames.

    The first frame is a group of its own. So is each of the next `MATCHED_EVERY` frames if a shot begins
    among them, because depth is not carried across a cut.

    Args:
        aligner: Aligner of the frames; None to leave them as they are.
        last_grey: The last frame's left image, as read, from `make_small_grey`; None at the start.

    Attributes:
        cuts: Number of shots that followed another one so far.
    """

    def __init__(
        self, aligner: ShotAligner | None, last_grey: UInt8[np.ndarray, "h w"] | None = None
    ) -> None:
        self._aligner, self._last_grey = aligner, last_grey
        self.cuts = 0
        self._first_times: set[Fraction] = set()

    def __call__(self, frames: Iterable[StereoFrame]) -> Iterator[FrameGroup]:
        """Yield the frames in groups. The last frame ends a group, so that it is matched in any case."""
        iterator = iter(frames)
        while several := list(islice(iterator, 1 if self._last_grey is None else MATCHED_EVERY)):
            grey = make_small_grey(several[-1].left)
            if len(several) > 1 and not begins_shot(self._last_grey, grey):
                self._last_grey = grey
                yield _make_group([self._align(frame) for frame in several])
                continue
            for frame in several:
                yield _make_group([self._begin(frame)])

    def began_shot(self, frame: StereoFrame) -> bool:
        """Return whether a frame that was yielded is the first one after a cut; true once for each."""
        begins = frame.time in self._first_times
        self._first_times.discard(frame.time)
        return begins

    @property
    def has_warped(self) -> bool:
        """Whether any frame was warped so far."""
        return self._aligner is not None and self._aligner.has_warped

    def state(self) -> dict[str, np.ndarray]:
        """Return the complete state as arrays; a restored grouper gives the same results."""
        kept = {} if self._last_grey is None else {"last_grey": self._last_grey}
        return {"shots_begun": np.array(self.cuts)} | kept | (self._aligner.state() if self._aligner else {})

    @classmethod
    def from_state(cls, state: Mapping[str, np.ndarray]) -> "FrameGrouper":
        """Restore a grouper from a saved `state`."""
        aligner = ShotAligner.from_state(state) if "aligner" in state else None
        grouper = cls(aligner, state.get("last_grey"))
        grouper.cuts = int(state["shots_begun"])
        return grouper

    def _begin(self, frame: StereoFrame) -> tuple[StereoFrame, StereoPair]:
        """Return a frame and its aligned pair; if the frame begins a shot, its rows are measured."""
        grey = make_small_grey(frame.left)
        if self._last_grey is not None and begins_shot(self._last_grey, grey):
            self.cuts += 1
            self._first_times.add(frame.time)
            if self._aligner:
                self._aligner.begin_shot()
        self._last_grey = grey
        return self._align(frame)

    def _align(self, frame: StereoFrame) -> tuple[StereoFrame, StereoPair]:
        pair = StereoPair(left=frame.left, right=frame.right)
        if self._aligner is None:
            return frame, pair
        aligned = self._aligner(pair)
        return frame.change_fine(self._aligner.align_fine()), aligned


def _make_group(aligned: Sequence[tuple[StereoFrame, StereoPair]]) -> FrameGroup:
    return FrameGroup([frame for frame, _ in aligned], [pair for _, pair in aligned])
