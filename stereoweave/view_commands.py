"""The command stereoweave view."""

from pathlib import Path
from typing import Annotated

import typer

from stereoweave.command_line import Model, Pictures, Threads, load_matcher, place_for, read_pictures


def view(  # noqa: PLR0913 - each is a word of the command line
    pictures: Pictures,
    out: Annotated[Path, typer.Option("--out", "-o", help="The picture to write.")],
    position: Annotated[
        float, typer.Option(help="The viewpoint: 0 is the left camera, 1 the right; -1 to 2.")
    ] = 0.5,
    model: Model = "small",
    threads: Threads = None,
) -> None:
    """A new view of a stereo pair, from between its two cameras or a little beyond them."""
    from stereoweave.hints import hints
    from stereoweave.io import picture_kind, write_image
    from stereoweave.rendering import check_position, render

    check_position(position)
    picture_kind(out)
    place_for(out)
    pair = read_pictures(pictures)
    matcher = load_matcher(model, threads)
    estimate = matcher.estimate(pair.left, pair.right)
    new = render(pair.left, pair.right, estimate, position, threads)
    write_image(out, new.image)
    typer.echo(f"{out}: view at {position:g}, {100 * (~new.drawn).mean():.1f} % of it seen by neither camera")
    for hint in hints(pair, estimate, matcher):
        typer.echo(hint)
