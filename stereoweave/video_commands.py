"""The command stereoweave video."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stereoweave.command_line import Model, Threads, place_for

if TYPE_CHECKING:
    from stereoweave.video import Tally


def video(  # noqa: PLR0913 - each is a word of the command line
    films: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILM",
            help="A 3-D film with both views in each frame; or LEFT RIGHT. Videos, folders of pictures, or "
            "patterns such as 'left/*.png'.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", help="The film to write: .mp4, .mov or .mkv. Begun once, it is continued."
        ),
    ],
    depth: Annotated[
        bool,
        typer.Option("--depth", help="Make the left view's disparity in colours, of one range throughout."),
    ] = False,
    depth16: Annotated[
        bool, typer.Option("--depth16", help="Make it 16-bit grey, disparity in px * 256, lossless in .mkv.")
    ] = False,
    position: Annotated[
        float | None,
        typer.Option(help="Make the view from here: 0 is the left camera, 1 the right; -1 to 2."),
    ] = None,
    layout: Annotated[
        str | None,
        typer.Option(
            help="Make a layout as `stereoweave view` knows them, such as anaglyph_dubois or quilt."
        ),
    ] = None,
    strength: Annotated[
        float, typer.Option(min=0, help="Multiplies the distance of the cameras, about their middle.")
    ] = 1.0,
    convergence: Annotated[
        float | None,
        typer.Option(
            metavar="PX",
            help="The disparity that stays in place from view to view. [default: that of the film's middle "
            "for anaglyphs, quilts and contact sheets, 0 for all others]",
        ),
    ] = None,
    arrangement: Annotated[
        str | None,
        typer.Option(
            help="How a frame holds both views: side_by_side, side_by_side_half, top_bottom, top_bottom_half "
            "or crossed; guessed unless given."
        ),
    ] = None,
    model: Model = "small",
    threads: Threads = None,
) -> None:
    """A 3-D film's depth, a new view of it, or another layout, with its sound and its frame times."""
    from rich.console import Console

    from stereoweave.animation import needing_the_video_extra
    from stereoweave.footage import open_footage

    with needing_the_video_extra("a film"):
        from stereoweave.film import parts_folder
        from stereoweave.video import Order, make_film

    order = Order(
        depth=depth,
        depth16=depth16,
        position=position,
        layout=layout,
        strength=strength,
        convergence_px=convergence,
        model=model,
        threads=threads,
    )
    footage = open_footage(films, arrangement)
    if layout:
        out = _marked(out, layout, footage.size_px)
    place_for(out)
    try:
        tally = make_film(footage, films, out, order, Console(stderr=True))
    except KeyboardInterrupt:
        folder = parts_folder(out)
        kept = (
            f"what is finished stays in {folder}, and the same command goes on"
            if folder.exists()
            else "nothing stays"
        )
        typer.echo(f"stereoweave: {out}: stopped; {kept}", err=True)
        raise typer.Exit(130) from None
    _tell(out, tally)


def _marked(out: Path, layout: str, size_px: tuple[int, int]) -> Path:
    """The name with the mark by which viewers know the layout."""
    import numpy as np

    from stereoweave.layouts import Choices, marked
    from stereoweave.stereo import StereoPair

    blank = np.broadcast_to(np.uint8(0), (*reversed(size_px), 3))
    return marked(out, layout, StereoPair(left=blank, right=blank), Choices())


def _tell(out: Path, tally: "Tally") -> None:
    cuts = "1 cut" if tally.cuts == 1 else f"{tally.cuts} cuts"
    typer.echo(f"{out}: {tally.frames} frames, {cuts}")
    if tally.problems:
        more = "; ..." if tally.problems > len(tally.named) else ""
        typer.echo(f"problems in {tally.problems} of {tally.frames} frames: {'; '.join(tally.named)}{more}")
