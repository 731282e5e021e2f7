"""The command `python -m experiments.failures`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from experiments.command_line import run
from stereoweave.cli.options import Model, make_parent_folder
from stereoweave.cli.tables import write_and_print


def failures(
    scenes: Annotated[Path, typer.Argument(help="Folder of pairs, as for stereoweave bench pairs.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="CSV file to write.")],
    picture: Annotated[Path, typer.Option(help="Picture to write, a row for each pair.")],
    model: Model = "base",
    count: Annotated[int, typer.Option(min=1, help="Number of pairs.")] = 5,
) -> None:
    """Draw the pairs that a network gets most wrong: by the share of pixels off by more than 2 px.

    At most one pair of each set is drawn: left picture, true disparity, estimate, and errors up to 8 px.
    """
    import stereoweave as sw
    from experiments.failures.gallery import draw_failures, find_failures
    from stereoweave.data.readers import read_scenes
    from stereoweave.io.images import write_image

    make_parent_folder(out)
    make_parent_folder(picture)
    matched = (
        (scene, sw.estimate(scene.pair.left, scene.pair.right, model=model)) for scene in read_scenes(scenes)
    )
    found = find_failures(matched, count)
    write_image(picture, draw_failures((scene, estimate) for _, scene, estimate in found))
    write_and_print(out, "Worst pairs", [failure for failure, _, _ in found])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return its exit code."""
    return run(failures, "experiments.failures", arguments)


if __name__ == "__main__":
    sys.exit(main())
