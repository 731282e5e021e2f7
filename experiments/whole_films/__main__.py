"""The command `python -m experiments.whole_films`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from experiments.command_line import run
from stereoweave.cli.options import make_parent_folder
from stereoweave.cli.tables import write_and_print


def whole_films(
    film: Annotated[Path, typer.Argument(help="Stereo video to convert.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="CSV file to write.")] = Path("whole_films.csv"),
    output: Annotated[
        list[str] | None,
        typer.Option(help="Convert to this only; may be repeated (default: to all that the help lists)."),
    ] = None,
) -> None:
    """Convert a film by `stereoweave video` and compare its frames, times and sound with the original's.

    It is converted to side_by_side, anaglyph, depth, and vr180_window, a window as if it were VR180, each in
    a process of its own.
    """
    from experiments.whole_films.conversion import measure_conversions

    make_parent_folder(out)
    write_and_print(out, film.name, measure_conversions(film, output or None))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return its exit code."""
    return run(whole_films, "experiments.whole_films", arguments)


if __name__ == "__main__":
    sys.exit(main())
