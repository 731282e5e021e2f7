"""The command `python -m experiments.first_run`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from experiments.command_line import run
from stereoweave.cli.options import make_parent_folder
from stereoweave.cli.tables import write_and_print


def first_run(
    left: Annotated[Path, typer.Argument(help="Left picture.")] = Path("examples/left.png"),
    right: Annotated[Path, typer.Argument(help="Right picture.")] = Path("examples/right.png"),
    out: Annotated[Path, typer.Option("--out", "-o", help="CSV file to write.")] = Path("first_run.csv"),
    turns: Annotated[int, typer.Option(min=1, help="Number of runs; the fastest counts.")] = 3,
) -> None:
    """Time the first run of `depth` and `view` on a machine, without compiled kernels, and the next run."""
    from experiments.first_run.timing import measure_first_runs

    make_parent_folder(out)
    write_and_print(out, f"{left.name} + {right.name}", measure_first_runs(left, right, turns))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return its exit code."""
    return run(first_run, "experiments.first_run", arguments)


if __name__ == "__main__":
    sys.exit(main())
