"""The command `python -m experiments.video_speed`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from experiments.command_line import run
from stereoweave.cli.options import make_parent_folder
from stereoweave.cli.tables import write_and_print


def video_speed(
    scene: Annotated[str, typer.Argument(help="Scene of `stereoweave synth`.")] = "ship",
    out: Annotated[Path, typer.Option("--out", "-o", help="CSV file to write.")] = Path("video_speed.csv"),
    frames: Annotated[int, typer.Option(min=2, help="Number of frames of each video.")] = 240,
    turns: Annotated[int, typer.Option(min=1, help="Number of conversions; the fastest counts.")] = 2,
) -> None:
    """Time the conversion of rendered videos of two sizes to depth, a view and a layout."""
    from experiments.video_speed.timing import measure_speeds

    make_parent_folder(out)
    write_and_print(out, scene, list(measure_speeds(scene, frames, turns)))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return its exit code."""
    return run(video_speed, "experiments.video_speed", arguments)


if __name__ == "__main__":
    sys.exit(main())
