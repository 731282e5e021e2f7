"""The command `python -m experiments.handheld`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from experiments.command_line import run
from stereoweave.cli.options import make_parent_folder
from stereoweave.io.files import make_folder
from stereoweave.io.images import write_image


def handheld(
    real: Annotated[Path, typer.Argument(help="Folder of real pairs, as for stereoweave bench pairs.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="CSV file to write.")] = None,
    pictures: Annotated[
        Path | None,
        typer.Option(help="Folder to write instead: the pictures, and true correspondences in points.npz."),
    ] = None,
) -> None:
    """Score rectification without a calibration on 200 simulated hand-held pairs."""
    from experiments.handheld.pairs import make_handheld_pairs
    from experiments.handheld.scoring import score_handheld_pairs, summarize
    from stereoweave.bench.tables import write_csv

    if pictures:
        for made in make_handheld_pairs(real):
            folder = make_folder(pictures / made.name)
            write_image(folder / "left.png", made.pair.left)
            write_image(folder / "right.png", made.pair.right)
            np.savez(folder / "points.npz", left_px=made.left_px, right_px=made.right_px)
        return
    if out:
        make_parent_folder(out)
    rows = score_handheld_pairs(real)
    if out:
        write_csv(out, rows)
    typer.echo(summarize(rows))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return its exit code."""
    return run(handheld, "experiments.handheld", arguments)


if __name__ == "__main__":
    sys.exit(main())
