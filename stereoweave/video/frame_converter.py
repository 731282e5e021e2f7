"""Conversion of frames to output images, whose steps overlap in threads."""

from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass, field, replace
from fractions import Fraction
from itertools import chain
from typing import TypeVar

import numpy as np

from stereoweave.matching.estimate import match
from stereoweave.matching.matcher import Matcher
from stereoweave.matching.options import MatchOptions
from stereoweave.rendering.fine_layouts import to_16_bits
from stereoweave.rendering.layouts import Eye
from stereoweave.stereo import Estimate
from stereoweave.system.ahead import ahead
from stereoweave.system.threads import thread_count
from stereoweave.video.carried_frames import EstimatedFrame, carry_depth
from stereoweave.video.comfort_path import ComfortPath
from stereoweave.video.converted_frames import ConvertedFrame
from stereoweave.video.frame_groups import MATCHED_EVERY, FrameGroup, FrameGrouper
from stereoweave.video.frame_renderer import FrameRenderer
from stereoweave.video.job import VideoJob
from stereoweave.video.reader import StereoFrame
from stereoweave.video.shot_alignment import ShotAligner
from stereoweave.video.squeezing import squeeze_job
from stereoweave.video.survey import Survey
from stereoweave.video.temporal_filter import TemporalFilter
from stereoweave.video.times import format_frame_time
from stereoweave.video.writer import Picture

_NAMED_PROBLEMS = 3
# Each step works on one group while the next one waits. More would only take memory.
_GROUPS_AHEAD, _ESTIMATES_AHEAD, _PICTURES_AHEAD = 1, MATCHED_EVERY, 2

Item = TypeVar("Item")


@dataclass
class VideoTally:
    """Counts of frames, cuts and frames with problems so far, and descriptions of the first problems.

    `notes` are the notes on the whole video. `frames_per_s` is the speed of the conversion since it was last
    started; 0 while it runs. `comfort` says how the depth was fitted to the job's screen; it is set at the
    end, and by `FrameConverter.from_state`.
    """

    frames: int = 0
    cuts: int = 0
    problems: int = 0
    named: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    frames_per_s: float = 0.0
    comfort: str = ""

    def add(self, frame: StereoFrame) -> None:
        """Count a frame and its problem, if it has one."""
        self.frames += 1
        if frame.problem is not None:
            self.problems += 1
            if len(self.named) < _NAMED_PROBLEMS:
                self.named.append(f"{format_frame_time(frame.time)} {frame.problem}")


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
        self._size_px, self._squeezed = size_px, squeeze_job(job, size_px)
        self._seen = self._squeezed.squeeze_survey(survey)
        self._options = MatchOptions(range_px=self._seen.match_range_px)
        self._renderer = FrameRenderer(self._squeezed.job, self._seen)
        self._threads = thread_count(job.backend.threads)
        self._matcher = load_matcher(job)
        self._filter = TemporalFilter(job.backend.threads)
        self._grouper = FrameGrouper(ShotAligner(swapped=survey.swapped) if job.rectify else None)
        screen = self._squeezed.job.screen
        self._comfort = ComfortPath(screen) if screen else None

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
        converter.tally = VideoTally(
            frames, cuts, problems, state.pop("named").tolist(), state.pop("notes").tolist()
        )
        converter._filter = TemporalFilter.from_state(state, job.backend.threads)
        converter._grouper = FrameGrouper.from_state(state)
        screen = converter._squeezed.job.screen
        if screen:
            converter._comfort = ComfortPath.from_state(screen, state)
            # All frames may be converted already.
            converter.tally.comfort = converter._comfort.describe(size_px[0])
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
            "notes": np.array(tally.notes, dtype=np.str_),
            **self._filter.state(),
            **self._grouper.state(),
            **(self._comfort.state() if self._comfort else {}),
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
        # Whoever watches the conversion wants to see depth.
        join = None if self._squeezed.job.on_converted else self._squeezed.job.join
        converted = self._convert_depth(groups) if join is None else self._join_views(groups, join)
        yield from self._overlap(converted, _PICTURES_AHEAD)
        self.tally.cuts = self._grouper.cuts
        if self._comfort:
            self.tally.comfort = self._comfort.describe(self._size_px[0])

    def _convert_depth(self, groups: Iterator[FrameGroup]) -> Iterator[tuple[Fraction, Picture]]:
        matched = self._overlap(map(self._match, groups), _GROUPS_AHEAD)
        estimated = self._overlap(carry_depth(matched, self._filter, self._threads), _ESTIMATES_AHEAD)
        return map(self._render, estimated)

    def _join_views(
        self, groups: Iterator[FrameGroup], join: Callable[[Eye, Eye], Eye]
    ) -> Iterator[tuple[Fraction, Picture]]:
        """Yield output images that show the pictures of both cameras as they are, which needs no matching."""
        for frame, pair in chain.from_iterable(zip(*group, strict=True) for group in groups):
            self.tally.add(frame)
            self._grouper.began_shot(frame)  # or the grouper would remember all cuts
            joined = to_16_bits(join(*frame.fine())) if frame.fine else join(pair.left, pair.right)
            yield frame.time, joined

    def _match(self, group: FrameGroup) -> tuple[FrameGroup, Estimate]:
        return group, match(self._matcher, group.pairs[-1], self._options)

    def _render(self, estimated: EstimatedFrame) -> tuple[Fraction, Picture]:
        frame, pair, estimate = estimated
        self.tally.add(frame)
        begins = self._grouper.began_shot(frame)
        comfort = self._comfort(estimate, frame.time, begins_shot=begins) if self._comfort else None
        picture = self._renderer(pair, estimate, frame.fine and frame.fine(), comfort)
        if watch := self._squeezed.job.on_converted:
            watch(ConvertedFrame(frame, pair, estimate, picture, self._seen))
        return frame.time, picture

    def _overlap(self, items: Iterable[Item], count: int) -> Iterator[Item]:
        """Compute items ahead of their use, if more than one thread is allowed."""
        return ahead(items, count) if self._threads > 1 else iter(items)
