"""Conversion of a whole film in a process of its own, and its comparison with the original."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

from stereoweave.arguments import check_choice
from stereoweave.errors import StereoweaveError
from stereoweave.video.reader import open_video

OUTPUTS: Mapping[str, Sequence[str]] = {
    "side_by_side": ["--layout", "side_by_side"],
    "anaglyph": ["--layout", "anaglyph_dubois"],
    "depth": ["--depth"],
    "vr180_window": ["--layout", "side_by_side", "--projection", "half_equirectangular", "--look", "20,0"],
}


@dataclass(frozen=True, kw_only=True)
class ConversionRow:
    """One conversion of one film.

    Attributes:
        film: File name of the film.
        output: What it was converted to, a key of `OUTPUTS`.
        width_px, height_px: Size of a frame of one eye of the film.
        frames: Number of frames of the film.
        lost_frames: Frames of the film without a frame of the same time in the output.
        added_frames: Frames of the output without a frame of the same time in the film.
        sound_packets: Number of sound packets of the film.
        sound_is_equal: Whether the output's sound has the same bytes at the same times.
        frames_per_s: Frames per second of the whole command, from its start to its end.
        peak_mb: Greatest resident memory of the command, in 1e6 bytes.
    """

    film: str
    output: str
    width_px: int
    height_px: int
    frames: int
    lost_frames: int
    added_frames: int
    sound_packets: int
    sound_is_equal: bool
    frames_per_s: float
    peak_mb: float


class _Contents(NamedTuple):
    """Times of a file's video frames in seconds, and its sound as times and bytes of packets."""

    times_s: set[Fraction]
    sound: list[tuple[Fraction, bytes]]


def measure_conversions(film: Path, outputs: Sequence[str] | None = None) -> list[ConversionRow]:
    """Return a row for each output, by default for all.

    Raises:
        StereoweaveError: An output is unknown, or the command fails.
    """
    for output in outputs or ():
        check_choice("output", output, OUTPUTS)
    width_px, height_px = open_video([film]).size_px
    original = _read(film)
    rows = []
    for output in outputs or OUTPUTS:
        with tempfile.TemporaryDirectory() as folder:
            wall_s, peak_mb = _convert(film, OUTPUTS[output], Path(folder))
            (converted,) = map(_read, Path(folder).iterdir())
        rows.append(
            ConversionRow(
                film=film.name,
                output=output,
                width_px=width_px,
                height_px=height_px,
                frames=len(original.times_s),
                lost_frames=len(original.times_s - converted.times_s),
                added_frames=len(converted.times_s - original.times_s),
                sound_packets=len(original.sound),
                sound_is_equal=original.sound == converted.sound,
                frames_per_s=len(original.times_s) / wall_s,
                peak_mb=peak_mb,
            )
        )
    return rows


def _convert(film: Path, options: Sequence[str], folder: Path) -> tuple[float, float]:
    """Convert a film into a folder; return the time in seconds and the peak of memory in 1e6 bytes."""
    command = [sys.executable, "-m", "stereoweave", "video", str(film.absolute()), "-o", "out.mp4", *options]
    paths = {"PYTHONPATH": os.pathsep.join(filter(None, map(os.path.abspath, sys.path)))}
    start_s = time.perf_counter()
    with subprocess.Popen(command, cwd=folder, env=os.environ | paths) as running:
        _, status, used = os.wait4(running.pid, 0)
        running.returncode = os.waitstatus_to_exitcode(status)
    if running.returncode:
        raise StereoweaveError(f"{film}: expected exit code 0, found {running.returncode}")
    # Linux counts in 1024 bytes.
    return time.perf_counter() - start_s, used.ru_maxrss * 1024 / 1e6


def _read(path: Path) -> _Contents:
    """Return the contents of a video file, in the order of its packets."""
    import av

    times_s, sound = set[Fraction](), list[tuple[Fraction, bytes]]()
    with av.open(path) as container:
        for packet in container.demux():
            # The last packet of each stream is empty.
            if packet.pts is None or packet.time_base is None:
                continue
            time_s = packet.pts * packet.time_base
            if packet.stream.type == "video":
                times_s.add(time_s)
            elif packet.stream.type == "audio":
                sound.append((time_s, bytes(packet)))
    return _Contents(times_s, sound)
