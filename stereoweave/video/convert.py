"""Conversion of a stereo video: matching, temporal filtering, and rendering of depth, a view or a layout."""

import hashlib
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from fractions import Fraction
from itertools import chain, islice
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress

from stereoweave import __version__
from stereoweave.errors import Note, Remedy, StereoweaveError
from stereoweave.io.files import refuse_inputs
from stereoweave.io.output_lock import lock_output
from stereoweave.matching.edge_vote.vote import rehearse_voting
from stereoweave.pictures.panoramas import NO_SPHERE
from stereoweave.rendering.rehearsals import rehearse_drawing, rehearse_filling, rehearse_fine_drawing
from stereoweave.rendering.renderer import check_convergence_px
from stereoweave.stereo import StereoCamera
from stereoweave.system.compiling_ahead import Rehearsal, compile_ahead
from stereoweave.system.progress import progress
from stereoweave.system.threads import thread_count
from stereoweave.video.carried_frames import rehearse_carrying
from stereoweave.video.depth_codes import describe_values, find_losses
from stereoweave.video.frame_converter import FrameConverter, VideoTally, load_matcher
from stereoweave.video.job import VideoJob
from stereoweave.video.layout_marks import PACKED, find_baseline_m, mark_layout
from stereoweave.video.mp4_marks import VideoMarks
from stereoweave.video.parts import open_parts
from stereoweave.video.picture_track import list_picture_files
from stereoweave.video.reader import StereoVideo
from stereoweave.video.sphere_output import WholeOutput
from stereoweave.video.survey import survey_video
from stereoweave.video.times import PART_S, format_time
from stereoweave.video.writer import (
    BT709,
    DEPTH10,
    GREY16,
    H264,
    HEVC10,
    Colours,
    Encoding,
    Picture,
    Recorder,
    check_container,
)


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
        Counts and notes for the whole conversion, including interrupted runs.

    Raises:
        StereoweaveError: `out` has an unsuitable extension, is in use, or cannot be written to, for example
            because the disk is full.
    """
    _check_output(out, job, video, sources)
    job = fit_to_video(job, video)
    matcher = load_matcher(job)
    compile_ahead(*_list_rehearsals(job))
    if job.is_fine:
        video.read_fine()
    recorder = _make_recorder(job, video)
    recorder.check_size(*_measure_output_px(job, video.size_px))
    with (
        lock_output(out),
        open_parts(out, _list_settings(job, video, sources), job.name_of_saved) as parts,
        progress(console) as bar,
    ):
        if parts.files:
            converter = FrameConverter.from_state(job, parts.state(), video.size_px)
            done_s = converter.tally.frames / video.rate
            resumed = format_time(done_s, decimals=0, hours=True)
            _print_line(console, f"{out.name}: resuming at {resumed}")
        else:
            survey, notes = survey_video(
                video, matcher, bar, rectified=job.rectify, threads=job.backend.threads
            )
            converter = FrameConverter(job, survey, video.size_px)
            notes += [*_note_sound(video), *_note_aspect(job, video, out), *find_losses(job, survey)]
            converter.tally.notes = [note.format(job.name_of) for note in notes]
            for line in converter.tally.notes:
                _print_line(console, line)
        frames = video.frames(converter.tally.frames)
        opening = list(islice(frames, 1))  # may decode frames before it, which is no part of the speed
        meter = _Meter(bar, out.name, video, converter.tally.frames)
        for first in chain(opening, frames):
            part = islice(chain([first], frames), round(PART_S * video.rate) or 1)
            with parts.next(converter.state) as path, closing(converter.convert(part)) as pictures:
                recorder.write_part(path, map(meter.count, pictures))
        said = describe_values(job, converter.survey, video.camera, rectified=converter.has_warped)
        marks = _mark_output(job, video, warped=converter.has_warped)
        recorder.join(parts.files, video.sound, out, said, marks)
    return replace(converter.tally, frames_per_s=meter.frames_per_s)


def _make_recorder(job: VideoJob, video: StereoVideo) -> Recorder:
    return Recorder(
        encoding=_choose_encoding(job),
        time_base=video.time_base,
        # FFmpeg stores numerators and denominators in 32 bits.
        rate=video.rate.limit_denominator(100_000),
        packing=PACKED[job.layout].declared if job.layout in PACKED else None,
        colours=Colours(*video.own_colours) if job.is_fine and video.own_colours else BT709,
        pixel_aspect=video.pixel_aspect,
        threads=thread_count(job.backend.threads),
    )


def _measure_output_px(job: VideoJob, size_px: tuple[int, int]) -> tuple[int, int]:
    """Return the width and height of a view, or of a layout of both eyes' views."""
    if job.arrangement is None:
        return size_px
    row, column = np.zeros((1, size_px[0], 3), np.uint8), np.zeros((size_px[1], 1, 3), np.uint8)
    return job.arrangement(row, row).shape[1], job.arrangement(column, column).shape[0]


def _note_sound(video: StereoVideo) -> list[Note]:
    """Return a list with a note if sound is left out."""
    if not video.unknown_sounds:
        return []
    tracks = "1 sound track" if video.unknown_sounds == 1 else f"{video.unknown_sounds} sound tracks"
    return [Note(f"{tracks} left out, of a codec that FFmpeg does not know")]


def _note_aspect(job: VideoJob, video: StereoVideo, out: Path) -> list[Note]:
    """Return a list with a note if players will show the output as if its pixels were square."""
    if video.pixel_aspect == 1 or out.suffix.lower() != ".mkv" or job.layout not in PACKED:
        return []
    text = (
        f"the video has pixels {float(video.pixel_aspect):.3g} times as wide as high, which FFmpeg cannot "
        "write beside a frame packing in .mkv"
    )
    return [Note(text, Remedy("write .mp4 instead"))]


