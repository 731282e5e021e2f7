"""Conversion of a stereo video, frame by frame: match, filter over time, show as depth, view or layout."""

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from itertools import chain, islice
from math import isfinite
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt16
from rich.console import Console
from rich.progress import Progress, TaskID

from stereoweave import __version__
from stereoweave.cameras.alignment import SWAPPED
from stereoweave.cameras.diagnosis import find_problems
from stereoweave.errors import NameOf, Note, Remedy, StereoweaveError, keyword
from stereoweave.io.colormap import colour_disparity, find_colour_range_px
from stereoweave.io.output_lock import lock_output
from stereoweave.matching.backend import Backend
from stereoweave.matching.estimate import match
from stereoweave.matching.matcher import Matcher
from stereoweave.matching.options import MatchOptions
from stereoweave.pictures.pair_layouts import PAIR_LAYOUTS
from stereoweave.rendering.layouts import LAYOUTS, LayoutOptions, check_positions, median_disparity_px
from stereoweave.rendering.renderer import Renderer
from stereoweave.stereo import Estimate, StereoPair
from stereoweave.system.progress import progress
from stereoweave.system.threads import thread_count
from stereoweave.video.reader import StereoFrame, StereoVideo
from stereoweave.video.temporal_filter import TemporalFilter
from stereoweave.video.tracks import list_picture_files
from stereoweave.video.writer import GREY16, H264, Packing, Picture, Recorder, check_container, open_parts

# Length of a part. An interrupted run loses the unfinished one; each begins with a key frame.
_PART_S = 10
_SURVEYED_FRAMES, _CHECKED_FRAMES = 24, 3
_SURVEY_STEP_PX = 4
# Outliers do not widen the range; the margin allows for objects that come nearer between the surveyed frames.
_OUTER_PERCENT, _MARGIN_PX = 0.5, 8.0
_NAMED_PROBLEMS = 3
_STEPS_PER_PX, _MOST_GREY16_PX = 256, 255.99

# Keys of the saved settings that are not settings, and their names in errors.
_SAVED_FACTS = {"film": "video", "stereoweave": "stereoweave"}

PACKINGS = {
    "side_by_side": Packing("left_right", 3),
    "side_by_side_half": Packing("left_right", 3),
    "crossed": Packing("right_left", None),
    "top_bottom": Packing("top_bottom", 4),
    "top_bottom_half": Packing("top_bottom", 4),
}


