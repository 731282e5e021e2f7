"""Timestamps of a video stream, and the number of each decoded frame."""

from array import array
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from fractions import Fraction
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeVar

from stereoweave.video.spatial import ViewPair
from stereoweave.video.streams import describe_error, is_frame

if TYPE_CHECKING:
    import av

Decoded = TypeVar("Decoded", "av.VideoFrame", ViewPair)


def read_stamps(
    container: "av.container.InputContainer", stream: "av.VideoStream"
) -> tuple[list[int | None], Fraction, str | None]:
    """Return all timestamps of a stream, the latest end of any track, and the reason for an early stop.

    The end is in seconds. The reason is None if the whole file could be read.
    """
    import av

    stamps: list[int | None] = []
    end_s = Fraction(0)
    try:
        for packet in container.demux():
            if packet.stream is stream and is_frame(packet):
                stamps.append(packet.pts)
            if packet.pts is not None and packet.time_base:
                end_s = max(end_s, (packet.pts + (packet.duration or 0)) * packet.time_base)
    except av.error.FFmpegError as error:
        return stamps, end_s, describe_error(error)
    return stamps, end_s, None


def fill_missing(stamps: Sequence[int | None]) -> list[int]:
    """Replace each missing timestamp with the last known timestamp before it in the file."""
    known = next(stamp for stamp in stamps if stamp is not None)
    return [known := known if stamp is None else stamp for stamp in stamps]


def separate_duplicates(stamps: Sequence[int], frame_steps: int) -> tuple["array[int]", list[int]]:
    """Make sorted timestamps strictly increasing by delaying duplicates.

    A duplicate is delayed by the usual interval, or by half the time to the next frame if that is shorter.

    Args:
        stamps: Sorted timestamps, in units of a time base.
        frame_steps: Usual interval between frames, in the same units.

    Returns:
        The new times, and the indices of the delayed frames.
    """
    steps, retimed = array("q", stamps[:1]), []
    later = [b for a, b in pairwise(stamps) if b > a]
    after = 0
    for index in range(1, len(stamps)):
        if stamps[index] > stamps[index - 1]:
            after += 1
            steps.append(max(stamps[index], steps[-1] + 1))
            continue
        room = (later[after] - steps[-1]) // 2 if after < len(later) else frame_steps
        steps.append(steps[-1] + max(min(frame_steps, room), 1))
        retimed.append(index)
    return steps, retimed


def number_by_stamp(frames: Iterator[Decoded], stamps: Sequence[int]) -> Iterator[tuple[int, Decoded]]:
    """Yield each frame with its index, found by timestamp. Frames with equal timestamps keep their order."""
    last = -1
    for frame in frames:
        stamp = stamps[max(last, 0)] if frame.pts is None else frame.pts
        index = max(bisect_left(stamps, stamp), last + 1)
        if index < len(stamps) and stamps[index] == stamp:
            yield index, frame
            last = index


def number_by_rank(frames: Iterator[Decoded], stream: "av.VideoStream") -> Iterator[tuple[int, Decoded]]:
    """Yield each frame with its index, found by the position of its packet among all packets.

    Without B-frames, a lost frame is noticed at the next frame; with B-frames, only at the next key frame.
    """
    index = -1
    for frame in frames:
        ranked: Any = frame
        in_turn = frame.key_frame or not stream.codec_context.has_b_frames
        index = max(index + 1, ranked.opaque) if in_turn and ranked.opaque is not None else index + 1
        yield index, frame


def choose_rate(steps: Sequence[int], time_base: Fraction, average: Fraction) -> Fraction:
    """Return the container's frame rate, or the measured rate if the two differ by more than 1 %."""
    if len(steps) < 2:
        return average
    measured = Fraction(len(steps) - 1) / ((steps[-1] - steps[0]) * time_base)
    return average if abs(average / measured - 1) <= Fraction(1, 100) else measured
