"""The command `stereoweave view`."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stereoweave.cli.commands import running_options, shows_steps
from stereoweave.cli.options import (
    Format,
    Fov,
    LensFov,
    Look,
    Model,
    Pictures,
    Projection,
    Provider,
    Range,
    Rectify,
    Screen,
    Strength,
    Threads,
    Whole,
    make_parent_folder,
    make_request,
    make_screen_choice,
    make_sphere_request,
    parse_largest_size_px,
    parse_range_px,
    parse_two_counts,
)
from stereoweave.errors import Note, StereoweaveError

if TYPE_CHECKING:
    from stereoweave.matching.backend import Backend
    from stereoweave.matching.options import MatchOptions
    from stereoweave.outputs.view_files import ViewFile
    from stereoweave.pictures.prepare import Prepared
    from stereoweave.rendering.layouts import LayoutOptions

_MIDDLE = 0.5


Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        "-o",
        help="File to write (default: in the current folder, named after the left picture and the layout, "
        "such as left_view.png or left_wiggle.webp). Viewers recognise some layouts by a mark in the file "
        "name, which is added automatically: view.png becomes view_qs8x6a0.75.png for a quilt. .mpo, .jps "
        "and .heic (a spatial photo) are 3-D pictures, .html is a 3-D photo (--layout viewer).",
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
        "quilt or contact_sheet; an animation, sweep or wiggle, as .mp4 (extra 'video'), .gif or .webp; or "
        "viewer, a 3-D photo: a page for any browser (.html) in which the mouse or a finger moves the "
        "viewpoint."
    ),
]
Convergence = Annotated[
    str | None,
    typer.Option(
        metavar="PX|auto",
        help="Disparity that stays in place in all views; auto is the scene's median disparity (default: "
        "auto for anaglyphs, quilts, contact sheets, animations and the viewer, 0 for all others).",
    ),
]
Quilt = Annotated[
    str | None,
    typer.Option(metavar="COLUMNSxROWS", help="Columns and rows of views in a quilt (default: 8x6)."),
]
Size = Annotated[
    str | None,
    typer.Option(
        metavar="PX|WIDTHxHEIGHT",
        help="Longer side, or largest width and height, of each view: larger pictures are scaled down after "
        "matching (default: the pictures' size; 1600, the most, for the viewer).",
    ),
]
Crop = Annotated[
    str | None,
    typer.Option(
        metavar="auto",
        help="auto cuts off the borders of a single view, an anaglyph or an animation that not all its views "
        "really show (default: such borders are filled).",
    ),
]
Calib = Annotated[
    Path | None,
    typer.Option(help="Calibration file, for --rectify, and for correct proportions of --up and --forward."),
]


@shows_steps
def view(  # noqa: PLR0913 - each is an option of the command line
    pictures: Pictures,
    out: Out = None,
    position: Position = None,
    up: Up = 0.0,
    forward: Forward = 0.0,
    layout: Layout = None,
    strength: Strength = None,
    screen: Screen = None,
    convergence: Convergence = None,
    quilt: Quilt = None,
    size: Size = None,
    crop: Crop = None,
    format: Format = None,
    calib: Calib = None,
    rectify: Rectify = None,
    projection: Projection = None,
    look: Look = None,
    fov: Fov = None,
    lens_fov: LensFov = None,
    whole: Whole = False,
    range_px: Range = None,
    model: Model = "best",
    threads: Threads = None,
    provider: Provider = "cpu",
) -> None:
    """Render a new view of a stereo pair, or a layout of several for 3-D viewers and displays."""
    from stereoweave.matching.backend import Backend
    from stereoweave.matching.options import MatchOptions
    from stereoweave.outputs.sphere_views import check_extent
    from stereoweave.outputs.view_files import ViewFile
    from stereoweave.pictures.prepare import prepare
    from stereoweave.rendering.layouts import choose_layout, is_converged

    out = out or _name_view(pictures, layout)
    name = choose_layout(out, layout)
    _check_unused(name, {"--position": position, "--up": up or None, "--forward": forward or None}, quilt)
    given_px = None if convergence in (None, "auto") else _parse_convergence_px(str(convergence))
    chosen = make_screen_choice(screen, strength, given_px)
    _check_has_views(name, strength, convergence)
    file = ViewFile(
        path=out,
        name=name,
        position=_MIDDLE if position is None else position,
        up=up,
        forward=forward,
        strength=1.0 if strength is None else strength,
        screen=chosen,
        convergence_px=_parse_convergence_px(convergence or ("auto" if is_converged(name) else "0")),
        layout_options=_parse_quilt(quilt),
        size_px=parse_largest_size_px(size),
        crops=_parse_crop(crop),
        threads=threads,
    )
    options = MatchOptions(range_px=parse_range_px(range_px), refined=True)
    sphere = make_sphere_request(projection, look, fov, lens_fov, whole)
    check_extent(file, whole=whole)
    prepared = prepare(pictures, make_request(format, calib, rectify=rectify, sphere=sphere))
    _render(file, prepared, Backend(model=model, threads=threads, provider=provider), options, whole)


def _render(
    file: "ViewFile", prepared: "Prepared", backend: "Backend", options: "MatchOptions", whole: bool
) -> None:
    """Match a pair, write its views, and print what was written."""
    from stereoweave.cameras.content import crop as crop_to_content
    from stereoweave.cameras.diagnosis import find_problems
    from stereoweave.io.files import refuse_inputs
    from stereoweave.matching.estimate import match
    from stereoweave.outputs.sphere_views import write_whole_view
    from stereoweave.rendering.renderer import check_convergence_px
    from stereoweave.system.compiling_ahead import compile_ahead

    pair = prepared.pair if whole else crop_to_content(prepared.pair)
    if file.convergence_px is not None and not whole:
        check_convergence_px(file.convergence_px, pair.left.shape[1])
    file = file.add_mark(pair)
    make_parent_folder(file.path)
    refuse_inputs([file.path], prepared.pictures)
    compile_ahead(*file.rehearsals)
    estimate = match(backend.matcher(), pair, options)
    if whole:
        written = write_whole_view(file, prepared, estimate)
    else:
        written = file.write(pair, estimate, prepared.pictures)
    typer.echo(f"{file.path}: {written.description}")
    problems = find_problems(pair, estimate, prepared.alignment, prepared.remedy)
    _print_notes([*prepared.notes, *estimate.notes, *problems])


def _print_notes(notes: Sequence[Note]) -> None:
    for note in notes:
        typer.echo(note.format(running_options()))


def _name_view(pictures: Sequence[Path], layout: str | None) -> Path:
    """Return the file to write if the user names none."""
    from stereoweave.rendering.layouts import ANIMATIONS, VIEWER

    endings = dict.fromkeys(ANIMATIONS, ".webp") | {VIEWER: ".html"}
    return Path(f"{pictures[0].stem}_{layout or 'view'}{endings.get(layout or '', '.png')}")


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


def _check_has_views(name: str | None, strength: float | None, convergence: str | None) -> None:
    """Raise a StereoweaveError if the layout has no views that strength and convergence could shift."""
    if name == "rgbd" and (strength not in (None, 1) or convergence is not None):
        raise StereoweaveError(
            "--strength, --convergence: expected only with a layout of several views, found with rgbd"
        )


def _parse_quilt(quilt: str | None) -> "LayoutOptions":
    from stereoweave.rendering.layouts import LayoutOptions

    if quilt is None:
        return LayoutOptions()
    columns, rows = parse_two_counts("--quilt", quilt, "columns and rows, such as 8x6")
    return LayoutOptions(columns=columns, rows=rows)


def _parse_crop(crop: str | None) -> bool:
    if crop not in (None, "auto"):
        raise StereoweaveError(f"--crop: expected auto, found {crop!r}")
    return crop is not None


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