@dataclass(frozen=True, kw_only=True)
class VideoJob:
    """Settings of a conversion; exactly one of depth, depth16, position and layout is set.

    Attributes:
        depth: Left disparity in colours, with one range for the whole video.
        depth16: Left disparity as 16-bit grey, px * 256 as in disparity.png; clipped to 1/256 to 255.99 px.
        position: View from this position: 0 is the left camera, 1 the right one.
        layout: A name in `LAYOUTS`.
        strength: Multiplies the baseline.
        convergence_px: Disparity that stays in place from view to view. Default: the scene's median disparity
            for layouts that overlay their views, else 0.
        backend: Matches the frames.
        name_of: The front end's names for settings, used in notes.
    """

    depth: bool = False
    depth16: bool = False
    position: float | None = None
    layout: str | None = None
    strength: float = 1.0
    convergence_px: float | None = None
    backend: Backend = Backend()
    name_of: NameOf = keyword

    def __post_init__(self) -> None:
        kinds = {
            "depth": self.depth,
            "depth16": self.depth16,
            "position": self.position is not None,
            "layout": self.layout is not None,
        }
        given = [kind for kind, is_given in kinds.items() if is_given]
        if len(given) != 1:
            raise StereoweaveError(
                f"expected one kind of video to make, found {' and '.join(given) or 'none'}",
                remedy=Remedy("choose one", tuple(kinds)),
            )
        if self.layout not in (None, *LAYOUTS):
            raise StereoweaveError(
                f"expected one of {', '.join(LAYOUTS)}, found {self.layout!r}", setting="layout"
            )
        self._check_numbers(given[0] if self.layout is None else f"layout {self.layout}")
        check_positions(self._positions, self.strength)

    def _check_numbers(self, kind: str) -> None:
        """Raise if a number is not finite, or has no effect on this kind of video."""
        numbers = {"strength": (self.strength, 1.0), "convergence_px": (self.convergence_px, None)}
        for setting, (value, unset) in numbers.items():
            if value == unset or value is None:
                continue
            if not isfinite(value):
                raise StereoweaveError(f"expected a finite number, found {value}", setting=setting)
            if not self._positions:
                raise StereoweaveError(
                    f"expected a view or a layout of views for it, found {kind}", setting=setting
                )

    @property
    def _positions(self) -> tuple[float, ...]:
        if self.layout:
            return LAYOUTS[self.layout].positions
        return () if self.position is None else (self.position,)

    def render_frame(self, pair: StereoPair, estimate: Estimate, survey: "Survey") -> Picture:
        """Make the output image of one frame."""
        if self.depth:
            return colour_disparity(estimate.disparity_px, survey.range_px)
        if self.depth16:
            return _encode_grey16(estimate.disparity_px)
        renderer = Renderer(
            pair,
            estimate,
            strength=self.strength,
            convergence_px=self._find_plane_px(survey),
            threads=self.backend.threads,
        )
        if self.position is not None:
            return renderer.view(self.position).image
        return LAYOUTS[str(self.layout)].compose(renderer, LayoutOptions(range_px=survey.range_px))

    def _find_plane_px(self, survey: "Survey") -> float:
        """Return the disparity that stays in place from view to view."""
        if self.convergence_px is not None:
            return self.convergence_px
        return survey.middle_px if self.layout and LAYOUTS[self.layout].converged else 0.0

    def name_of_saved(self, key: str) -> str:
        """Return the front end's name for a key of the saved settings."""
        if key in _SAVED_FACTS:
            return _SAVED_FACTS[key]
        setting = "format" if key == "arrangement" else key
        return self.name_of(setting) or setting

    def find_losses(self, survey: "Survey") -> list[Note]:
        """Return a note if the file cannot hold all of the video's disparities."""
        low_px, high_px = survey.range_px
        if not self.depth16 or (low_px >= 0 and high_px <= _MOST_GREY16_PX):
            return []
        text = (
            f"16-bit grey holds 0 to {_MOST_GREY16_PX} px: this video's disparities, {low_px:.1f} to "
            f"{high_px:.1f} px, are clipped"
        )
        return [Note(text, Remedy("show all of them in colours", ("depth",)))]

    def describe_values(self, survey: "Survey") -> dict[str, str]:
        """Return the file's metadata: how to convert its pictures back to disparities."""
        low_px, high_px = survey.range_px
        if self.depth16:
            return {"comment": f"16-bit grey: disparity of the left view in pixels = value / {_STEPS_PER_PX}"}
        if self.depth:
            return {
                "comment": f"disparity of the left view: {low_px:.2f} px is blue, {high_px:.2f} px is red"
            }
        if self.layout == "rgbd":
            return {"comment": f"disparity in grey: {low_px:.2f} px is black, {high_px:.2f} px is white"}
        return {}


class Survey(NamedTuple):
    """Disparities measured in frames from all over the video.

    Attributes:
        range_px: Disparity range of the colours.
        middle_px: Median disparity of the scene.
        match_range_px: Disparity range to match; None if the network's own range covers the surveyed frames.
    """

    range_px: tuple[float, float]
    middle_px: float
    match_range_px: tuple[float, float] | None


@dataclass
class VideoTally:
    """Counts of frames, cuts and frames with a problem; `named` describes the first problems."""

    frames: int = 0
    cuts: int = 0
    problems: int = 0
    named: list[str] = field(default_factory=list)

    def add(self, frame: StereoFrame) -> None:
        """Count a frame."""
        self.frames += 1
        if frame.problem is not None:
            self.problems += 1
            if len(self.named) < _NAMED_PROBLEMS:
                self.named.append(f"{_format_time(frame.time)} {frame.problem}")


