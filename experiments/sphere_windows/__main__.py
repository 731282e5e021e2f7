"""The command `python -m experiments.sphere_windows`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from experiments.command_line import run
from stereoweave.cli.options import make_parent_folder
from stereoweave.cli.tables import write_and_print


def sphere_windows(
    out: Annotated[Path, typer.Option("--out", "-o", help="CSV file to write.")] = Path("sphere_windows.csv"),
    size: Annotated[
        list[int] | None,
        typer.Option(min=128, help="Pixels a side of each eye's picture; may be repeated (default: 512)."),
    ] = None,
) -> None:
    """Measure the distances of a VR180 pair of a room in one image of all directions, and in nine windows."""
    from experiments.sphere_windows.distances import measure_distances

    make_parent_folder(out)
    rows = [row for size_px in size or [512] for row in measure_distances(size_px)]
    write_and_print(out, "Median error of distances, % by degrees aside", rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return its exit code."""
    return run(sphere_windows, "experiments.sphere_windows", arguments)


if __name__ == "__main__":
    sys.exit(main())
