"""Shared by the tests of the command `video`: conversions that are interrupted, and what they wrote."""

import signal
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from video_examples import Pair, write_side_by_side

from stereoweave.cli.root import main
from stereoweave.video.reader import StereoFrame, StereoVideo

# A part lasts 4 s, so it has 5 of these frames.
SLOW_MS = 800


def run(video: Path, out: Path, *words: str) -> int:
    """Run the command on a video, and return its exit status."""
    # With two threads, the second would busy-wait on a core that other tests need.
    return main(["video", str(video), "-o", str(out), "--threads", "1", *words])


def write_slow_video(path: Path, pairs: list[Pair]) -> Path:
    """Write a video of which five frames are a part."""
    times_ms = range(0, len(pairs) * SLOW_MS, SLOW_MS)
    return write_side_by_side(path, pairs, times_ms=times_ms, codec="libx264")


def interrupt(patch: pytest.MonkeyPatch) -> None:
    """Let the reader raise the signal of Ctrl-C at frame 8, once a part is finished."""
    read = StereoVideo.frames

    def frames(video: StereoVideo, start: int = 0) -> Iterator[StereoFrame]:
        for index, frame in enumerate(read(video, start), start):
            if index == 8 and any(Path(video.name).parent.glob("*.parts/*.nut")):
                signal.raise_signal(signal.SIGINT)
            yield frame

    patch.setattr(StereoVideo, "frames", frames)


def frames_of(video: Path, format: str | None = None) -> list[np.ndarray]:
    """Return the frames as they are stored, or in a pixel format."""
    with av.open(str(video)) as container:
        return [frame.to_ndarray(format=format) for frame in container.decode(video=0)]


def times_of(video: Path) -> list[Fraction]:
    """Return the times of the frames in seconds."""
    with av.open(str(video)) as container:
        return [frame.pts * frame.time_base for frame in container.decode(video=0)]
