"""The command `stereoweave view`."""

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stereoweave.cli.commands import compile_ahead_for_views, running_options, shows_steps
from stereoweave.cli.options import (
    Format,
    Model,
    Pictures,
    Provider,
    Range,
    Rectify,
    Strength,
    Threads,
    make_parent_folder,
    make_request,
    parse_range_px,
)
from stereoweave.errors import StereoweaveError
from stereoweave.system.steps import step

if TYPE_CHECKING:
    from stereoweave.rendering.layouts import LayoutOptions
    from stereoweave.rendering.renderer import Renderer
    from stereoweave.stereo import View

_MIDDLE = 0.5


Out = Annotated[
    Path,
    typer.Option(
        "--out",
        "-o",
        help="File to write. Viewers recognise some layouts by a mark in the file name, which is added "
        "automatically: view.png becomes view_qs8x6a0.75.png for a quilt. .mpo and .jps are 3-D pictures.",
    ),
]
Position = Annotated[
    float | None,
    typer.Option(
        help="Viewpoint of a single view, from -1 to 2; 0 is the left camera and 1 the right one (default: "
        "0.5)."
    ),
]
Up = Annotated[float, typer.Option(help="Height of a single view's viewpoint in baselines, from -1 to 1.")]
Forward = Annotated[
    float, typer.Option(help="Forward shift of a single view's viewpoint in baselines, from -1 to 1.")
]
Layout = Annotated[
    str | None,
    typer.Option(
        help="Layout of several views in one picture: side_by_side, side_by_side_half, crossed, top_bottom, "
        "top_bottom_half, anaglyph_grey, anaglyph_colour, anaglyph_half_colour, anaglyph_dubois, rgbd, "
        "quilt or contact_sheet; or an animation, sweep or wiggle, as .mp4 (extra 'video'), .gif or .webp."
    ),
]
Convergence = Annotated[
    str | None,
    typer.Option(
        metavar="PX|auto",
        help="Disparity that stays in place in all views; auto is the scene's median disparity (default: "
        "auto for anaglyphs, quilts, contact sheets and animations, 0 for all others).",
    ),
]
Quilt = Annotated[
    str | None,
    typer.Option(metavar="COLUMNSxROWS", help="Columns and rows of views in a quilt (default: 8x6)."),
]
Calib = Annotated[
    Path | None,
    typer.Option(help="Calibration file, for --rectify, and for correct proportions of --up and --forward."),
]


@shows_steps
def view(  # noqa: PLR0913 - each is an option of the command line
    pictures: Pictures,
    out: Out,
    position: Position = None,
    up: Up = 0.0,
    forward: Forward = 0.0,
    layout: Layout = None,
    strength: Strength = 1.0,
    convergence: Convergence = None,
    quilt: Quilt = None,
    format: Format = None,
    calib: Calib = None,
    rectify: Rectify = False,
    range_px: Range = None,
    model: Model = "base",
    threads: Threads = None,
    provider: Provider = "cpu",
) -> None:
    """Render a new view of a stereo pair, or a layout of several.

    Layouts are for 3-D viewers and displays.
    """
    compile_ahead_for_views(True, model)
    from stereoweave.cameras.diagnosis import find_problems
    from stereoweave.cameras.rectify import crop
    from stereoweave.matching.backend import Backend
    from stereoweave.matching.estimate import match
    from stereoweave.matching.options import MatchOptions
    from stereoweave.pictures.prepare import prepare
    from stereoweave.rendering import layouts
    from stereoweave.rendering.renderer import Renderer, check_position

    name = layouts.choose_layout(out, layout)
    _check_unused(name, {"--position": position, "--up": up or None, "--forward": forward or None}, quilt)
    if strength != 1 or convergence is not None:
        _check_has_views(name)
    check_position(_MIDDLE, up=up, forward=forward)
    layout_options = _parse_quilt(quilt)
    positions, converged = _view_positions(name, _MIDDLE if position is None else position)
    layouts.check_positions(positions, strength)
    plane_px = _parse_convergence_px(("auto" if converged else "0") if convergence is None else convergence)
    options = MatchOptions(range_px=parse_range_px(range_px), refined=True)
    prepared = prepare(pictures, make_request(format, calib, rectify=rectify))
    pair = crop(prepared.pair)
    if name in layouts.LAYOUTS:
        out = layouts.add_mark(out, name, pair, layout_options)
    make_parent_folder(out)
    estimate = match(Backend(model=model, threads=threads, provider=provider).matcher(), pair, options)
    if plane_px is None:
        plane_px = layouts.median_disparity_px(estimate)
    renderer = Renderer(pair, estimate, strength=strength, convergence_px=plane_px, threads=threads)
    if name is None:
        written = _write_view(out, renderer.view(*positions, up=up, forward=forward), *positions)
    else:
        written = _write_layout(out, name, renderer, layout_options)
    typer.echo(f"{out}: {written}")
    for note in (*prepared.notes, *find_problems(pair, estimate)):
        typer.echo(note.format(running_options()))


