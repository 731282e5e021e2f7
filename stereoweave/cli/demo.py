"""The command `stereoweave demo`."""

from pathlib import Path
from typing import Annotated

import typer

from stereoweave.cli.depth import depth
from stereoweave.cli.view import view

Out = Annotated[Path, typer.Option("--out", "-o", help="Folder to write the results to.")]


def demo(out: Out = Path("demo")) -> None:
    """Show depth and a new view of a sample pair. Says which file to open next."""
    from stereoweave.pictures.sample import sample_folder

    folder = sample_folder()
    typer.echo(f"depth and a new view of a sample pair, {folder / 'left.jpg'} and right.jpg")
    pictures = [folder / "left.jpg", folder / "right.jpg"]
    depth(pictures, out, calib=folder / "calib.txt")
    view(pictures, out / "view.png")
    typer.echo("next, a pair of your own: stereoweave depth left.jpg right.jpg")
    typer.echo(f"open in a browser: {(out / 'report.html').absolute()}")
