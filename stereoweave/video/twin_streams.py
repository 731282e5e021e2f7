"""Stereo videos that hold each view in a video stream of its own.

Fujifilm's 3-D cameras write such AVI files (3D-AVI, MJPEG, left stream first), Leia's tablets such MP4 files
(LVF, left stream first). Matroska names the planes of a stereo track in its element `TrackOperation`, from
which FFmpeg sets the streams' tag `stereo_mode` to "left" or "right" and a number (RFC 9559, 18.8 and 18.10).
"""

from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

from stereoweave.errors import FormatError, Note, Remedy
from stereoweave.pictures.pair_layouts import show_same_scene
from stereoweave.video.packings import TWO_STREAMS
from stereoweave.video.streams import StreamFacts, list_video_streams
from stereoweave.video.tracks import VideoTrack

_OVERRIDE = Remedy("override it if it is wrong", ("format",))
_SIDES = ("left_", "right_")
# Rates that differ by less than this are the same, measured by different means.
_RATE_TOLERANCE = Fraction(1, 1000)


class Twins(NamedTuple):
    """The two streams of a stereo video.

    Attributes:
        packing: Its name in `TWO_STREAMS`.
        tracks: The left and the right view.
        note: How they were recognised.
    """

    packing: str
    tracks: tuple[VideoTrack, VideoTrack]
    note: Note


def open_twins(path: Path, packing: str | None) -> Twins | None:
    """Open the two streams of a video file; None if it is not such a video.

    Args:
        path: A video file.
        packing: Name in `TWO_STREAMS`. Default: detected. Unless the file names the views, both streams must
            then show the same scene, because files also hold two versions of a film, or two channels.

    Raises:
        FormatError: `packing` is given, but the file does not hold two like streams; or see `VideoTrack`.
    """
    streams = list_video_streams(path)
    named = _find_named(streams)
    chosen = named or streams
    if len(chosen) != 2 or not _are_like(*chosen):
        if packing is None:
            return None
        sizes = ", ".join(f"{stream.size_px[0]}x{stream.size_px[1]}" for stream in streams) or "none"
        raise FormatError(
            f"{path}: expected two video streams of the same size and rate, found {len(streams)}: {sizes}",
            remedy=Remedy("choose another frame packing", ("format",)),
        )
    right_first = TWO_STREAMS[packing or "two_streams"]
    first, second = (VideoTrack(path, stream.number) for stream in chosen)
    if not (packing or named or show_same_scene(list(zip(first.samples(), second.samples(), strict=False)))):
        return None
    order = "in the order of their names" if named else "the left one first"
    if packing:
        order = f"{'right' if right_first else 'left'} one first, as given"
    return Twins(
        packing or "two_streams",
        (second, first) if right_first else (first, second),
        Note(f"two video streams of the same size and rate, {order}", None if packing else _OVERRIDE),
    )


def _find_named(streams: list[StreamFacts]) -> list[StreamFacts]:
    """Return the streams that the file names the left and the right view; none unless it names each once."""
    found = [[stream for stream in streams if stream.plane.startswith(side)] for side in _SIDES]
    return [side[0] for side in found] if [len(side) for side in found] == [1, 1] else []


def _are_like(first: StreamFacts, second: StreamFacts) -> bool:
    return first.size_px == second.size_px and abs(first.rate / second.rate - 1) < _RATE_TOLERANCE
