"""The command `stereoweave video`."""

from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stereoweave.cli.commands import running_options, shows_steps
from stereoweave.cli.options import (
    Fov,
    LensFov,
    Look,
    OldFormat,
    Projection,
    Provider,
    Screen,
    Strength,
    Threads,
    Whole,
    make_parent_folder,
    make_screen_choice,
    make_sphere_request,
    replace_old_option,
)
from stereoweave.errors import StereoweaveError
from stereoweave.video.times import PART_S

if TYPE_CHECKING:
    from stereoweave.video.frame_converter import VideoTally
    from stereoweave.video.job import VideoJob
    from stereoweave.video.reader import StereoVideo

_HIGHEST_RATE = 1000


Videos = Annotated[
    list[Path],
    typer.Argument(
        metavar="VIDEO",
        help="Stereo video with both views in each frame, in two streams or in turn, spatial video "
        "(MV-HEVC), or LEFT RIGHT. Each is a video file, a folder of pictures, or a quoted pattern such as "
        "'left/*.png' or left/%03d.png.",
    ),
]
Out = Annotated[
    Path,
    typer.Option(
        "--out",
        "-o",
        help="Video to write: .mp4, .mov or .mkv. Players recognise some layouts by a mark in the file name, "
        "which is added automatically: out.mp4 becomes out_TBF_fulltb.mp4 for top_bottom. Rerun the same "
        f"command to resume after an interruption, which loses at most {PART_S} s of video.",
    ),
]
Depth = Annotated[
    bool,
    typer.Option(
        "--depth", help="Write the left view's disparity in colour, with one range for the whole video."
    ),
]
Depth10 = Annotated[
    bool,
    typer.Option(
        "--depth10",
        help="Write the left view's disparity as 10-bit grey (HEVC), linear over the whole video's range.",
    ),
]
Depth16 = Annotated[
    bool,
    typer.Option(
        "--depth16", help="Write the left view's disparity * 256 as lossless 16-bit grey, to an .mkv file."
    ),
]
Position = Annotated[
    float | None,
    typer.Option(
        help="Write the view from this position, from -1 to 2; 0 is the left camera and 1 the right one."
    ),
]
Layout = Annotated[
    str | None,
    typer.Option(
        help="Write a layout of `stereoweave view`, such as anaglyph_dubois or quilt, but not sweep, wiggle "
        "or viewer."
    ),
]
Bits = Annotated[
    int,
    typer.Option(
        metavar="8|10",
        help="Bits of each colour of a view or a layout: 8 (H.264), or 10 (HEVC), which keeps HDR in views, "
        "and in layouts with one view for each eye.",
    ),
]
Convergence = Annotated[
    float | None,
    typer.Option(
        metavar="PX",
        help="Disparity that stays in place in all views (default: the video's median disparity for "
        "anaglyphs, quilts and contact sheets, 0 for all others).",
    ),
]
Format = Annotated[
    str | None,
    typer.Option(
        "--format",
        help="Frame packing, such as side_by_side, top_bottom_half, crossed or frame_sequential (default: "
        "detected). An unknown name lists them all.",
    ),
]
Rate = Annotated[
    str | None,
    typer.Option(
        metavar="FPS",
        help="Frames per second of a picture sequence, such as 24 or 30000/1001 (default: 25).",
    ),
]


Preview = Annotated[
    str | None,
    typer.Option(
        metavar="SECONDS",
        help="Convert only this much from the middle of the video, such as 5s, without sound, to a file with "
        "_preview in its name, and report how long the whole video would take.",
    ),
]
VideoModel = Annotated[
    str,
    typer.Option(
        help="Shipped network: small, or base, which is slower; or an .onnx matcher file. best, made for "
        "stills, is much slower still."
    ),
]


VideoCalib = Annotated[
    Path | None,
    typer.Option(
        help="Calibration file in OpenCV, Kalibr, KITTI or Middlebury format, for metres; all frames are "
        "rectified by it and cropped to what both cameras see."
    ),
]
RectifyShots = Annotated[
    bool,
    typer.Option(
        "--rectify/--no-rectify",
        help="Rectify the shots whose rows are apart, and swap left and right back if they are swapped.",
    ),
]


