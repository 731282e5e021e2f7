"""The command `python -m experiments.speed`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from experiments.command_line import RecipeFile, run
from stereoweave.cli.options import make_parent_folder, require_train_extra
from stereoweave.cli.tables import write_and_print


def speed(
    recipe: RecipeFile,
    out: Annotated[Path, typer.Option("--out", "-o", help="CSV file to write.")] = Path("speed.csv"),
) -> None:
    """Time the paper's network and its rivals on a 640x480 pair, in PyTorch and in ONNX Runtime."""
    from stereoweave.learn.recipe import read_recipe

    make_parent_folder(out)
    read = read_recipe(recipe)
    with require_train_extra():
        from experiments.speed.timing import measure_run_times
    write_and_print(out, "One 640x480 pair", measure_run_times(read))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return its exit code."""
    return run(speed, "experiments.speed", arguments)


if __name__ == "__main__":
    sys.exit(main())
