"""The command `python -m experiments.handheld`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from experiments.command_line import run
from stereoweave.io.files import make_folder
from stereoweave.io.images import write_image


def handheld(
    real: Annotated[Path, typer.Argument(help="Folder of real pairs, as for stereoweave bench pairs.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write to.")],
) -> None:
    """Write 200 simulated hand-held pairs: left.png, right.png, and correspondences in points.npz."""
    from experiments.handheld.pairs import make_handheld_pairs

    for made in make_handheld_pairs(real):
        folder = make_folder(out / made.name)
        write_image(folder / "left.png", made.pair.left)
        write_image(folder / "right.png", made.pair.right)
        np.savez(folder / "points.npz", left_px=made.left_px, right_px=made.right_px)
        typer.echo(f"{made.name}: {len(made.left_px)} correspondences")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line. Returns its exit code."""
    return run(handheld, "experiments.handheld", arguments)


if __name__ == "__main__":
    sys.exit(main())
