"""The newest frame of a video under conversion: small pictures of it, which its process hands to the page."""

import base64
import json
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import UInt8

from stereoweave.app.video_outputs import OUTPUTS
from stereoweave.io.files import replacing
from stereoweave.rendering.scaling import fit_size, scale_down
from stereoweave.video.times import format_time

if TYPE_CHECKING:
    from stereoweave.video.converted_frames import ConvertedFrame
    from stereoweave.video.job import VideoJob
    from stereoweave.video.survey import Survey

_LONGER_SIDE_PX = 640
_JPEG_QUALITY = 80
# The left view's width if another output than the conversion's is rendered, which takes the longest.
_RENDERED_PX = 448
# Pictures follow each other after this time, and later if they would take more than this share of the time;
# on two cores, 5 % of both.
_LEAST_S, _MOST_SHARE = 0.25, 0.1
_MOST_S = 1e9  # no video is as long


@dataclass(frozen=True)
class FramePictures:
    """Small pictures of a converted frame.

    Attributes:
        time_s: The frame's time since the start of the video, in seconds.
        output: What the frame was converted to, a name in `OUTPUTS`.
        left: The left view as read, a JPEG.
        made: The output image, a JPEG.
    """

    time_s: float
    output: str
    left: bytes
    made: bytes

    @property
    def shown_time(self) -> str:
        """The time in minutes and seconds, such as 1:02.5 for 62.5 s."""
        return format_time(self.time_s)


def make_pictures(
    converted: "ConvertedFrame",
    output: str,
    job: "VideoJob | None" = None,
    *,
    begin_s: float = 0.0,
    longer_side_px: int = _LONGER_SIDE_PX,
) -> FramePictures:
    """Make small pictures of a converted frame.

    Args:
        converted: The frame.
        output: What to show, a name in `OUTPUTS`.
        job: The job that renders this output; None if the frame was converted to it.
        begin_s: Time at which the converted part of the video begins, in seconds.
        longer_side_px: The longer side of each picture.
    """
    fitted = longer_side_px, longer_side_px
    picture = converted.picture if job is None else _render_small(converted, job)
    time_s = begin_s + float(converted.frame.time)
    return FramePictures(time_s, output, _encode(converted.frame.left, fitted), _encode(picture, fitted))


class NewestFrame:
    """The newest converted frame, in files of a folder that a conversion and the page share.

    Args:
        folder: A folder that nothing else uses, but for the video that is written there.
    """

    def __init__(self, folder: Path) -> None:
        self._file, self._wish = folder / "newest.json", folder / "wish.txt"
        self._seen: tuple[int, int] | None = None

    def ask(self, output: str) -> None:
        """Ask for pictures of another output, from the next frame on."""
        with replacing(self._wish) as file:
            file.write_text(output, encoding="utf-8")

    def asked(self) -> str | None:
        """Return the output that was asked for last; None if none was."""
        try:
            return self._wish.read_text(encoding="utf-8")
        except OSError:
            return None

    def write(self, pictures: FramePictures) -> None:
        """Replace the newest frame. Raises a StereoweaveError if its file cannot be written."""
        left, made = (base64.b64encode(jpeg).decode() for jpeg in (pictures.left, pictures.made))
        with replacing(self._file) as file:
            file.write_text(json.dumps([pictures.time_s, pictures.output, left, made]), encoding="utf-8")

    def read(self) -> FramePictures | None:
        """Return the newest frame; None if it was read before, and before the first one."""
        try:
            status = self._file.stat()
            # Two frames may have one time, because the clock of a file system is coarse, but not one inode.
            written = status.st_mtime_ns, status.st_ino
            if written == self._seen:
                return None
            self._seen = written
            time_s, output, left, made = json.loads(self._file.read_text(encoding="utf-8"))
            if output not in OUTPUTS or not 0 <= time_s < _MOST_S:
                return None
            return FramePictures(time_s, output, base64.b64decode(left), base64.b64decode(made))
        # A decoder that a file made crash may have written anything.
        except (OSError, ValueError, TypeError, RecursionError):
            return None


class FrameShower:
    """Function for `VideoJob.on_converted` that shows frames now and then, at little cost.

    No error ends the conversion: a frame that cannot be shown is left out.

    Args:
        newest: Where to show them.
        output: What the video is converted to.
        make_job: Function that returns the job for another output.
        begin_s: Time at which the converted part of the video begins, in seconds.
    """

    def __init__(
        self,
        newest: NewestFrame,
        output: str,
        make_job: "Callable[[str], VideoJob]",
        begin_s: float = 0.0,
    ) -> None:
        self._newest, self._output, self._make_job = newest, output, make_job
        self._begin_s, self._next_s = begin_s, 0.0

    def __call__(self, converted: "ConvertedFrame") -> None:
        """Show a frame, unless another one was shown just before."""
        if time.monotonic() < self._next_s:
            return
        begin_s = time.monotonic()
        with suppress(Exception):
            self._show(converted)
        end_s = time.monotonic()
        # Not the processor's time, because threads of the renderer draw.
        self._next_s = end_s + max(_LEAST_S, (end_s - begin_s) / _MOST_SHARE)

    def _show(self, converted: "ConvertedFrame") -> None:
        output = self._newest.asked() or self._output
        job = None if output == self._output else self._make_job(output)
        self._newest.write(make_pictures(converted, output, job, begin_s=self._begin_s))


def _render_small(converted: "ConvertedFrame", job: "VideoJob") -> UInt8[np.ndarray, "h w 3"]:
    """Render an output of a frame scaled down, whose pair regains the proportions that it was read with."""
    from stereoweave.video.frame_renderer import FrameRenderer  # it loads PyAV

    size_px = fit_size(converted.frame.left.shape, (_RENDERED_PX, _RENDERED_PX))
    scale = size_px[0] / converted.pair.left.shape[1]
    pair, estimate = scale_down(converted.pair, converted.estimate, size_px)
    return FrameRenderer(job, _scale_survey(converted.survey, scale))(pair, estimate)


def _scale_survey(survey: "Survey", scale: float) -> "Survey":
    low_px, high_px = survey.range_px
    return survey._replace(range_px=(scale * low_px, scale * high_px), middle_px=scale * survey.middle_px)


def _encode(picture: UInt8[np.ndarray, "h w 3"], fitted: tuple[int, int]) -> bytes:
    """Encode an RGB image as a small JPEG."""
    small = cv2.resize(picture, fit_size(picture.shape, fitted), interpolation=cv2.INTER_AREA)
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), quality)
    return jpeg.tobytes()
