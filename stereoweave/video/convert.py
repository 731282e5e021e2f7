"""Conversion of a stereo video: matching, temporal filtering, and rendering of depth, a view or a layout."""

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import chain, islice
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress, TaskID

from stereoweave import __version__
from stereoweave.errors import StereoweaveError
from stereoweave.io.output_lock import lock_output
from stereoweave.matching.estimate import match
from stereoweave.matching.matcher import Matcher
from stereoweave.matching.options import MatchOptions
from stereoweave.stereo import StereoPair
from stereoweave.system.progress import progress
from stereoweave.system.threads import thread_count
from stereoweave.video.job import VideoJob
from stereoweave.video.parts import open_parts
from stereoweave.video.reader import StereoFrame, StereoVideo, format_time
from stereoweave.video.shot_alignment import ShotAligner
from stereoweave.video.survey import Survey, survey_video
from stereoweave.video.temporal_filter import TemporalFilter
from stereoweave.video.tracks import list_picture_files
from stereoweave.video.writer import GREY16, H264, Packing, Picture, Recorder, check_container

# Length of a part, which begins with a key frame. An interrupted run loses only the unfinished part.
_PART_S = 10
_NAMED_PROBLEMS = 3

PACKINGS = {
    "side_by_side": Packing("left_right", 3),
    "side_by_side_half": Packing("left_right", 3),
    "crossed": Packing("right_left", None),
    "top_bottom": Packing("top_bottom", 4),
    "top_bottom_half": Packing("top_bottom", 4),
}


@dataclass
class VideoTally:
    """Counts of frames, cuts and frames with problems so far, and descriptions of the first problems."""

    frames: int = 0
    cuts: int = 0
    problems: int = 0
    named: list[str] = field(default_factory=list)

    def add(self, frame: StereoFrame) -> None:
        """Count a frame and its problem, if it has one."""
        self.frames += 1
        if frame.problem is not None:
            self.problems += 1
            if len(self.named) < _NAMED_PROBLEMS:
                self.named.append(f"{format_time(frame.time)} {frame.problem}")


def convert_video(
    video: StereoVideo, sources: Sequence[Path], out: Path, job: VideoJob, console: Console
) -> VideoTally:
    """Convert a video and write the result.

    An interrupted conversion resumes after its last finished part.

    Args:
        video: The input video.
        sources: Input files; a conversion resumes only if they are unchanged.
        out: Output file; its extension selects the container.
        job: Settings of the conversion.
        console: Console for notes on the video and for progress.

    Returns:
        Counts for the whole conversion, including interrupted runs.

    Raises:
        StereoweaveError: `out` has an unsuitable extension, is in use, or cannot be written to, for example
            because the disk is full.
    """
    _check_output(out, job, video, sources)
    matcher = job.backend.matcher()
    recorder = Recorder(
        encoding=GREY16 if job.depth16 else H264,
        time_base=video.time_base,
        # FFmpeg stores numerators and denominators in 32 bits.
        rate=video.rate.limit_denominator(100_000),
        packing=PACKINGS.get(job.layout or ""),
        threads=thread_count(job.backend.threads),
    )
    with (
        lock_output(out),
        open_parts(out, _list_settings(job, video, sources), job.name_of_saved) as parts,
        progress(console) as bar,
    ):
        if parts.files:
            converter = _FrameConverter.from_state(job, matcher, parts.state())
        else:
            survey, notes = survey_video(video, matcher, bar, rectified=job.rectify)
            converter = _FrameConverter(job, matcher, survey)
            for note in [*notes, *job.find_losses(survey)]:
                line = note.format(job.name_of)
                console.print(line, markup=False, highlight=False, soft_wrap=True)
        done, total = converter.tally.frames, video.frame_count
        shown = bar.add_task(out.name, total=total, completed=done, loss="", rate="")
        frames = video.frames(done)
        for first in frames:
            part = islice(chain([first], frames), round(_PART_S * video.rate) or 1)
            with parts.next(converter.state) as path:
                recorder.write_part(path, converter.convert(part, bar, shown))
        recorder.join(parts.files, video.sound, out, job.describe_values(converter.survey))
    return converter.tally