@shows_steps
def video(  # noqa: PLR0913 - each is an option of the command line
    videos: Videos,
    out: Out,
    depth: Depth = False,
    depth10: Depth10 = False,
    depth16: Depth16 = False,
    position: Position = None,
    layout: Layout = None,
    bits: Bits = 8,
    strength: Strength = None,
    screen: Screen = None,
    convergence: Convergence = None,
    format: Format = None,
    rate: Rate = None,
    rectify: RectifyShots = True,
    calib: VideoCalib = None,
    projection: Projection = None,
    look: Look = None,
    fov: Fov = None,
    lens_fov: LensFov = None,
    whole: Whole = False,
    preview: Preview = None,
    model: VideoModel = "small",
    threads: Threads = None,
    provider: Provider = "cpu",
    arrangement: OldFormat = None,
) -> None:
    """Convert a stereo video to depth, a new view or a layout. Sound and frame times are kept."""
    from stereoweave.io.animation import require_video_extra
    from stereoweave.matching.backend import Backend
    from stereoweave.video.reader import open_video

    with require_video_extra("a video"):
        from stereoweave.video.calibration import rectify_by
        from stereoweave.video.job import VideoJob

    format = replace_old_option(("--arrangement", arrangement), ("--format", format))
    job = VideoJob(
        depth=depth,
        depth10=depth10,
        depth16=depth16,
        position=position,
        layout=layout,
        bits=bits,
        strength=1.0 if strength is None else strength,
        convergence_px=convergence,
        screen=make_screen_choice(screen, strength, convergence),
        rectify=rectify,
        backend=Backend(model=model, threads=threads, provider=provider),
        name_of=running_options(),
    )
    length_s = None if preview is None else _parse_length_s(preview)
    source = open_video(
        videos,
        format,
        rate=None if rate is None else _parse_rate(rate),
        sphere=make_sphere_request(projection, look, fov, lens_fov, whole),
    )
    _convert(rectify_by(source, calib, rectify=rectify), videos, out, job, length_s)


def _convert(
    video: "StereoVideo", sources: list[Path], out: Path, job: "VideoJob", length_s: float | None
) -> None:
    """Convert a video, or this much from its middle, and print what was done."""
    from rich.console import Console

    from stereoweave.io.animation import require_video_extra
    from stereoweave.system.progress import format_duration

    with require_video_extra("a video"):
        from stereoweave.video.convert import convert_video

    whole_count = video.frame_count
    if length_s is not None:
        video = _cut_from_middle(video, length_s)
        out = out.with_stem(f"{out.stem}_preview")  # keeps a converted video
    if job.layout:
        out = _add_mark(out, job.layout, video.size_px)
    with _saying_stopped(out):
        make_parent_folder(out)
        tally = convert_video(video, sources, out, job, Console(stderr=True))
    _print_tally(out, tally)
    if length_s is not None and tally.frames_per_s:
        typer.echo(f"the whole video takes about {format_duration(whole_count / tally.frames_per_s)}")


def _parse_rate(rate: str) -> Fraction:
    """Parse --rate into frames per second; accepts numbers such as 24, 23.976 and 30000/1001."""
    try:
        # Both terms of FFmpeg's fractions have 32 bits.
        fraction = Fraction(rate).limit_denominator(100_000)
    except (ValueError, ZeroDivisionError):
        fraction = Fraction(0)
    if not 0 < fraction <= _HIGHEST_RATE:
        raise StereoweaveError(
            f"--rate: expected frames per second above 0 and at most {_HIGHEST_RATE}, such as 24 or "
            f"30000/1001, found {rate!r}"
        )
    return fraction


def _parse_length_s(preview: str) -> float:
    """Parse --preview into seconds; accepts numbers such as 5, 5s and 2.5s."""
    try:
        length_s = float(preview.removesuffix("s"))
    except ValueError:
        length_s = 0.0
    if not 0 < length_s < float("inf"):
        raise StereoweaveError(f"--preview: expected seconds above 0, such as 5s, found {preview!r}")
    return length_s


def _cut_from_middle(video: "StereoVideo", length_s: float) -> "StereoVideo":
    """Return a part of this length from the middle of the video, whose start may be a title."""
    return video.excerpt(max(0.0, (float(video.length_s) - length_s) / 2), length_s)


def _add_mark(out: Path, layout: str, size_px: tuple[int, int]) -> Path:
    """Return the file name with the mark by which viewers recognise the layout."""
    import numpy as np

    from stereoweave.rendering.layouts import LayoutOptions, add_mark
    from stereoweave.stereo import StereoPair

    blank = np.broadcast_to(np.uint8(0), (*reversed(size_px), 3))
    return add_mark(out, layout, StereoPair(left=blank, right=blank), LayoutOptions())


@contextmanager
def _saying_stopped(out: Path) -> Iterator[None]:
    """Say what is left of an output whose making is stopped, and how to go on."""
    try:
        yield
    except KeyboardInterrupt:
        from stereoweave.video.parts import parts_folder

        state = f"no part of {PART_S} s was finished; the same command starts from the beginning"
        if parts_folder(out).exists():
            state = f"finished parts are in {parts_folder(out)}; rerun the same command to resume"
        typer.echo(f"stereoweave: {out}: stopped; {state}", err=True)
        raise typer.Exit(130) from None


def _print_tally(out: Path, tally: "VideoTally") -> None:
    cuts = {0: "", 1: ", 1 cut"}.get(tally.cuts, f", {tally.cuts} cuts")
    frames = "1 frame" if tally.frames == 1 else f"{tally.frames} frames"
    typer.echo(f"{out}: {frames}{cuts}")
    if tally.comfort:
        typer.echo(tally.comfort)
    if tally.problems:
        more = "; ..." if tally.problems > len(tally.named) else ""
        typer.echo(f"problems in {tally.problems} of {frames}: {'; '.join(tally.named)}{more}")
