"""Reading of stereo video: pairs of frames with their times, for any frame packing."""

from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.pictures.pair_layouts import PAIR_LAYOUTS, detect_layout
from stereoweave.video.tracks import Shot, Track, open_track

_REPEATED_LAST, _REPEATED_NEXT = (
    "damaged: replaced by the frame before it",
    "damaged: replaced by the frame after it",
)
_AFTER_DAMAGE = "decoded from a damaged frame before it"
_RETIMED = "its time stamp was missing or a duplicate: it is shown slightly later"


class StereoFrame(NamedTuple):
    """One pair of frames of a video.

    Attributes:
        left, right: uint8 RGB [H, W, 3].
        time: Exact time in seconds from the start of the video.
        problem: Why this frame is not the original one, or why the video ends early; None if intact.
    """

    left: UInt8[np.ndarray, "h w 3"]
    right: UInt8[np.ndarray, "h w 3"]
    time: Fraction
    problem: str | None


class StereoVideo:
    """A stereo video: pairs of frames with their times; opened by `open_video`.

    Attributes:
        name: The files, as the caller gave them.
        frame_packing: How a frame holds both eyes, a name in `PAIR_LAYOUTS`; None for two files.
        size_px: Width and height of one eye at full size.
        frame_count: Number of frames that `frames` yields: one for each in the file, damaged or not.
        rate: Average frames per second.
        time_base: Unit of all times, in seconds; every time is a multiple of it.
        sound: The file that has the video's sound, if any.
    """

    def __init__(self, tracks: Sequence[Track], frame_packing: str | None) -> None:
        """Combine two tracks, or split one that has both eyes in each frame."""
        self._tracks = tracks
        self._split = PAIR_LAYOUTS[frame_packing] if frame_packing else None
        first = tracks[0]
        self.name = ", ".join(track.name for track in tracks)
        self.frame_packing = frame_packing
        self.size_px = self._split.eye_size_px(*first.size_px) if self._split else first.size_px
        self.frame_count = min(len(track.steps) for track in tracks)
        self.rate, self.time_base = first.rate, first.time_base
        self.sound = next((track.sound for track in tracks if track.sound), None)

    def frames(self, start: int = 0) -> Iterator[StereoFrame]:
        """Yield the frames from number `start` on, identical to those of a run from 0.

        A frame that cannot be decoded is replaced by the last decoded one. Frames decoded from a damaged one,
        up to the next key frame, are yielded unchanged. `problem` reports both.
        """
        steps = self._tracks[0].steps
        every_track = zip(*(_bridge_gaps(track, start) for track in self._tracks), strict=False)
        for index, seen in zip(range(start, self.frame_count), every_track, strict=False):
            pictures = [shot.picture() for shot, _ in seen]
            left, right = self._split.eyes(*pictures) if self._split else pictures
            time = (steps[index] - steps[0]) * self.time_base
            yield StereoFrame(
                left, right, time, self._describe_problem(index, [problem for _, problem in seen])
            )

    def _describe_problem(self, index: int, problems: Sequence[str | None]) -> str | None:
        of_two = len(self._tracks) == 2
        found = [
            f"{track.name}: {problem}" if of_two else problem
            for track, problem in zip(self._tracks, problems, strict=True)
            if problem
        ]
        found += [_RETIMED] if index in self._tracks[0].retimed else []
        if index == self.frame_count - 1:
            found += [ending for track in self._tracks if (ending := self._describe_ending(track))]
        return "; ".join(found) or None

    def _describe_ending(self, track: Track) -> str | None:
        more = len(track.steps) - self.frame_count
        frames = "1 frame" if more == 1 else f"{more} frames"
        return f"{track.name} has {frames} more than the other video" if more else track.truncation


def open_video(
    paths: Sequence[Path], format: str | None = None, *, rate: Fraction | None = None
) -> StereoVideo:
    """Open a stereo video: one file with both eyes, or two, left and right.

    Reads the files once for every frame's time, and decodes some frames to detect the frame packing.

    Args:
        paths: One or two videos, folders of pictures, or glob patterns of pictures.
        format: How one frame holds both eyes, a name in `PAIR_LAYOUTS`. Default: detected.
        rate: Frames per second of pictures; default: 25.

    Raises:
        FormatError: A file cannot be read or halved, is not 3-D, or does not match the other one.
        StereoweaveError: Unknown frame packing, not one or two paths, a rate for a video, or PyAV is missing.
    """
    if format not in (None, *PAIR_LAYOUTS):
        raise StereoweaveError(
            f"expected one of {', '.join(PAIR_LAYOUTS)}, found {format!r}", setting="format"
        )
    if not 1 <= len(paths) <= 2 or (len(paths) == 2 and format):
        raise StereoweaveError(
            "expected one video with both eyes, or two, left and right, without a frame packing, "
            f"found {len(paths)}: {' '.join(map(str, paths))}"
        )
    tracks = [open_track(path, rate) for path in paths]
    if len(tracks) == 2:
        _check_alike(*tracks)
        return StereoVideo(tracks, None)
    [track] = tracks
    name = format or detect_layout(track.name, track.samples(), track.declared_packing)
    try:
        return StereoVideo(tracks, name)
    except FormatError as error:
        raise FormatError(f"{track.name}: {error}") from error


def _check_alike(left: Track, right: Track) -> None:
    """Raise unless both videos have one size and their frames stay within half a frame of each other."""
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


def _bridge_gaps(track: Track, start: int) -> Iterator[tuple[Shot, str | None]]:
    """Yield a shot and its problem for each frame from number `start` on; replaces missing frames."""
    upcoming, last, after_damage = 0, None, False
    for shot in track.shots(start):
        index = shot.number
        if not upcoming <= index < len(track.steps):
            continue
        missing = range(upcoming, index)
        yield from (
            (last or shot, _REPEATED_LAST if last else _REPEATED_NEXT)
            for number in missing
            if number >= start
        )
        after_damage = not shot.is_key_frame and (after_damage or bool(missing))
        if index >= start:
            yield shot, _AFTER_DAMAGE if after_damage else None
        upcoming, last = index + 1, shot
    if last:
        yield from ((last, _REPEATED_LAST) for number in range(upcoming, len(track.steps)) if number >= start)


def format_time(time_s: Fraction) -> str:
    """Format a time: 0:01:02.345 for 62.345 s."""
    minutes, seconds = divmod(float(time_s), 60)
    return f"{int(minutes) // 60}:{int(minutes) % 60:02}:{seconds:06.3f}"