def _check_unused(name: str | None, single_view: dict[str, float | None], quilt: str | None) -> None:
    """Raise a StereoweaveError for an option that the layout does not use."""
    given = [option for option, value in single_view.items() if value is not None]
    if name is not None and given:
        raise StereoweaveError(
            f"{given[0]}: expected only for a single view, found with the layout {name}, whose positions are "
            "fixed; widen them with --strength"
        )
    if name != "quilt" and quilt is not None:
        raise StereoweaveError(
            f"--quilt: expected only with --layout quilt, found with {name or 'a single view'}"
        )


def _check_has_views(name: str | None) -> None:
    """Raise a StereoweaveError if the layout has no views that strength and convergence could shift."""
    if name == "rgbd":
        raise StereoweaveError(
            "--strength, --convergence: expected only with a layout of several views, found with rgbd"
        )


def _parse_quilt(quilt: str | None) -> "LayoutOptions":
    from stereoweave.rendering.layouts import LayoutOptions

    if quilt is None:
        return LayoutOptions()
    match = re.fullmatch(r"(\d+)x(\d+)", quilt)
    if match is None:
        raise StereoweaveError(f"--quilt: expected columns and rows, such as 8x6, found {quilt!r}")
    return LayoutOptions(columns=int(match[1]), rows=int(match[2]))


def _view_positions(name: str | None, position: float) -> tuple[tuple[float, ...], bool]:
    """Return the positions of the views, and whether --convergence is auto by default."""
    from stereoweave.rendering.layouts import ANIMATIONS, LAYOUTS

    if name is None:
        return (position,), False
    shown = LAYOUTS[name] if name in LAYOUTS else ANIMATIONS[name]
    return shown.positions, shown.converged


def _parse_convergence_px(convergence: str) -> float | None:
    """Parse --convergence into a disparity in px; None for auto, which needs the estimate."""
    if convergence == "auto":
        return None
    try:
        plane_px = float(convergence)
    except ValueError:
        plane_px = math.nan
    if not math.isfinite(plane_px):
        raise StereoweaveError(f"--convergence: expected a disparity in px, or auto, found {convergence!r}")
    return plane_px


def _write_view(out: Path, view: "View", position: float) -> str:
    """Write one view, and return a description of it for the user."""
    from stereoweave.io.images import write_image

    write_image(out, view.image)
    return f"view at {position:g}, {100 * (~view.drawn).mean():.1f} % of it seen by neither camera"


@step("rendering views")
def _write_layout(out: Path, name: str, renderer: "Renderer", layout_options: "LayoutOptions") -> str:
    """Write several views in a layout, and return a description of the file for the user."""
    from stereoweave.io.animation import write_animation
    from stereoweave.rendering.layouts import ANIMATIONS, LAYOUTS, render_views, write_picture

    if name in LAYOUTS:
        picture = LAYOUTS[name].compose(renderer, layout_options)
        write_picture(out, picture)
        return f"{name}, {picture.shape[1]}x{picture.shape[0]} px"
    motion = ANIMATIONS[name]
    turns = motion.turns(out)
    write_animation(out, render_views(renderer, motion.positions * turns), motion.frame_ms)
    count = len(motion.positions) * turns
    return f"{name}, {count} frames in {count * motion.frame_ms / 1000:g} s"
