"""The command `python -m experiments.interleaved`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from experiments.command_line import run
from stereoweave.cli.options import make_parent_folder
from stereoweave.cli.tables import write_and_print


def interleaved(
    real: Annotated[Path, typer.Argument(help="Folder of real pairs, as for stereoweave bench pairs.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="CSV file to write.")] = Path("interleaved.csv"),
) -> None:
    """Count the pictures that are suspected to hold two views whose rows or columns alternate.

    The views of each pair are interleaved by rows, by columns and as a checkerboard; each picture is counted
    as it is and after JPEG at quality 90. Views alone are ordinary pictures.
    """
    from experiments.interleaved.counting import count_suspected

    make_parent_folder(out)
    write_and_print(out, "Suspected pictures", count_suspected(real))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return its exit code."""
    return run(interleaved, "experiments.interleaved", arguments)


if __name__ == "__main__":
    sys.exit(main())
