"""The command `python -m experiments.stage_costs`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from experiments.command_line import run
from stereoweave.cli.options import make_parent_folder, require_train_extra


def stage_costs(
    runs: Annotated[list[Path], typer.Argument(help="Checkpoints, or run folders of stereoweave train.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Additional CSV file to write.")] = None,
) -> None:
    """Measure the stages of trained WeaveNets, and print a Markdown table.

    Columns are multiply-adds, bytes moved and times. The columns "of the peak" give a stage's speed relative
    to a large matrix product in the same run.
    """
    from stereoweave.bench.tables import write_csv

    if out:
        make_parent_folder(out)
    with require_train_extra():
        from experiments.stage_costs import profiling
    rows = profiling.measure_stage_costs(runs)
    if out:
        write_csv(out, rows)
    typer.echo(profiling.format_table(rows))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return its exit code."""
    return run(stage_costs, "experiments.stage_costs", arguments)


if __name__ == "__main__":
    sys.exit(main())
