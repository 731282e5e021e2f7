"""One frame of an uploaded video, converted to see what a conversion would make; no user interface."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from math import floor
from typing import TYPE_CHECKING

from rich.progress import Progress

from stereoweave.app.newest_frame import FramePictures, make_pictures
from stereoweave.app.video_upload import VideoUpload, make_job, open_upload

if TYPE_CHECKING:
    from stereoweave.video.converted_frames import ConvertedFrame

# Larger than the frames of a conversion, for which they must not cost much.
_LONGER_SIDE_PX = 960
_STEPS_PER_S = 10


@dataclass(frozen=True)
class StillFrame:
    """A converted frame of a video.

    Attributes:
        pictures: Small pictures of the frame.
        last_s: Time of the video's last frame in seconds, rounded down to a tenth.
        facts: Notes on its views and colours, in the form's words.
        warnings: What is wrong with the frame, likewise.
    """

    pictures: FramePictures
    last_s: float
    facts: list[str]
    warnings: list[str]


def convert_still(upload: VideoUpload, report: Callable[[float, str], None]) -> StillFrame:
    """Convert the frame at `start_s` of an uploaded video; the colours of its depth are those of its range.

    Raises:
        StereoweaveError: See `open_upload`; or the video ends before this time.
    """
    video = open_upload(upload, report)
    from stereoweave.video.convert import fit_to_video
    from stereoweave.video.frame_converter import FrameConverter, load_matcher
    from stereoweave.video.survey import survey_video

    start_s, frame_s = upload.start_s or 0.0, 1 / video.rate
    still = video.excerpt(start_s, 0.0)  # of one frame
    report(0.3, "converting one frame")
    seen: list[ConvertedFrame] = []
    job = replace(fit_to_video(make_job(upload, upload.output), still), on_converted=seen.append)
    survey, notes = survey_video(
        still, load_matcher(job), Progress(disable=True), rectified=job.rectify, threads=1
    )
    with closing(FrameConverter(job, survey, still.size_px).convert(still.frames())) as converted:
        list(converted)
    last_s = float(video.length_s - frame_s)
    return StillFrame(
        make_pictures(seen[0], upload.output, begin_s=start_s, longer_side_px=_LONGER_SIDE_PX),
        floor(last_s * _STEPS_PER_S) / _STEPS_PER_S,
        [note.format(job.name_of) for note in still.notes],
        [note.format(job.name_of) for note in notes if note not in still.notes],
    )