class _FrameConverter:
    """Converter from frames to output images, whose state can be saved and restored."""

    def __init__(self, job: VideoJob, matcher: Matcher, survey: Survey) -> None:
        self.survey, self.tally = survey, VideoTally()
        self._options = MatchOptions(range_px=survey.match_range_px)
        self._job, self._matcher, self._filter = job, matcher, TemporalFilter(job.backend.threads)
        self._aligner = ShotAligner(swapped=survey.swapped)

    @classmethod
    def from_state(cls, job: VideoJob, matcher: Matcher, state: dict[str, np.ndarray]) -> "_FrameConverter":
        """Restore a converter from a saved `state`; its output is the same as without an interruption."""
        low_px, high_px, middle_px, *match_range_px = state.pop("survey_px").tolist()
        survey = Survey(
            (low_px, high_px), middle_px, (match_range_px[0], match_range_px[1]) if match_range_px else None
        )
        aligner = ShotAligner.from_state(state)
        converter = cls(job, matcher, survey)
        frames, cuts, problems = state.pop("tally").tolist()
        converter.tally = VideoTally(frames, cuts, problems, state.pop("named").tolist())
        converter._filter = TemporalFilter.from_state(state, job.backend.threads)
        converter._aligner = aligner
        return converter

    def state(self) -> dict[str, np.ndarray]:
        """Return everything that affects the output of later frames, as arrays by name."""
        tally = self.tally
        return {
            "survey_px": np.array(
                [*self.survey.range_px, self.survey.middle_px, *(self.survey.match_range_px or ())]
            ),
            "tally": np.array([tally.frames, tally.cuts, tally.problems]),
            "named": np.array(tally.named, dtype=np.str_),
            **self._filter.state(),
            **self._aligner.state(),
        }

    def convert(
        self, frames: Iterable[StereoFrame], bar: Progress, shown: TaskID
    ) -> Iterator[tuple[Fraction, Picture]]:
        """Yield the time in seconds and the output image of each frame, and update the progress bar."""
        for frame in frames:
            pair = self._align(StereoPair(left=frame.left, right=frame.right))
            estimate = match(self._matcher, pair, self._options)
            estimate = self._filter(pair.left, pair.right, estimate)
            self.tally.add(frame)
            self.tally.cuts = self._filter.cuts
            bar.update(shown, completed=self.tally.frames)
            yield frame.time, self._job.render_frame(pair, estimate, self.survey)

    def _align(self, pair: StereoPair) -> StereoPair:
        """Return the frame, rectified as its shot requires."""
        if not self._job.rectify:
            return pair
        aligned = self._aligner(pair)
        if not (self.tally.frames and self._filter.begins_shot(aligned.left)):
            return aligned
        self._aligner.begin_shot()
        return self._aligner(pair)


def _check_output(out: Path, job: VideoJob, video: StereoVideo, sources: Sequence[Path]) -> None:
    if job.depth16 and out.suffix.lower() != ".mkv":
        raise StereoweaveError(
            f"{out}: expected the file extension .mkv for 16-bit depth, found {out.suffix!r}"
        )
    for source in sources:
        if source.exists() and out.exists() and out.samefile(source):
            raise StereoweaveError(
                f"{out}: expected an output file other than the input, found the same file"
            )
    check_container(out, video.sound)


def _list_settings(job: VideoJob, video: StereoVideo, sources: Sequence[Path]) -> dict[str, object]:
    """Return the inputs and settings that determine the output on a given machine, as JSON values by name."""
    model = Path(job.backend.model)
    return {
        "depth": job.depth,
        "depth16": job.depth16,
        "position": job.position,
        "layout": job.layout,
        "strength": job.strength,
        "rectify": job.rectify,
        "convergence_px": job.convergence_px,
        "arrangement": video.frame_packing,
        "rate": str(video.rate),
        "model": _identify_source(model) if model.exists() else str(job.backend.model),
        "film": [_identify_source(source) for source in sources],
        "stereoweave": __version__,
    }


def _identify_source(path: Path) -> list[object]:
    """Return a path and a digest of the names, sizes and modification times of its files."""
    files = list_picture_files(path)
    digest = hashlib.sha256()
    for file in [path] if files is None else files:
        status = file.stat()
        digest.update(f"{file.name} {status.st_size} {status.st_mtime_ns}\n".encode(errors="surrogateescape"))
    return [str(path), digest.hexdigest()]
