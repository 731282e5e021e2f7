"""Conversion of frames to output images, whose steps overlap in threads."""

from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import TypeVar

import numpy as np

from stereoweave.matching.estimate import match
from stereoweave.matching.matcher import Matcher
from stereoweave.matching.options import MatchOptions
from stereoweave.stereo import Estimate
from stereoweave.system.ahead import ahead
from stereoweave.system.threads import thread_count
from stereoweave.video.carried_frames import EstimatedFrame, carry_depth
from stereoweave.video.frame_groups import MATCHED_EVERY, FrameGroup, FrameGrouper
from stereoweave.video.job import VideoJob
from stereoweave.video.reader import StereoFrame, format_time
from stereoweave.video.shot_alignment import ShotAligner
from stereoweave.video.squeezing import squeeze_job
from stereoweave.video.survey import Survey
from stereoweave.video.temporal_filter import TemporalFilter
from stereoweave.video.writer import Picture

_NAMED_PROBLEMS = 3
# Each step works on one group while the next one waits. More would only take memory.
_GROUPS_AHEAD, _ESTIMATES_AHEAD, _PICTURES_AHEAD = 1, MATCHED_EVERY, 2

Item = TypeVar("Item")


@dataclass
class VideoTally:
    """Counts of frames, cuts and frames with problems so far, and descriptions of the first problems.

    `frames_per_s` is the speed of the conversion since it was last started; 0 while it runs.
    """

    frames: int = 0
    cuts: int = 0
    problems: int = 0
    named: list[str] = field(default_factory=list)
    frames_per_s: float = 0.0

    def add(self, frame: StereoFrame) -> None:
        """Count a frame and its problem, if it has one."""
        self.frames += 1
        if frame.problem is not None:
            self.problems += 1
            if len(self.named) < _NAMED_PROBLEMS:
                self.named.append(f"{format_time(frame.time)} {frame.problem}")


def load_matcher(job: VideoJob) -> Matcher:
    """Load a job's network, with one thread fewer, because decoding, rendering and encoding run beside it."""
    return replace(job.backend, threads=max(thread_count(job.backend.threads) - 1, 1)).matcher()


class FrameConverter:
    """Converter from frames to output images, whose state can be saved and restored.

    Args:
        job: Settings of the conversion.
        survey: Disparities of the whole video.
        size_px: Width and height of the frames of one eye.

    Attributes:
        tally: Counts so far.
    """

    def __init__(self, job: VideoJob, survey: Survey, size_px: tuple[int, int]) -> None:
        self.survey, self.tally = survey, VideoTally()
        self._squeezed = squeeze_job(job, size_px)
        self._seen = self._squeezed.squeeze_survey(survey)
        self._options = MatchOptions(range_px=self._seen.match_range_px)
        self._threads = thread_count(job.backend.threads)
        self._matcher = load_matcher(job)
        self._filter = TemporalFilter(job.backend.threads)
        self._grouper = FrameGrouper(ShotAligner(swapped=survey.swapped) if job.rectify else None)

    @classmethod
    def from_state(
        cls, job: VideoJob, state: dict[str, np.ndarray], size_px: tuple[int, int]
    ) -> "FrameConverter":
        """Restore a converter from a saved `state`; its output is the same as without an interruption."""
        low_px, high_px, middle_px, *match_range_px = state.pop("survey_px").tolist()
        survey = Survey(
            (low_px, high_px), middle_px, (match_range_px[0], match_range_px[1]) if match_range_px else None
        )
        converter = cls(job, survey, size_px)
        frames, cuts, problems = state.pop("tally").tolist()
        converter.tally = VideoTally(frames, cuts, problems, state.pop("named").tolist())
        converter._filter = TemporalFilter.from_state(state, job.backend.threads)
        converter._grouper = FrameGrouper.from_state(state)
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
            **self._grouper.state(),
        }

    @property
    def has_warped(self) -> bool:
        """Whether any frame was rectified so far; then the camera that the video declares no longer holds."""
        return self._grouper.has_warped

    def convert(self, frames: Iterable[StereoFrame]) -> Generator[tuple[Fraction, Picture]]:
        """Yield the time in seconds and the output image of each frame.

        All frames are consumed before the iterator ends, so that `state` is complete.
        """
        groups = self._overlap(map(self._squeezed.squeeze, self._grouper(frames)), _GROUPS_AHEAD)
        matched = self._overlap(map(self._match, groups), _GROUPS_AHEAD)
        estimated = self._overlap(carry_depth(matched, self._filter, self._threads), _ESTIMATES_AHEAD)
        yield from self._overlap(map(self._render, estimated), _PICTURES_AHEAD)
        self.tally.cuts = self._filter.cuts

    def _match(self, group: FrameGroup) -> tuple[FrameGroup, Estimate]:
        return group, match(self._matcher, group.pairs[-1], self._options)

    def _render(self, estimated: EstimatedFrame) -> tuple[Fraction, Picture]:
        frame, pair, estimate = estimated
        self.tally.add(frame)
        job = self._squeezed.job
        if frame.fine:
            return frame.time, job.render_fine_frame(frame.fine(), estimate, self._seen)
        return frame.time, job.render_frame(pair, estimate, self._seen)

    def _overlap(self, items: Iterable[Item], count: int) -> Iterator[Item]:
        """Compute items ahead of their use, if more than one thread is allowed."""
        return ahead(items, count) if self._threads > 1 else iter(items)
