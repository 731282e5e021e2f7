"""The command `python -m experiments.paper_transfer`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from experiments.command_line import RecipeFile, RunsFolder, Seeds, run
from stereoweave.cli.options import parse_size_px, require_synth_extra, require_train_extra
from stereoweave.cli.tables import print_means

_COLUMNS = {
    "steps from random weights": "scratch_steps",
    "from the propeller": "tuned_steps",
    "EPE cm from random weights": "scratch_cm",
    "EPE cm from the propeller": "tuned_cm",
}


def paper_transfer(  # noqa: PLR0913 - each is an option of the command line
    recipe: RecipeFile,
    start: Annotated[
        Path, typer.Argument(metavar="CHECKPOINT", help="Checkpoint of a training on the propeller.")
    ],
    out: RunsFolder,
    report: Annotated[Path, typer.Option(help="Folder to write transfer.csv and transfer.png to.")],
    worlds: Annotated[Path, typer.Option(help="Folder of the rendered sets; missing pairs are made.")] = Path(
        "runs/short_worlds"
    ),
    frames: Annotated[int, typer.Option(min=1, help="Number of pairs of each world.")] = 100,
    size: Annotated[str, typer.Option(help="Width and height in pixels.")] = "320x240",
    seeds: Seeds = 3,
    jobs: Annotated[int, typer.Option(min=1, help="Number of processes.")] = 1,
) -> None:
    """Train the paper's network on seven scenes, from a network of the propeller and from random weights.

    Rerun the same command to resume after an interruption.
    """
    from rich.console import Console

    from stereoweave.bench.tables import write_csv
    from stereoweave.io.files import make_folder

    size_px = parse_size_px(size)
    with require_train_extra(), require_synth_extra():
        from experiments.paper.experiment import run_trials
        from experiments.paper_transfer.report import draw_curves, read_rows, summarise
        from experiments.paper_transfer.trials import list_sets, list_trials, render_first_frames
        from stereoweave.learn.recipe import read_recipe
    sets = list_sets()
    trials = list_trials(read_recipe(recipe), [one.scene for one in sets], worlds, start, seeds)
    for one in sets:
        render_first_frames(one, frames, size_px, worlds / one.scene, jobs)
    run_trials(trials, out, jobs, Console())
    rows = read_rows(trials, out)
    make_folder(report)
    write_csv(report / "transfer.csv", rows)
    draw_curves(trials, out, report / "transfer.png")
    print_means({"Steps: medians over the seeds. Errors: means": _COLUMNS}, "scene", summarise(rows))
    typer.echo(f"rows: {report / 'transfer.csv'}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return its exit code."""
    return run(paper_transfer, "experiments.paper_transfer", arguments)


if __name__ == "__main__":
    sys.exit(main())
