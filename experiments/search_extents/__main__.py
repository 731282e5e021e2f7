"""The command `python -m experiments.search_extents`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from experiments.command_line import run
from stereoweave.cli.options import make_parent_folder
from stereoweave.cli.tables import write_and_print


def search_extents(
    folders: Annotated[list[Path], typer.Argument(help="Folders of pairs, as for stereoweave bench pairs.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="CSV file to write.")] = Path("search_extents.csv"),
    model: Annotated[str, typer.Option(help="Shipped network.")] = "small",
) -> None:
    """Score a network's estimates without a search, and searched once more to several extents.

    No edges are settled by vote, so the widest search has more errors than refined estimates.
    """
    from experiments.search_extents.scoring import score_extents

    make_parent_folder(out)
    write_and_print(out, "Errors", [row for folder in folders for row in score_extents(folder, model)])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return its exit code."""
    return run(search_extents, "experiments.search_extents", arguments)


if __name__ == "__main__":
    sys.exit(main())