def _choose_encoding(job: VideoJob) -> Encoding:
    if job.depth16:
        return GREY16
    if job.depth10:
        return DEPTH10
    return H264 if job.bits == 8 else HEVC10


def _list_rehearsals(job: VideoJob) -> tuple[Rehearsal, ...]:
    """Return rehearsals of the kernels of a conversion; none if it only joins the frames of both cameras."""
    if job.join and not job.on_converted:
        return ()
    depth = rehearse_carrying, rehearse_voting
    if job.depth or job.depth10 or job.depth16:
        return depth
    return (*depth, rehearse_fine_drawing) if job.is_fine else (*depth, rehearse_drawing, rehearse_filling)


def fit_to_video(job: VideoJob, video: StereoVideo) -> VideoJob:
    """Return the job as it is for a calibrated video, or for what is shown of a VR180 or 360-degree video.

    Raises:
        StereoweaveError: The whole cannot be shown as the job says, or the convergence exceeds the width.
    """
    if job.convergence_px is not None and not (video.sphere and video.sphere.is_whole):
        check_convergence_px(job.convergence_px, video.size_px[0])
    if video.rig is not None:
        return replace(job, rectify=False)
    if video.sphere is None:
        return job
    # The homographies that rectify shots fit perspective images only.
    job = replace(job, rectify=job.rectify and video.sphere.is_flat)
    if not video.sphere.is_whole:
        return job
    if job.depth16 or job.depth10 or job.is_fine:
        raise StereoweaveError(
            "expected 8 bits for the whole field of view, found more",
            remedy=Remedy("leave them out", ("depth10", "depth16", "bits")),
        )
    return replace(job, whole=WholeOutput(video.sphere, job.layout))


def _mark_output(job: VideoJob, video: StereoVideo, *, warped: bool) -> VideoMarks | None:
    """Return what the output says about its views and cameras."""
    baseline_m = find_baseline_m(
        video.camera.baseline_m if video.camera else video.baseline_m,
        strength=job.strength,
        convergence_px=job.convergence_px or 0.0,
        fitted=job.screen is not None,
    )
    if job.whole is not None:
        return job.whole.marks(baseline_m)
    camera = (
        None if warped or (video.camera and not _is_centred(video.camera, video.size_px[0])) else video.camera
    )
    return mark_layout(job.layout, camera, video.size_px[0], baseline_m)


def _is_centred(camera: StereoCamera, width_px: int) -> bool:
    """Return whether marks can describe a camera: they tell neither another middle nor doffs."""
    return abs(2 * camera.cx_px + 1 - width_px) <= 1 and not camera.doffs_px


class _Meter:
    """Progress bar with the number of frames per second."""

    def __init__(self, bar: Progress, name: str, video: StereoVideo, done: int) -> None:
        self._bar, self._count, self._start_s = bar, 0, time.monotonic()
        self._task = bar.add_task(name, total=video.frame_count, completed=done, loss="", rate="")

    def count(self, picture: tuple[Fraction, Picture]) -> tuple[Fraction, Picture]:
        """Count a finished picture and return it."""
        self._count += 1
        self._bar.update(self._task, advance=1, rate=f"{self.frames_per_s:.1f} frames/s")
        return picture

    @property
    def frames_per_s(self) -> float:
        """Frames per second since the start."""
        return self._count / max(time.monotonic() - self._start_s, 1e-9)


def _print_line(console: Console, line: str) -> None:
    console.print(line, markup=False, highlight=False, soft_wrap=True)


def _check_output(out: Path, job: VideoJob, video: StereoVideo, sources: Sequence[Path]) -> None:
    if job.depth16 and out.suffix.lower() != ".mkv":
        raise StereoweaveError(
            f"{out}: expected the file extension .mkv for 16-bit depth, found {out.suffix or 'none'}"
        )
    refuse_inputs([out], sources)
    check_container(out, video.sound)


def _list_settings(job: VideoJob, video: StereoVideo, sources: Sequence[Path]) -> dict[str, object]:
    """Return the inputs and settings that determine the output on a given machine, as JSON values by name."""
    model = Path(job.backend.model)
    return {
        "depth": job.depth,
        "depth10": job.depth10,
        "depth16": job.depth16,
        "position": job.position,
        "layout": job.layout,
        "bits": job.bits,
        "strength": job.strength,
        "rectify": job.rectify,
        "convergence_px": job.convergence_px,
        "screen": job.screen and [job.screen.name, job.screen.strength, job.screen.convergence_px],
        "arrangement": video.frame_packing,
        "rate": str(video.rate),
        "preview": video.excerpted,
        "model": _identify_source(model) if model.exists() else str(job.backend.model),
        "film": [_identify_source(source) for source in sources],
        "stereoweave": __version__,
        "calibration": video.rig and [video.rig.digest()],
        **(video.sphere.settings if video.sphere else NO_SPHERE),
    }


def _identify_source(path: Path) -> list[object]:
    """Return a path and a digest of the names, sizes and modification times of its files."""
    files = list_picture_files(path)
    digest = hashlib.sha256()
    for file in [path] if files is None else files:
        status = file.stat()
        digest.update(f"{file.name} {status.st_size} {status.st_mtime_ns}\n".encode(errors="surrogateescape"))
    return [str(path), digest.hexdigest()]
