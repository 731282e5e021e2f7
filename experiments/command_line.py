"""Options and error handling that the experiments' command lines share."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import typer

from stereoweave.cli import root
from stereoweave.cli.commands import Commands

RecipeFile = Annotated[
    Path, typer.Argument(metavar="RECIPE", help="TOML file of the base recipe, in recipes/.")
]
RunsFolder = Annotated[Path, typer.Option("--out", "-o", help="Folder of the training runs.")]
Seeds = Annotated[
    int, typer.Option(min=1, help="Number of repetitions of each training, with different seeds.")
]


def run(command: Callable[..., None], module: str, arguments: Sequence[str] | None) -> int:
    """Run an experiment's only command, `python -m MODULE`, and return its exit code; see `root.run`."""
    app = Commands()
    app.command()(command)
    return root.run(app, f"python -m {module}", arguments)
