"""The command `python -m experiments.handheld`."""

import sys
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from experiments.command_line import run
from stereoweave.cli.options import make_parent_folder
from stereoweave.io.files import make_folder
from stereoweave.io.images import write_image


class Kind(StrEnum):
    """What the command scores."""

    plain = "plain"
    warped = "warped"
    swaps = "swaps"
    known_cameras = "known_cameras"


def handheld(
    real: Annotated[Path, typer.Argument(help="Folder of real pairs, as for stereoweave bench pairs.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="CSV file to write.")] = None,
    pictures: Annotated[
        Path | None,
        typer.Option(help="Folder to write instead: the pictures, and true correspondences in points.npz."),
    ] = None,
    kind: Annotated[
        Kind,
        typer.Option(
            help="What to score: plain (the 200 pairs), warped (20 of them with five further distortions), "
            "swaps (these 20 as they are and with their sides swapped), or known_cameras (20 rendered "
            "pairs whose focal length and baseline are known)."
        ),
    ] = Kind.plain,
) -> None:
    """Score rectification without a calibration on simulated hand-held pairs."""
    from experiments.handheld.pairs import make_handheld_pairs
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
    rows, summary = _score(kind, real)
    if out:
        write_csv(out, rows)
    typer.echo(summary)


def _score(kind: Kind, real: Path) -> tuple[Sequence[object], str]:
    """Return the rows, and their summary."""
    from experiments.handheld import known_cameras, scoring

    match kind:
        case Kind.plain:
            plain = scoring.score_handheld_pairs(real)
            return plain, scoring.summarize(plain)
        case Kind.warped:
            warped = scoring.score_warped_pairs(real)
            return warped, scoring.summarize_warped(warped)
        case Kind.swaps:
            swaps = scoring.score_swaps(real)
            return swaps, scoring.summarize_swaps(swaps)
        case Kind.known_cameras:
            known = known_cameras.score_known_cameras()
            return known, known_cameras.summarize_known_cameras(known)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return its exit code."""
    return run(handheld, "experiments.handheld", arguments)


if __name__ == "__main__":
    sys.exit(main())
