"""3-D video from files: pairs of frames with their times, whatever the arrangement of the two eyes."""

from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.pictures.frame_packing import ARRANGEMENTS, guess_arrangement
from stereoweave.video.tracks import Shot, Track, open_track

_BEFORE, _AFTER = "damaged: the frame before it stands in", "damaged: the one after it stands in"
_SPOILT = "made from a damaged frame before it"
_MOVED = "its time stamp was missing or another frame's: it is shown a little later"


class StereoFrame(NamedTuple):
    """One moment of a film.

    Attributes:
        left, right: uint8 RGB [H, W, 3].
        time: Seconds from the start of the footage, exact.
        problem: Why this frame is not the one that was filmed, or why it is the last; None if all is well.
    """

    left: UInt8[np.ndarray, "h w 3"]
    right: UInt8[np.ndarray, "h w 3"]
    time: Fraction
    problem: str | None


class Footage:
    """Pairs of frames with their times; made by `open_footage`.

    Attributes:
        name: The files, as the caller gave them.
        arrangement: How a frame holds both eyes, a name in `ARRANGEMENTS`; None of two files.
        size_px: Width and height of one eye at its full size.
        frame_count: How many frames `frames` gives: one for each in the file, damaged or not.
        rate: Average frames a second.
        time_base: In seconds; all times are multiples of it.
        sound: The file whose sound belongs to it, if any.
    """

    def __init__(self, tracks: Sequence[Track], arrangement: str | None) -> None:
        """Footage of two tracks, or of one with both eyes in the given arrangement."""
        self._tracks = tracks
        self._split = ARRANGEMENTS[arrangement] if arrangement else None
        first = tracks[0]
        self.name = ", ".join(track.name for track in tracks)
        self.arrangement = arrangement
        self.size_px = self._split.eye_size_px(*first.size_px) if self._split else first.size_px
        self.frame_count = min(len(track.steps) for track in tracks)
        self.rate, self.time_base = first.rate, first.time_base
        self.sound = next((track.sound for track in tracks if track.sound), None)

    def frames(self, start: int = 0) -> Iterator[StereoFrame]:
        """The frames from number `start` on, those that a run from 0 gives; opens and closes the files.

        A frame that cannot be decoded is replaced by the last one that can; what was decoded from a damaged
        one, up to the next frame that stands for itself, is given as it is. Either says so in `problem`.
        """
        steps = self._tracks[0].steps
        every_track = zip(*(_bridged(track, start) for track in self._tracks), strict=False)
        for index, seen in zip(range(start, self.frame_count), every_track, strict=False):
            pictures = [shot.picture() for shot, _ in seen]
            left, right = self._split.eyes(*pictures) if self._split else pictures
            time = (steps[index] - steps[0]) * self.time_base
            yield StereoFrame(left, right, time, self._problem(index, [problem for _, problem in seen]))

    def _problem(self, index: int, problems: Sequence[str | None]) -> str | None:
        of_two = len(self._tracks) == 2
        found = [
            f"{track.name}: {problem}" if of_two else problem
            for track, problem in zip(self._tracks, problems, strict=True)
            if problem
        ]
        found += [_MOVED] if index in self._tracks[0].moved else []
        if index == self.frame_count - 1:
            found += [ending for track in self._tracks if (ending := self._ending(track))]
        return "; ".join(found) or None

    def _ending(self, track: Track) -> str | None:
        more = len(track.steps) - self.frame_count
        frames = "1 frame" if more == 1 else f"{more} frames"
        return f"{track.name} goes on for {frames} after the other's end" if more else track.broken_off


def open_footage(
    paths: Sequence[Path], arrangement: str | None = None, *, rate: Fraction | None = None
) -> Footage:
    """The footage in one video of both eyes, in two, left and right, or in series of pictures likewise.

    Reads through the files to know every frame's time, and decodes some frames where it has to guess.

    Args:
        paths: One or two: videos, folders of pictures, or glob patterns of pictures.
        arrangement: How one frame holds both eyes, a name in `ARRANGEMENTS`; guessed unless given.
        rate: Frames a second, for pictures, 25 unless given.

    Raises:
        FormatError: A file that cannot be read or halved, is not 3-D, or does not go with the other one.
        StereoweaveError: An unknown arrangement, not one or two paths, a video's rate, or PyAV is missing.
    """
    if arrangement not in (None, *ARRANGEMENTS):
        raise StereoweaveError(
            f"expected one of {', '.join(ARRANGEMENTS)}, found {arrangement!r}", setting="arrangement"
        )
    if not 1 <= len(paths) <= 2 or (len(paths) == 2 and arrangement):
        raise StereoweaveError(
            "expected one video with both eyes, or two, left and right, without an arrangement, "
            f"found {len(paths)}: {' '.join(map(str, paths))}"
        )
    tracks = [open_track(path, rate) for path in paths]
    if len(tracks) == 2:
        _check_company(*tracks)
        return Footage(tracks, None)
    [track] = tracks
    name = arrangement or guess_arrangement(track.name, track.samples(), track.declared)
    try:
        return Footage(tracks, name)
    except FormatError as error:
        raise FormatError(f"{track.name}: {error}") from error


def _check_company(left: Track, right: Track) -> None:
    """Refuses two films of different sizes, or whose frames drift apart by more than half of one's time."""
    if left.size_px != right.size_px:
        sizes = ["{}x{}".format(*track.size_px) for track in (left, right)]
        raise FormatError(
            f"expected left and right videos of one size, found {left.name} of {sizes[0]} "
            f"and {right.name} of {sizes[1]}; scale one of them first"
        )
    last = min(len(left.steps), len(right.steps)) - 1
    ends_s = [(track.steps[last] - track.steps[0]) * track.time_base for track in (left, right)]
    if abs(ends_s[0] - ends_s[1]) > Fraction(1, 2) / left.rate:
        raise FormatError(
            f"expected left and right videos of one frame rate, found frame {last} of {left.name} "
            f"at {float(ends_s[0]):.3f} s and of {right.name} at {float(ends_s[1]):.3f} s; "
            "bring both to one rate first"
        )


def _bridged(track: Track, start: int) -> Iterator[tuple[Shot, str | None]]:
    """What is shown as each frame of a track from number `start` on, and its problem."""
    upcoming, last, spoilt = 0, None, False
    for shot in track.shots(start):
        index = shot.number
        if not upcoming <= index < len(track.steps):
            continue
        missing = range(upcoming, index)
        yield from ((last or shot, _BEFORE if last else _AFTER) for number in missing if number >= start)
        spoilt = not shot.fresh and (spoilt or bool(missing))
        if index >= start:
            yield shot, _SPOILT if spoilt else None
        upcoming, last = index + 1, shot
    if last:
        yield from ((last, _BEFORE) for number in range(upcoming, len(track.steps)) if number >= start)
