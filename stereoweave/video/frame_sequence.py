"""Reading of frame-sequential videos, in which left and right frames alternate."""

from collections.abc import Iterable, Iterator
from functools import partial
from itertools import islice

import numpy as np
from jaxtyping import Float32, UInt8

from stereoweave.errors import FormatError, Note
from stereoweave.stereo import StereoCamera
from stereoweave.video.picture_track import PictureTrack
from stereoweave.video.track_frame import TrackFrame
from stereoweave.video.tracks import Track


class FrameSequence:
    """Pairs of successive frames of a track, with the attributes of a `VideoTrack` that reading needs.

    A pair has the time of its first frame. Of an odd number of frames, the last one is dropped.

    Raises:
        FormatError: The track has only one frame.
    """

    camera: StereoCamera | None = None

    def __init__(self, track: Track, *, right_first: bool) -> None:
        count = len(track.steps) // 2
        if not count:
            raise FormatError(
                f"{track.name}: expected left and right frames in turn, found a video of one frame"
            )
        self.name, self._track, self._right_first = track.name, track, right_first
        self.steps = track.steps[: 2 * count : 2]
        self.retimed = {index // 2 for index in track.retimed if index % 2 == 0}
        self.time_base, self.rate = track.time_base, track.rate / 2
        self.size_px, self.sound, self.truncation = track.size_px, track.sound, track.truncation
        self.unknown_sounds = track.unknown_sounds
        self.pixel_aspect = track.pixel_aspect
        self.sphere, self.own_colours = track.sphere, track.own_colours
        odd = [Note("the last frame is dropped, because no second view follows it")]
        self.notes = [*track.notes, *(odd if len(track.steps) % 2 else [])]

    def frames(self, start: int, first: int = 0) -> Iterator[TrackFrame]:
        """Yield the pairs of which both frames can be decoded, the first one early enough to bridge gaps.

        It is at or before `start` or `first`, if there is one; see the tracks' `frames`.
        """
        if isinstance(self._track, PictureTrack):
            yield from self._pair(2 * _find_whole_pair(self._track, start))
            return
        frames = self._pair(2 * start, 2 * first)
        opening = next(frames, None)
        if opening is None or opening.number > first > 0:
            frames, opening = self._pair(0), None
        if opening is not None:
            yield opening
        yield from frames

    def can_begin(self, most: int) -> bool:
        """Return whether the first frames that can be decoded, at most this many, hold a pair."""
        frames = islice(self._track.frames(0), most)
        return next(_pair_frames(frames, right_first=self._right_first), None) is not None

    def _pair(self, start: int, first: int = 0) -> Iterator[TrackFrame]:
        return _pair_frames(self._track.frames(start, first), right_first=self._right_first)


def _find_whole_pair(track: PictureTrack, start: int) -> int:
    """Return the number of the last pair at or before `start` of readable pictures; 0 if there is none."""
    pair = start
    while pair > 0:
        numbers = [frame.number for frame in islice(track.frames(2 * pair), 2)]
        if numbers == [2 * pair, 2 * pair + 1]:
            break
        # The first picture is the last readable one at or before the pair's, if there is one.
        pair = min(pair - 1, numbers[0] // 2) if numbers else 0
    return pair


def _pair_frames(frames: Iterable[TrackFrame], *, right_first: bool) -> Iterator[TrackFrame]:
    waiting = None
    for frame in frames:
        if waiting is not None and frame.number % 2 and frame.number == waiting.number + 1:
            both = (frame, waiting) if right_first else (waiting, frame)
            yield TrackFrame(
                number=frame.number // 2,
                pictures=partial(_convert_both, *both),
                is_key_frame=waiting.is_key_frame,
                fine_pictures=partial(_convert_both_fine, *both),
            )
        waiting = frame


def _convert_both(left: TrackFrame, right: TrackFrame) -> list[UInt8[np.ndarray, "h w 3"]]:
    return [*left.pictures(), *right.pictures()]


def _convert_both_fine(left: TrackFrame, right: TrackFrame) -> list[Float32[np.ndarray, "h w 3"]]:
    return [*left.fine_pictures(), *right.fine_pictures()]
