"""The command `python -m experiments.paper`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from experiments.command_line import RecipeFile, RunsFolder, Seeds, run
from experiments.paper.trials import CLAIMS, Extent
from stereoweave.cli.options import require_train_extra


def paper(  # noqa: PLR0913 - each is an option of the command line
    recipe: RecipeFile,
    out: RunsFolder,
    report: Annotated[Path, typer.Option(help="Folder to write rows, tables and figures to.")],
    seeds: Seeds = 3,
    jobs: Annotated[int, typer.Option(min=1, help="Number of trainings that run in parallel.")] = 1,
    slow_steps: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Steps of PSMNet, SCV-Net and GA-Net, and of the networks compared with them. Default: a "
            "quarter of the recipe's.",
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="CLAIM",
            help=f"Train only for this claim; repeat for more. One of {', '.join(CLAIMS)}.",
        ),
    ] = None,
    finished: Annotated[
        bool, typer.Option("--finished", help="Train nothing; report what is finished.")
    ] = False,
) -> None:
    """Train the paper's network, its rivals and all variants, and compare them with the paper's tables.

    Rerun the same command to resume after an interruption. Trainings that the report's folder holds are not
    repeated: remove its trainings.jsonl and the runs after a change of the code.
    """
    from rich.console import Console

    console = Console()
    with require_train_extra():
        from experiments.paper.experiment import plan, run_trials
        from experiments.paper.report import list_unfinished, write_report
        from stereoweave.learn.recipe import read_recipe
    base = read_recipe(recipe)
    planned = plan(base, out, Extent(seeds=seeds, slow_steps=slow_steps, claims=only or CLAIMS), console)
    if not finished:
        run_trials(list_unfinished(planned, out, report), out, jobs, console, scored=True)
    write_report(base, planned, out, report)
    typer.echo(f"tables: {report / 'paper.md'}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return its exit code."""
    return run(paper, "experiments.paper", arguments)


if __name__ == "__main__":
    sys.exit(main())
