"""The command `python -m experiments.average_weights`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from experiments.command_line import run
from stereoweave.cli.options import make_parent_folder, require_train_extra


def average_weights(
    checkpoints: Annotated[list[Path], typer.Argument(help="Checkpoints that descend from the same run.")],
    out: Annotated[Path, typer.Option("--out", "-o", help=".pt file to write.")],
    pairs: Annotated[Path, typer.Option(help="Folder for the held-out collages.")] = Path("runs/pairs"),
) -> None:
    """Average the weights of several runs of one network, and write them in 16 bits, with their scores."""
    with require_train_extra():
        from experiments.average_weights.averaging import average_and_score
        from stereoweave.learn import checkpoint
    make_parent_folder(out)
    mean = average_and_score(checkpoints, pairs)
    checkpoint.save(mean, out)
    typer.echo(f"{out}: mean of {len(checkpoints)} networks, EPE {mean.scores['epe_px']:.3f} px")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return its exit code."""
    return run(average_weights, "experiments.average_weights", arguments)


if __name__ == "__main__":
    sys.exit(main())