def convert_video(
    video: StereoVideo, sources: Sequence[Path], out: Path, job: VideoJob, console: Console
) -> VideoTally:
    """Convert a video and write it; an interrupted conversion resumes after its last finished part.

    Args:
        video: The input video.
        sources: The input's files; a conversion resumes only if they are unchanged.
        out: The file to write; its ending chooses the container.
        job: Settings of the conversion.
        console: Shows notes on the video, then progress.

    Returns:
        Counts over all runs of this conversion.

    Raises:
        StereoweaveError: `out` has an unsuitable ending, is in use, or cannot be written, for instance on a
            full disk.
    """
    _check_output(out, job, video, sources)
    matcher = job.backend.matcher()
    recorder = Recorder(
        encoding=GREY16 if job.depth16 else H264,
        time_base=video.time_base,
        # FFmpeg's fractions have 32 bits.
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
            survey, notes = _survey_video(video, matcher, bar)
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
    """Makes the output image of each frame; its state can be saved and restored."""

    def __init__(self, job: VideoJob, matcher: Matcher, survey: Survey) -> None:
        self.survey, self.tally = survey, VideoTally()
        self._options = MatchOptions(range_px=survey.match_range_px)
        self._job, self._matcher, self._filter = job, matcher, TemporalFilter(job.backend.threads)

    @classmethod
    def from_state(cls, job: VideoJob, matcher: Matcher, state: dict[str, np.ndarray]) -> "_FrameConverter":
        """Restore a converter from its `state`; it continues exactly as the original would have."""
        low_px, high_px, middle_px, *match_range_px = state.pop("survey_px").tolist()
        survey = Survey(
            (low_px, high_px), middle_px, (match_range_px[0], match_range_px[1]) if match_range_px else None
        )
        converter = cls(job, matcher, survey)
        frames, cuts, problems = state.pop("tally").tolist()
        converter.tally = VideoTally(frames, cuts, problems, state.pop("named").tolist())
        converter._filter = TemporalFilter.from_state(state, job.backend.threads)
        return converter

    def state(self) -> dict[str, np.ndarray]:
        """Return everything that the next frame's output depends on, as arrays."""
        tally = self.tally
        return {
            "survey_px": np.array(
                [*self.survey.range_px, self.survey.middle_px, *(self.survey.match_range_px or ())]
            ),
            "tally": np.array([tally.frames, tally.cuts, tally.problems]),
            "named": np.array(tally.named, dtype=np.str_),
            **self._filter.state(),
        }

    def convert(
        self, frames: Iterable[StereoFrame], bar: Progress, shown: TaskID
    ) -> Iterator[tuple[Fraction, Picture]]:
        """Yield each frame's time and output image; updates the progress bar."""
        for frame in frames:
            pair = StereoPair(left=frame.left, right=frame.right)
            estimate = match(self._matcher, pair, self._options)
            estimate = self._filter(frame.left, frame.right, estimate)
            self.tally.add(frame)
            self.tally.cuts = self._filter.cuts
            bar.update(shown, completed=self.tally.frames)
            yield frame.time, self._job.render_frame(pair, estimate, self.survey)


def _survey_video(video: StereoVideo, matcher: Matcher, bar: Progress) -> tuple[Survey, list[Note]]:
    """Survey the disparities of frames spread over the whole video, and find defects.

    The frames are spread because the first ones may be titles, which have another range.
    """
    picked = _spread_evenly(video.frame_count, _SURVEYED_FRAMES)
    checked = set(picked[len(picked) // 6 :: -(-len(picked) // _CHECKED_FRAMES)])
    shown = bar.add_task("surveying depth", total=len(picked), loss="", rate="")
    thinned, middles_px, defects = [], [], []
    frames = islice(video.frames(), picked.start, picked.stop, picked.step)
    for index, frame in zip(picked, frames, strict=True):
        pair = StereoPair(left=frame.left, right=frame.right)
        estimate = match(matcher, pair)
        thinned.append(estimate.disparity_px[::_SURVEY_STEP_PX, ::_SURVEY_STEP_PX])
        middles_px.append(median_disparity_px(estimate))
        if index in checked:
            defects.append([_add_time(frame.time, note, video) for note in find_problems(pair, estimate)])
        bar.advance(shown)
    all_px = np.vstack(thinned)
    survey = Survey(
        find_colour_range_px(all_px), float(np.median(middles_px)), _find_match_range_px(all_px, matcher)
    )
    return survey, _select_common_notes(defects)


def _find_match_range_px(
    disparity_px: Float[np.ndarray, "h w"], matcher: Matcher
) -> tuple[float, float] | None:
    """Return the disparity range of surveyed disparities; None if the network's own range covers it."""
    low_px, high_px = np.percentile(disparity_px, [_OUTER_PERCENT, 100 - _OUTER_PERCENT]).tolist()
    if low_px >= 0 and high_px <= matcher.max_disparity_px:
        return None
    # A plain sky is matched at the lower end of the range: for parallel cameras that stays at 0.
    return min(low_px, max(low_px - _MARGIN_PX, 0.0)), high_px + _MARGIN_PX


def _spread_evenly(count: int, wanted: int) -> range:
    """Return the numbers of at most `wanted` frames, evenly spread over `count`."""
    step = -(-count // wanted)
    return range(step // 2, count, step)


def _add_time(time: Fraction, note: Note, video: StereoVideo) -> Note:
    """Add the time to a note; for swapped views in one file, the remedy becomes the other frame packing."""
    other = _find_swapped_packing(video.frame_packing)
    if note == SWAPPED and other:
        note = replace(note, remedy=Remedy(f"choose {other}", ("format",)))
    return replace(note, text=f"{_format_time(time)} {note.text}")


def _select_common_notes(defects: Sequence[list[Note]]) -> list[Note]:
    """Return the notes on the last frame that has any, if at least half do: a video may begin black."""
    some = [notes for notes in defects if notes]
    return some[-1] if 2 * len(some) > len(defects) else []


def _find_swapped_packing(frame_packing: str | None) -> str | None:
    """Return the named frame packing with the eyes swapped, if any."""
    if frame_packing is None:
        return None
    split = PAIR_LAYOUTS[frame_packing]
    other = split._replace(right_first=not split.right_first)
    return next((name for name, known in PAIR_LAYOUTS.items() if known == other), None)


def _encode_grey16(disparity_px: Float[np.ndarray, "h w"]) -> UInt16[np.ndarray, "h w"]:
    # 0 would mean unknown, as in disparity.png.
    return np.clip(np.rint(_STEPS_PER_PX * disparity_px), 1, 65535).astype(np.uint16)


def _check_output(out: Path, job: VideoJob, video: StereoVideo, sources: Sequence[Path]) -> None:
    if job.depth16 and out.suffix.lower() != ".mkv":
        raise StereoweaveError(f"{out}: expected the ending .mkv for depth in 16 bits, found {out.suffix!r}")
    for source in sources:
        if source.exists() and out.exists() and out.samefile(source):
            raise StereoweaveError(f"{out}: expected another file than the input video")
    check_container(out, video.sound)


def _list_settings(job: VideoJob, video: StereoVideo, sources: Sequence[Path]) -> dict[str, object]:
    """Return everything that determines the video except the machine, by setting, as JSON values."""
    model = Path(job.backend.model)
    return {
        "depth": job.depth,
        "depth16": job.depth16,
        "position": job.position,
        "layout": job.layout,
        "strength": job.strength,
        "convergence_px": job.convergence_px,
        "arrangement": video.frame_packing,
        "rate": str(video.rate),
        "model": _identify_source(model) if model.exists() else str(job.backend.model),
        "film": [_identify_source(source) for source in sources],
        "stereoweave": __version__,
    }


def _identify_source(path: Path) -> list[object]:
    """Return a path's name, and a digest of its files' names, sizes and modification times."""
    files = list_picture_files(path)
    digest = hashlib.sha256()
    for file in [path] if files is None else files:
        status = file.stat()
        digest.update(f"{file.name} {status.st_size} {status.st_mtime_ns}\n".encode(errors="surrogateescape"))
    return [str(path), digest.hexdigest()]


def _format_time(time_s: Fraction) -> str:
    """Format a time: 0:01:02.345 for 62.345 s."""
    minutes, seconds = divmod(float(time_s), 60)
    return f"{int(minutes) // 60}:{int(minutes) % 60:02}:{seconds:06.3f}"
