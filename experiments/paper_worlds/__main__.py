"""The command `python -m experiments.paper_worlds`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from experiments.command_line import RecipeFile, run
from stereoweave.cli.options import make_parent_folder, require_train_extra
from stereoweave.cli.tables import print_means

_COLUMNS = {"EPE cm": "epe_cm", "deviation": "epe_cm_sd", "EPE px": "epe_px", "MAE of the view": "mae_filled"}


def paper_worlds(
    recipe: RecipeFile,
    runs: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[RUN]...", help="Run folders of stereoweave train, or checkpoints."),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="CSV file to write.")] = Path("worlds.csv"),
    most: Annotated[
        int | None, typer.Option(min=1, help="Greatest number of frames to score per split (default: all).")
    ] = None,
) -> None:
    """Score networks on training frames, in the worlds of these and in others, beside the nearest frame."""
    from stereoweave.bench.tables import write_csv
    from stereoweave.learn.recipe import read_recipe

    make_parent_folder(out)
    read = read_recipe(recipe)
    with require_train_extra():
        from experiments.paper_worlds.scoring import score_worlds
    rows = list(score_worlds(read, runs or [], most))
    write_csv(out, rows)
    for split in dict.fromkeys(row.split for row in rows):
        chosen = [row for row in rows if row.split == split]
        print_means({f"split {split}, {chosen[0].pairs} pairs": _COLUMNS}, "method", chosen)
    typer.echo(f"rows: {out}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return its exit code."""
    return run(paper_worlds, "experiments.paper_worlds", arguments)


if __name__ == "__main__":
    sys.exit(main())
