"""Check of a whole stereo video, shot by shot: depth, defects, and the screens that show it well."""

import copy
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8
from rich.progress import Progress

from stereoweave.errors import Note
from stereoweave.matching.matcher import Matcher
from stereoweave.rendering.comfort import SCREENS, Depth, ScreenFit, find_screen, fit_depth
from stereoweave.system.ahead import ahead
from stereoweave.video.cuts import begins_shot, make_small_grey
from stereoweave.video.frame_check import FrameCheck, check_frame
from stereoweave.video.reader import StereoFrame, StereoVideo
from stereoweave.video.times import format_frame_time

# A shot's first frame may be part of a fade, so the first sample is this much later.
_FIRST_S, _EVERY_S = Fraction(1, 5), Fraction(1)
_MOST_SAMPLES = 240
_THUMBNAIL_PX = (160, 90)
_NAMED_SHOTS, _NAMED_PROBLEMS = 6, 3
_WORDS = {
    "too_plain": "too plain to be checked",
    "unrelated": "the eyes show different scenes",
    "stacked": "one eye is above the other",
    "same_picture": "flat: both eyes show the same picture",
    "swapped": "left and right are swapped",
    "vertical_shift": "the eyes' rows are apart",
    "rotation": "one eye is rotated",
    "scale": "one eye's picture is larger",
    "not_rectified": "the eyes' rows are unevenly apart",
    "exposure": "the eyes differ in exposure",
    "colour": "the eyes differ in colour",
    "empty_left": "the left eye is empty",
    "empty_right": "the right eye is empty",
    "too_deep": "more depth than the screen shows without strain",
    "cut_off": "near objects are cut off by the left or right border",
}


class _Sample(NamedTuple):
    """A frame to measure, and the number of the shot to which it belongs."""

    shot: int
    frame: StereoFrame


class _Span(NamedTuple):
    """Number of the first frame of a shot, its time, and its first picture as a thumbnail."""

    number: int
    time: Fraction
    thumbnail: UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True, kw_only=True)
class ShotCheck:
    """What a shot shows. A number is the median over its samples, and NaN if it could not be measured.

    Attributes:
        start_s, end_s: Time of the first frame, and of the end of the last one.
        frames: Number of frames.
        samples: The checked frames.
        thumbnail: A small picture of the left eye.
        depth: Nearest and farthest disparity of all samples, and the median one; None if unknown.
        width_px: Width of the eyes' pictures.
        screen: Name of the screen that will show the video as it is; None for any.
    """

    start_s: Fraction
    end_s: Fraction
    frames: int
    samples: tuple[FrameCheck, ...]
    thumbnail: UInt8[np.ndarray, "h w 3"]
    depth: Depth | None
    width_px: int
    screen: str | None = None

    def median(self, name: str) -> float:
        """Return the median of a number of the samples, by its name in `FrameCheck`."""
        known = [value for sample in self.samples if not math.isnan(value := getattr(sample, name))]
        return float(np.median(known)) if known else math.nan

    @property
    def range_percent(self) -> tuple[float, float]:
        """Parallax of the nearest and of the farthest points as shown, negative in front of the screen."""
        if self.depth is None:
            return math.nan, math.nan
        # Adding 0 turns -0.0 into 0.0.
        near, far = (-100 * px / self.width_px + 0.0 for px in self.depth[:2])
        return near, far

    @property
    def windows_px(self) -> tuple[float, float]:
        """Largest parallax that the left and the right border cut off in front of the screen."""
        left, right = (max(sides) for sides in zip(*(one.windows_px for one in self.samples), strict=True))
        return left, right

    def fit(self, screen: str) -> ScreenFit | None:
        """Return strength and convergence that fit the shot to a screen; None if its depth is unknown."""
        return self.depth and fit_depth(self.depth, self.width_px, SCREENS[screen])

    @property
    def comfortable(self) -> list[str]:
        """Names of the screens that show the shot as it is without strain."""
        if self.depth is None:
            return []
        as_it_is = partial(fit_depth, self.depth, self.width_px, strength=1.0, convergence_px=0.0)
        return [name for name, screen in SCREENS.items() if as_it_is(screen).fits]

    @property
    def defects(self) -> list[str]:
        """Defects of most samples, and those that the chosen screen has with the shot."""
        found = [name for sample in self.samples for name in sample.defects]
        names = [name for name in _WORDS if 2 * found.count(name) > len(self.samples)]
        if not names and self.depth is None:
            names.append("too_plain")
        if self.screen and self.depth and self.screen not in self.comfortable:
            names.append("too_deep")
        if self.screen and max(self.windows_px) > 0:
            names.append("cut_off")
        return names


