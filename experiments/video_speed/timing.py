"""Speed of `stereoweave video` on rendered videos."""

import resource
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from stereoweave.bench.flicker_videos import render_panning
from stereoweave.io.output_lock import lock_output
from stereoweave.matching.backend import Backend
from stereoweave.synth.sets.pair_rendering import RenderSpec
from stereoweave.video.convert import convert_video
from stereoweave.video.job import VideoJob
from stereoweave.video.layout_marks import PACKED
from stereoweave.video.reader import open_video
from stereoweave.video.writer import H264, Recorder

SIZES_PX = (640, 480), (1280, 720)
OUTPUTS: dict[str, dict[str, Any]] = {
    "depth": {"depth": True},
    "view": {"position": 0.5},
    "anaglyph_dubois": {"layout": "anaglyph_dubois"},
    "side_by_side_half": {"layout": "side_by_side_half"},
}
_RATE = Fraction(24)
# The camera moves for five seconds in one direction, as in `stereoweave bench flicker`, and then back.
_PATH_FRAMES = 120


@dataclass(frozen=True, kw_only=True)
class VideoSpeedRow:
    """Speed of one conversion, the fastest of several turns.

    Attributes:
        output: What the video was converted to.
        model: Name of the network.
        width_px, height_px: Size of a frame of one eye.
        frames: Number of frames.
        frames_per_s: Frames per second of the conversion, after the survey.
        survey_s: Time before the conversion, above all of the survey, and after it.
        processor_ms: Processor time per frame, including the survey. Unlike the others, it hardly depends on
            other work on the machine.
        turns: Number of conversions.
    """

    output: str
    model: str
    width_px: int
    height_px: int
    frames: int
    frames_per_s: float
    survey_s: float
    processor_ms: float
    turns: int


def measure_speeds(scene: str, frames: int, turns: int, model: str = "small") -> Iterator[VideoSpeedRow]:
    """Yield the speed of each conversion, with all cores."""
    with tempfile.TemporaryDirectory() as folder:
        for size_px in SIZES_PX:
            video = Path(folder) / f"{size_px[0]}.mp4"
            write_video(video, scene, size_px, frames)
            for output in OUTPUTS:
                yield max(
                    (_convert(video, output, model, turns) for _ in range(turns)),
                    key=lambda row: row.frames_per_s,
                )


def write_video(path: Path, scene: str, size_px: tuple[int, int], frames: int) -> None:
    """Write a rendered stereo video, side by side."""
    rendered = render_panning(
        RenderSpec(scene=scene, seed=0, size_px=size_px, frames=_PATH_FRAMES), min(frames, _PATH_FRAMES)
    )
    there = [np.hstack([pair.left, pair.right]) for pair in rendered.pairs]
    shown = islice(cycle([*there, *there[-2:0:-1]]), frames)
    recorder = Recorder(
        encoding=H264, time_base=1 / _RATE, rate=_RATE, packing=PACKED["side_by_side"].declared, threads=1
    )
    part = path.with_suffix(".nut")
    recorder.write_part(part, ((number / _RATE, picture) for number, picture in enumerate(shown)))
    with lock_output(path):
        recorder.join([part], None, path, {})
    part.unlink()


def _convert(source: Path, output: str, model: str, turns: int) -> VideoSpeedRow:
    """Convert a video once."""
    video = open_video([source])
    out = source.with_stem(f"{source.stem}_{output}")
    job = VideoJob(backend=Backend(model=model), **OUTPUTS[output])
    start_s, busy_s = time.perf_counter(), _processor_s()
    tally = convert_video(video, [source], out, job, Console(quiet=True))
    out.unlink()
    wall_s = time.perf_counter() - start_s
    return VideoSpeedRow(
        output=output,
        model=model,
        width_px=video.size_px[0],
        height_px=video.size_px[1],
        frames=tally.frames,
        frames_per_s=tally.frames_per_s,
        survey_s=max(wall_s - tally.frames / tally.frames_per_s, 0.0),
        processor_ms=1000 * (_processor_s() - busy_s) / tally.frames,
        turns=turns,
    )


def _processor_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime
