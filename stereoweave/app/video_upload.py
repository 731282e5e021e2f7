"""Conversion of an uploaded stereo video, or of some seconds of it, without the user interface."""

import io
import os
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console

from stereoweave.app.newest_frame import FrameShower, NewestFrame
from stereoweave.app.session import check_uploads
from stereoweave.app.video_outputs import OUTPUTS
from stereoweave.errors import FormatError, NameOf, StereoweaveError
from stereoweave.io.animation import require_video_extra
from stereoweave.io.decoding import open_picture
from stereoweave.matching.backend import Backend
from stereoweave.rendering.layouts import LayoutOptions, add_mark
from stereoweave.stereo import StereoPair
from stereoweave.system.progress import format_duration

if TYPE_CHECKING:
    from stereoweave.video.frame_converter import VideoTally
    from stereoweave.video.job import VideoJob
    from stereoweave.video.reader import StereoVideo

PREVIEW_S = 5
# FFmpeg's names of containers that refer to no other file.
_CONTAINERS = ("mp4", "matroska", "avi", "mpegts", "mpeg", "asf", "flv", "ogg")
# The share of the work that looks for the disparities of the whole video, before the conversion.
_SURVEY_SHARE = 0.15


@dataclass(frozen=True, kw_only=True)
class VideoUpload:
    """A visitor's uploaded video and settings.

    Attributes:
        files: One file with both views, or a left and a right one.
        format: Frame packing; None to detect it.
        output: What to make, a name in `OUTPUTS`.
        start_s: Where a preview of `PREVIEW_S` seconds begins; None to convert the whole video.
        backend: The network.
        name_of: The form's names for settings.
    """

    files: tuple[Path, ...]
    format: str | None
    output: str
    start_s: float | None
    backend: Backend
    name_of: NameOf


@dataclass(frozen=True)
class ConvertedVideo:
    """A converted video: its file, a line about it, notes on its views and colours, and warnings."""

    file: Path
    summary: str
    facts: list[str]
    warnings: list[str]


def keep_uploads(files: Iterable[Path]) -> None:
    """Keep uploads that are in use: the page removes files an hour after their last change.

    On Windows, an hour after their creation, which nothing changes.
    """
    for file in files:
        with suppress(FileNotFoundError):
            os.utime(file)


def convert_upload(upload: VideoUpload, folder: Path, report: Callable[[float, str], None]) -> ConvertedVideo:
    """Convert an uploaded video, or a part of it; the result and its `NewestFrame` are written to `folder`.

    Raises:
        StereoweaveError: See `open_upload` and `convert_video`.
    """
    video = open_upload(upload, report)
    from stereoweave.video.convert import convert_video

    whole_count = video.frame_count
    if upload.start_s is not None:
        video = video.excerpt(upload.start_s, PREVIEW_S)
    video.on_frame = _FrameReport(video.frame_count, report)
    # Beside the conversion, one thread is enough for a small picture.
    make_small = partial(make_job, replace(upload, backend=replace(upload.backend, threads=1)))
    shower = FrameShower(NewestFrame(folder), upload.output, make_small, upload.start_s or 0.0)
    job = replace(make_job(upload, upload.output), on_converted=shower)
    console = _NoteConsole()
    out = _name_file(upload, video, folder)
    tally = convert_video(video, upload.files, out, job, console)
    summary = _describe(upload, video)
    if upload.start_s is not None:
        whole_s = whole_count / tally.frames_per_s
        summary += f" A preview has no sound. The whole video takes about {format_duration(whole_s)}."
    facts = [note.format(upload.name_of) for note in video.notes]
    warnings = [line for line in console.lines if line not in facts]
    return ConvertedVideo(out, summary, facts, [*warnings, *_describe_problems(tally)])


def open_upload(upload: VideoUpload, report: Callable[[float, str], None]) -> "StereoVideo":
    """Open an uploaded video.

    Raises:
        StereoweaveError: See `open_video`; or there is no video, it has expired, or a setting does not fit.
    """
    _check_upload(upload)
    with require_video_extra("a video"):
        from stereoweave.video.reader import open_video
    report(0.0, "opening the video")
    return open_video(upload.files, upload.format)


def make_job(upload: VideoUpload, output: str) -> "VideoJob":
    """Return the job that makes an output, a name in `OUTPUTS`, of an uploaded video."""
    from stereoweave.video.job import VideoJob

    return VideoJob(**OUTPUTS[output].settings, backend=upload.backend, name_of=upload.name_of)


def _check_upload(upload: VideoUpload) -> None:
    """Raise a StereoweaveError if there is no video, it has expired, or a setting does not fit it."""
    if not upload.files:
        raise StereoweaveError(
            "expected a video with both views, or a left and a right video, found none; drop it on the form"
        )
    check_uploads(upload.files)
    if upload.format and len(upload.files) > 1:
        raise StereoweaveError(
            "expected one video that holds both views, found two videos; choose detected, or give one video",
            setting="format",
        )
    if upload.start_s is not None and not 0 <= upload.start_s < inf:
        raise StereoweaveError(
            f"expected a time from 0 s, the start, found {upload.start_s:g} s", setting="start_s"
        )
    for file in upload.files:
        _check_container(file)


def _check_container(file: Path) -> None:
    """Raise FormatError unless a video holds its own content.

    `open_container` accepts more: all containers but playlists and the like.
    """
    with require_video_extra("a video"):
        import av
    try:
        av.open(str(file), options={"format_whitelist": ",".join(_CONTAINERS)}).close()
    except av.error.FFmpegError as error:
        found = (
            "a picture; give it under “Pictures”"
            if _is_picture(file)
            else "another kind of file, or a damaged one; copy it again, or save it as MP4"
        )
        raise FormatError(
            f"{file.name}: expected a video (MP4, MOV, MKV, WebM, AVI, MPEG, WMV, FLV or OGG), found {found}"
        ) from error


def _is_picture(file: Path) -> bool:
    try:
        with open_picture(file):
            return True
    except FormatError:
        return False


class _FrameReport:
    """Report of the frames read: first those of the survey, then those of the conversion."""

    def __init__(self, count: int, report: Callable[[float, str], None]) -> None:
        self._count, self._report, self._passes, self._begin_s = count, report, 0, 0.0

    def __call__(self, number: int) -> None:
        if number == 0:
            self._passes, self._begin_s = self._passes + 1, time.monotonic()
        share = number / self._count
        if self._passes == 1:
            self._report(_SURVEY_SHARE * share, "looking through the video")
            return
        self._report(
            _SURVEY_SHARE + (1 - _SURVEY_SHARE) * share,
            f"frame {number + 1} of {self._count}{self._describe_speed(number)}",
        )

    def _describe_speed(self, number: int) -> str:
        """Describe the speed and the time left after this number of frames; nothing before the first."""
        if not number:
            return ""
        frames_per_s = number / max(time.monotonic() - self._begin_s, 1e-9)
        left = format_duration((self._count - number) / frames_per_s)
        return f", {frames_per_s:.1f} frames/s, about {left} left"


class _NoteConsole(Console):
    """Console that collects the printed lines and shows nothing."""

    def __init__(self) -> None:
        super().__init__(file=io.StringIO())
        self.lines: list[str] = []

    def print(self, *objects: Any, **_: Any) -> None:
        """Keep the lines; a progress bar is not one."""
        self.lines += [line for line in objects if isinstance(line, str)]


def _name_file(upload: VideoUpload, video: "StereoVideo", folder: Path) -> Path:
    """Return the file to write, whose name has the mark by which players recognise a layout."""
    kind = "" if upload.start_s is None else "_preview"
    file = folder / f"{upload.files[0].stem}_{upload.output}{kind}.mp4"
    layout = OUTPUTS[upload.output].settings.get("layout")
    if layout is None:
        return file
    blank = np.broadcast_to(np.uint8(0), (*reversed(video.size_px), 3))
    return add_mark(file, layout, StereoPair(left=blank, right=blank), LayoutOptions())


def _describe(upload: VideoUpload, video: "StereoVideo") -> str:
    """Describe a converted video in one line."""
    width, height = video.size_px
    frames = f"{video.frame_count} frames of {width}×{height} px, {float(video.length_s):.1f} s"
    packing = f", read as {video.frame_packing.replace('_', ' ')}" if video.frame_packing else ""
    return f"{OUTPUTS[upload.output].label}: {frames}{packing}. {OUTPUTS[upload.output].viewing}"


def _describe_problems(tally: "VideoTally") -> list[str]:
    if not tally.problems:
        return []
    more = "; ..." if tally.problems > len(tally.named) else ""
    return [f"problems in {tally.problems} of {tally.frames} frames: {'; '.join(tally.named)}{more}"]