@dataclass(frozen=True, kw_only=True)
class VideoCheck:
    """The shots of a checked video, and notes on it."""

    shots: tuple[ShotCheck, ...]
    notes: tuple[Note, ...]

    @property
    def defects(self) -> list[str]:
        """Defects of any shot. Plain shots, such as titles, count only if all are plain."""
        found = {name for shot in self.shots for name in shot.defects}
        if any(shot.depth for shot in self.shots):
            found.discard("too_plain")
        return [name for name in _WORDS if name in found]

    def lines(self) -> list[str]:
        """Return a line for each defect with the shots that have it, or one that says that there is none."""
        lines = []
        for name, words in _WORDS.items():
            numbers = [str(number) for number, shot in enumerate(self.shots, 1) if name in shot.defects]
            if numbers:
                more = "..." if len(numbers) > _NAMED_SHOTS else ""
                label = "shot" if len(numbers) == 1 else "shots"
                listed = ", ".join([*numbers[:_NAMED_SHOTS], *([more] if more else [])])
                which = "all shots" if len(numbers) == len(self.shots) > 1 else f"{label} {listed}"
                lines.append(f"{which}: {words}")
        return lines or ["no defects: the eyes agree in all shots"]


def check_video(
    video: StereoVideo, matcher: Matcher, bar: Progress, *, screen: str | None = None
) -> VideoCheck:
    """Check frames of all shots of a video, about one a second and at most about 240.

    Args:
        video: The video, which is decoded once.
        matcher: Matcher of the checked frames.
        bar: Shows progress.
        screen: Name of the screen that will show the video as it is; depth beyond its budget, and near
            objects that a border cuts off, are then defects.
    """
    if screen is not None:
        find_screen(screen)
    task = bar.add_task("checking the video", total=video.frame_count, loss="", rate="")
    video = copy.copy(video)  # the caller's keeps its own `on_frame`
    video.on_frame = lambda number: bar.update(task, completed=number + 1)
    spans: list[_Span] = []
    problems: list[str] = []
    found: dict[int, list[FrameCheck]] = {}
    for shot, frame in ahead(_take_samples(video, spans, problems), 1):
        found.setdefault(shot, []).append(check_frame(frame, matcher))
    ends = [(span.number, span.time) for span in spans[1:]]
    ends.append((video.frame_count, video.length_s))
    shots = [
        ShotCheck(
            start_s=span.time,
            end_s=max(end_s, span.time),
            frames=end - span.number,
            samples=tuple(found[number]),
            thumbnail=span.thumbnail,
            depth=_join_depths(found[number]),
            width_px=video.size_px[0],
            screen=screen,
        )
        for number, (span, (end, end_s)) in enumerate(zip(spans, ends, strict=True))
    ]
    return VideoCheck(shots=tuple(shots), notes=(*video.notes, *_note_problems(problems, video)))


def _take_samples(video: StereoVideo, spans: list[_Span], problems: list[str]) -> Iterator[_Sample]:
    """Yield the frames to measure, at least one of each shot; add shots and problems to the lists."""
    every_s = max(_EVERY_S, video.length_s / _MOST_SAMPLES)
    last_grey, due_s = None, Fraction(0)
    waiting: StereoFrame | None = None
    for number, frame in enumerate(video.frames()):
        if frame.problem is not None:
            problems.append(f"{format_frame_time(frame.time)} {frame.problem}")
        grey = make_small_grey(frame.left)
        if begins_shot(last_grey, grey):
            if waiting:
                yield _Sample(len(spans) - 1, waiting)
            spans.append(_Span(number, frame.time, _make_thumbnail(frame.left)))
            due_s, waiting = frame.time + _FIRST_S, frame
        last_grey = grey
        if frame.time >= due_s:
            yield _Sample(len(spans) - 1, frame)
            due_s, waiting = frame.time + every_s, None
        elif waiting:
            # If the shot ends before its first sample is due, its last frame is one.
            waiting = frame
    if waiting:
        yield _Sample(len(spans) - 1, waiting)


def _make_thumbnail(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    scale = min(1.0, *(most / side for most, side in zip(_THUMBNAIL_PX, image.shape[1::-1], strict=True)))
    size = tuple(max(1, round(scale * side)) for side in image.shape[1::-1])
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _join_depths(samples: Sequence[FrameCheck]) -> Depth | None:
    depths = [sample.depth for sample in samples if sample.depth]
    if not depths:
        return None
    return Depth(
        max(depth.near_px for depth in depths),
        min(depth.far_px for depth in depths),
        float(np.median([depth.middle_px for depth in depths])),
    )


def _note_problems(problems: Sequence[str], video: StereoVideo) -> list[Note]:
    if not problems:
        return []
    named = "; ".join(problems[:_NAMED_PROBLEMS]) + ("; ..." if len(problems) > _NAMED_PROBLEMS else "")
    return [Note(f"problems in {len(problems)} of {video.frame_count} frames: {named}")]
