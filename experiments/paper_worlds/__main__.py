"""The command `python -m experiments.paper_worlds`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from experiments.command_line import run
from stereoweave.cli.options import make_parent_folder, require_train_extra
from stereoweave.cli.tables import write_and_print


def paper_worlds(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN...", help="Run folders of stereoweave train, or checkpoints.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="CSV file to write.")] = Path("worlds.csv"),
    most: Annotated[
        int | None, typer.Option(min=1, help="Greatest number of frames to score per split (default: all).")
    ] = None,
) -> None:
    """Score networks in the worlds that they trained on and in others, beside the nearest training frame."""
    make_parent_folder(out)
    with require_train_extra():
        from experiments.paper_worlds.scoring import score_worlds
    write_and_print(out, "Held-out frames of a set by world", list(score_worlds(runs, most)))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return its exit code."""
    return run(paper_worlds, "experiments.paper_worlds", arguments)


if __name__ == "__main__":
    sys.exit(main())
