"""The command stereoweave view."""

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

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
    option_name,
    range_of,
    request_of,
)
from stereoweave.errors import StereoweaveError

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
        help="The file to write. A layout that viewers know by a mark in the name gets it: "
        "view.png becomes view_qs8x6a0.75.png for a quilt. .mpo and .jps are 3-D pictures.",
    ),
]
Position = Annotated[
    float | None,
    typer.Option(
        help="The viewpoint of a single view: 0 is the left camera, 1 the right; -1 to 2. [default: 0.5]"
    ),
]
Up = Annotated[float, typer.Option(help="Raises the viewpoint of a single view, in baselines; -1 to 1.")]
Forward = Annotated[
    float, typer.Option(help="Moves the viewpoint of a single view forward, in baselines; -1 to 1.")
]
Layout = Annotated[
    str | None,
    typer.Option(
        help="Several views in one: side_by_side, side_by_side_half, crossed, top_bottom, "
        "top_bottom_half, anaglyph_grey, anaglyph_colour, anaglyph_half_colour, anaglyph_dubois, rgbd, "
        "quilt, contact_sheet; or moving, as .mp4 (extra 'video'), .gif or .webp: sweep, wiggle."
    ),
]
Convergence = Annotated[
    str | None,
    typer.Option(
        metavar="PX|auto",
        help="The disparity that stays in place from view to view; auto is that of the scene's middle. "
        "[default: 0 for a single view and where each eye has a picture of its own, auto else]",
    ),
]
Quilt = Annotated[
    str | None, typer.Option(metavar="COLUMNSxROWS", help="The views of a quilt. [default: 8x6]")
]
Calib = Annotated[
    Path | None,
    typer.Option(help="The cameras' calibration, for --rectify, and --up and --forward in true proportion."),
]


def view(  # noqa: PLR0913 - each is a word of the command line
    pictures: Pictures,
    out: Out,
    position: Position = None,
    up: Up = 0.0,
    forward: Forward = 0.0,
    layout: Layout = None,
    strength: Strength = 1.0,
    convergence: Convergence = None,
    quilt: Quilt = None,
    arrangement: Format = None,
    calib: Calib = None,
    rectify: Rectify = False,
    range_px: Range = None,
    model: Model = "base",
    threads: Threads = None,
    provider: Provider = "cpu",
) -> None:
    """A new view of a stereo pair, or many, as 3-D viewers and displays take them."""
    from stereoweave.cameras.diagnosis import find_problems
    from stereoweave.cameras.rectify import crop
    from stereoweave.matching.backend import Backend
    from stereoweave.matching.estimate import match
    from stereoweave.matching.options import MatchOptions
    from stereoweave.pictures.prepare import prepare
    from stereoweave.rendering.layouts import (
        LAYOUTS,
        add_mark,
        check_positions,
        choose_layout,
        median_disparity_px,
    )
    from stereoweave.rendering.renderer import Renderer, check_position

    name = choose_layout(out, layout)
    _refuse_idle(name, {"--position": position, "--up": up or None, "--forward": forward or None}, quilt)
    if name == "rgbd" and (strength != 1 or convergence is not None):
        raise StereoweaveError("--strength, --convergence: expected with several views, found with rgbd")
    check_position(_MIDDLE, up=up, forward=forward)
    choices = _choices(quilt)
    positions, converged = _needs(name, _MIDDLE if position is None else position)
    check_positions(positions, strength)
    plane_px = _plane_px(("auto" if converged else "0") if convergence is None else convergence)
    options = MatchOptions(range_px=range_of(range_px), refined=True)
    prepared = prepare(pictures, request_of(arrangement, calib, rectify=rectify))
    pair = crop(prepared.pair)
    if name in LAYOUTS:
        out = add_mark(out, name, pair, choices)
    make_parent_folder(out)
    estimate = match(Backend(model=model, threads=threads, provider=provider).matcher(), pair, options)
    if plane_px is None:
        plane_px = median_disparity_px(estimate)
    renderer = Renderer(pair, estimate, strength=strength, convergence_px=plane_px, threads=threads)
    if name is None:
        told = _write_view(out, renderer.view(*positions, up=up, forward=forward), *positions)
    else:
        told = _write_layout(out, name, renderer, choices)
    typer.echo(f"{out}: {told}")
    for note in (*prepared.notes, *find_problems(pair, estimate)):
        typer.echo(note.worded(option_name))


def _refuse_idle(name: str | None, of_one_view: dict[str, float | None], quilt: str | None) -> None:
    """An error for an option that the layout would not heed."""
    given = [option for option, value in of_one_view.items() if value is not None]
    if name is not None and given:
        raise StereoweaveError(
            f"{given[0]}: expected for a single view, found with the layout {name}, which has its own; "
            "--strength widens them"
        )
    if name != "quilt" and quilt is not None:
        raise StereoweaveError(f"--quilt: expected with --layout quilt, found with {name or 'a single view'}")


def _choices(quilt: str | None) -> "LayoutOptions":
    from stereoweave.rendering.layouts import LayoutOptions

    if quilt is None:
        return LayoutOptions()
    match = re.fullmatch(r"(\d+)x(\d+)", quilt)
    if match is None:
        raise StereoweaveError(f"--quilt: expected columns and rows, such as 8x6, found {quilt!r}")
    return LayoutOptions(columns=int(match[1]), rows=int(match[2]))


def _needs(name: str | None, position: float) -> tuple[tuple[float, ...], bool]:
    """Where the views are seen from, and whether the scene's middle should stay in place."""
    from stereoweave.rendering.layouts import ANIMATIONS, LAYOUTS

    if name is None:
        return (position,), False
    shown = LAYOUTS[name] if name in LAYOUTS else ANIMATIONS[name]
    return shown.positions, shown.converged


def _plane_px(convergence: str) -> float | None:
    """The disparity that stays in place; None for that of the scene's middle, which the estimate tells."""
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
    """What was written into the file, in words."""
    from stereoweave.io.files import write_image

    write_image(out, view.image)
    return f"view at {position:g}, {100 * (~view.drawn).mean():.1f} % of it seen by neither camera"


def _write_layout(out: Path, name: str, renderer: "Renderer", choices: "LayoutOptions") -> str:
    """What was written into the file, in words."""
    from stereoweave.io.animation import write_animation
    from stereoweave.rendering.layouts import ANIMATIONS, LAYOUTS, render_views, write_picture

    if name in LAYOUTS:
        picture = LAYOUTS[name].compose(renderer, choices)
        write_picture(out, picture)
        return f"{name}, {picture.shape[1]}x{picture.shape[0]} px"
    motion = ANIMATIONS[name]
    turns = motion.turns(out)
    write_animation(out, render_views(renderer, motion.positions * turns), motion.frame_ms)
    count = len(motion.positions) * turns
    return f"{name}, {count} frames in {count * motion.frame_ms / 1000:g} s"
