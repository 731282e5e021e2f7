"""The command `python -m experiments.ablations`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from experiments.command_line import RecipeFile, RunsFolder, Seeds, run
from stereoweave.cli.options import make_parent_folder, require_train_extra


def ablations(  # noqa: PLR0913 - each is an option of the command line
    recipe: RecipeFile,
    out: RunsFolder,
    report: Annotated[
        Path,
        typer.Option(
            help="CSV file to write, with one row per training. Rows of the same recipe are reused, and "
            "other rows are dropped; remove the file after a change of the code."
        ),
    ],
    rendered: Annotated[
        Path, typer.Option(metavar="FOLDER", help="Set of held-out pairs from stereoweave synth make.")
    ] = Path("runs/synth_val/rooms"),
    seeds: Seeds = 2,
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="VARIATION", help="Train only the base and this variation; repeat for more."),
    ] = None,
) -> None:
    """Train and score WeaveNet with one design choice changed at a time.

    Held-out collages and rendered pairs are scored. Rerun the same command to resume after an interruption.
    """
    from rich.console import Console

    make_parent_folder(report)
    with require_train_extra():
        from experiments.ablations.experiment import plan, run_ablations
        from stereoweave.learn.recipe import read_recipe
    run_ablations(plan(read_recipe(recipe), seeds, only or ()), out, rendered, report, Console())
    typer.echo(f"rows: {report}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return its exit code."""
    return run(ablations, "experiments.ablations", arguments)


if __name__ == "__main__":
    sys.exit(main())
