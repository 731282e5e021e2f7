"""Output of `stereoweave check` for a stereo video: tables of its shots, JSON, and the timeline picture."""

import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from stereoweave.cli.commands import running_options
from stereoweave.cli.options import make_parent_folder
from stereoweave.errors import FormatError, StereoweaveError

if TYPE_CHECKING:
    from stereoweave.video.reader import StereoVideo
    from stereoweave.video.video_check import ShotCheck, VideoCheck

_DEPTH = ("shot", "from", "to", "disparity px", "% of width", "cut off px", "suits")
_DIFFERENCES = ("shot", "rows px", "turned deg", "larger %", "exposure", "colour", "defects")
_UNKNOWN = "–"


def is_video(error: FormatError) -> bool:
    """Return whether a picture could not be opened because it is a video."""
    return error.remedy is not None and "video" in error.remedy.settings


def print_video_check(
    video: "StereoVideo", sources: Sequence[Path], screen: str | None, timeline: Path | None, as_json: bool
) -> None:
    """Check a stereo video and print what its shots show; the exit status is 1 if there is a defect.

    `sources` are what the video was opened from; their names are the title of the timeline.
    """
    from rich.console import Console

    from stereoweave.io.animation import require_video_extra
    from stereoweave.io.files import refuse_inputs
    from stereoweave.io.images import picture_kind, write_image
    from stereoweave.matching.backend import Backend
    from stereoweave.rendering.comfort import find_screen
    from stereoweave.system.progress import progress
    from stereoweave.video.picture_track import list_picture_files

    if screen is not None:
        find_screen(screen)
    if timeline is not None:
        picture_kind(timeline)
        make_parent_folder(timeline)
        files = [file for source in sources for file in list_picture_files(source) or [source]]
        refuse_inputs([timeline], files, "timeline")
    with require_video_extra("a video"):
        from stereoweave.video.timeline import draw_timeline
        from stereoweave.video.video_check import check_video
    with progress(Console(stderr=True)) as bar:
        found = check_video(video, Backend(model="small").matcher(), bar, screen=screen)
    if timeline is not None:
        name = ", ".join(source.name for source in sources)
        write_image(timeline, draw_timeline(found, name, screen))
    if as_json:
        typer.echo(json.dumps(_list_facts(found, video.size_px), indent=2, allow_nan=False))
    else:
        _print_tables(found)
        notes = [note.format(running_options()) for note in found.notes]
        typer.echo("\n".join([*notes, *found.lines(), *_advise(found, timeline)]))
    if found.defects:
        raise typer.Exit(1)


def _advise(found: "VideoCheck", timeline: Path | None) -> list[str]:
    """Return lines on what can be done about the depth, and on the picture."""
    from stereoweave.rendering.comfort import SCREENS

    lines = []
    if any(shot.depth and len(shot.comfortable) < len(SCREENS) for shot in found.shots):
        lines.append("stereoweave video --screen NAME fits the depth to a screen, with floating windows")
    return [*lines, *([] if timeline is None else [f"{timeline}: the timeline"])]


def refuse_video_options(screen: str | None, timeline: Path | None) -> None:
    """Raise a StereoweaveError for an option of videos that is given with pictures."""
    for option, value in (("--screen", screen), ("--timeline", timeline)):
        if value is not None:
            raise StereoweaveError(f"{option}: expected only with a video, found with pictures")


def _print_tables(found: "VideoCheck") -> None:
    """Print two tables, because a single one would be wider than a terminal."""
    shots = list(enumerate(found.shots, 1))
    _print_table(
        "Depth as shown; negative percents are in front of the screen", _DEPTH, map(_list_depth, shots)
    )
    title = "The right eye against the left one; exposure and colour in stops"
    _print_table(title, _DIFFERENCES, map(_list_differences, shots))


def _print_table(title: str, headings: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Column, Table

    *numbers, last = headings
    columns = [Column(name, justify="right", no_wrap=True) for name in numbers]
    table = Table(*columns, Column(last, overflow="fold"), title=title, box=SIMPLE, padding=(0, 2, 0, 0))
    for row in rows:
        table.add_row(*row)
    Console().print(table, markup=False)


def _list_depth(numbered: "tuple[int, ShotCheck]") -> list[str]:
    from stereoweave.video.times import format_time

    number, shot = numbered
    times = format_time(shot.start_s), format_time(shot.end_s)
    if shot.depth is None:
        return [str(number), *times, _UNKNOWN, _UNKNOWN, _UNKNOWN, _UNKNOWN]
    near_percent, far_percent = shot.range_percent
    return [
        str(number),
        *times,
        f"{shot.depth.far_px:z.1f} to {shot.depth.near_px:z.1f}",
        f"{near_percent:+z.1f} to {far_percent:+z.1f}",
        "{:.0f} | {:.0f}".format(*shot.windows_px),
        ", ".join(shot.comfortable) or "none",
    ]


def _list_differences(numbered: "tuple[int, ShotCheck]") -> list[str]:
    from stereoweave.video.timeline import shorten

    number, shot = numbered
    formats = {
        "rows_px": ".2f",
        "rotation_degrees": "+z.2f",
        "larger_percent": "+z.1f",
        "exposure_stops": "+z.2f",
        "colour_stops": ".2f",
    }
    numbers = [_format_number(shot.median(name), form) for name, form in formats.items()]
    return [str(number), *numbers, shorten(shot.defects) or "none"]


def _format_number(value: float, form: str) -> str:
    return _UNKNOWN if math.isnan(value) else format(value, form)


def _list_facts(found: "VideoCheck", size_px: tuple[int, int]) -> dict[str, object]:
    """Return all results as JSON values."""
    return {
        "width_px": size_px[0],
        "height_px": size_px[1],
        "shots": [_list_shot(shot) for shot in found.shots],
        "defects": found.defects,
        "notes": [*(note.format(running_options()) for note in found.notes), *found.lines()],
    }


def _list_shot(shot: "ShotCheck") -> dict[str, object]:
    from stereoweave.rendering.comfort import SCREENS

    near_percent, far_percent = shot.range_percent
    facts: dict[str, object] = {
        "start_s": round(float(shot.start_s), 6),
        "end_s": round(float(shot.end_s), 6),
        "frames": shot.frames,
        "samples": len(shot.samples),
        "disparity_px": shot.depth and [shot.depth.far_px, shot.depth.near_px],
        "percent_of_width": None if shot.depth is None else [near_percent, far_percent],
        "windows_px": shot.windows_px,
    }
    names = ("rows_px", "shift_px", "rotation_degrees", "larger_percent", "exposure_stops", "colour_stops")
    for name in names:
        value = shot.median(name)
        facts[name] = None if math.isnan(value) else value
    facts["screens"] = {name: _list_screen(shot, name) for name in SCREENS}
    facts["defects"] = shot.defects
    return facts


def _list_screen(shot: "ShotCheck", name: str) -> dict[str, object] | None:
    """Return whether a screen shows a shot without strain, and what would make it do so."""
    fit = shot.fit(name)
    if fit is None:
        return None
    return {
        "comfortable": name in shot.comfortable,
        "strength": fit.strength,
        "convergence_px": fit.convergence_px,
    }
