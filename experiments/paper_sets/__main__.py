"""The command `python -m experiments.paper_sets`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from experiments.command_line import run
from stereoweave.cli.options import parse_size_px, require_synth_extra


def paper_sets(
    report: Annotated[Path, typer.Option(help="Folder to write sets.csv and depth.csv to.")],
    size: Annotated[str, typer.Option(help="Width and height in pixels.")] = "320x240",
    every: Annotated[int, typer.Option(min=1, help="Measure one of so many frames.")] = 25,
) -> None:
    """Measure depth and motion in the sets of sets.toml, and print the commands that make them."""
    from stereoweave.bench.tables import write_csv
    from stereoweave.io.files import make_folder

    size_px = parse_size_px(size)
    make_folder(report)
    with require_synth_extra():
        from experiments.paper_sets.measuring import measure_sets
        from experiments.paper_sets.sets import read_sets
        from stereoweave.synth.sets.renderers import shared_renderer
    sets = read_sets()
    rows, depths = measure_sets(sets, shared_renderer(plain=True), size_px, every)
    write_csv(report / "sets.csv", rows)
    write_csv(report / "depth.csv", depths)
    for one in sets:
        typer.echo(one.command(size_px, f"runs/worlds/{one.scene}"))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return its exit code."""
    return run(paper_sets, "experiments.paper_sets", arguments)


if __name__ == "__main__":
    sys.exit(main())
