"""The command line `stereoweave`: its commands, its exit codes, and the one-line errors."""

import io
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from stereoweave import __version__
from stereoweave.cli.app import app as page
from stereoweave.cli.batch import batch
from stereoweave.cli.bench import bench
from stereoweave.cli.commands import Commands
from stereoweave.cli.depth import depth, measure
from stereoweave.cli.live import live
from stereoweave.cli.options import require_train_extra
from stereoweave.cli.rig import calibrate, check, rectify
from stereoweave.cli.serve import serve
from stereoweave.cli.synth import synth
from stereoweave.cli.video import video
from stereoweave.cli.view import view
from stereoweave.errors import StereoweaveError

app = Commands()
app.add_typer(bench, name="bench")
app.add_typer(synth, name="synth")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command `stereoweave`. Returns its exit code, as `run` does."""
    return run(app, "stereoweave", arguments)


def run(commands: Commands, program: str, arguments: Sequence[str] | None) -> int:
    """Run a command line. Returns 0, or 2 after a user's mistake, which is reported on stderr in one line."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # like stderr, for file names that are not UTF-8
    try:
        return commands(arguments, prog_name=program, standalone_mode=False) or 0
    except typer.TyperException as error:
        message = error.format_message().rstrip(".") + f"; see {program} --help"
    except (StereoweaveError, OSError) as error:
        message = str(error)
    typer.echo(f"{program}: " + " ".join(message.splitlines()), err=True)
    return 2


def _show_version(wanted: bool) -> bool:
    if wanted:
        typer.echo(f"stereoweave {__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def _stereoweave(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit."),
    ] = False,
) -> None:
    """Depth, and any view between the two cameras, from a stereo pair."""


for command in (depth, measure, view, video, live, check, rectify, calibrate, serve, batch):
    app.command()(command)
app.command("app")(page)


@app.command()
def train(
    recipe: Annotated[Path, typer.Argument(help="Recipe in TOML, such as recipes/weave_small.toml.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the run.")],
) -> None:
    """Train the network of a recipe, or resume an interrupted run."""
    from stereoweave.learn.distributed import report_once

    with report_once(), require_train_extra():
        from stereoweave.learn.recipe import read_recipe

        read_recipe(recipe)  # reports errors before PyTorch, which takes seconds to load
    with require_train_extra():
        from stereoweave.learn.training.loop import train as train_recipe
    train_recipe(recipe, out)


@app.command()
def export(  # noqa: PLR0913 - each is an option of the command line
    source: Annotated[
        str,
        typer.Argument(help="Run folder, checkpoint, shipped model or .onnx matcher file."),
    ],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Output .onnx file in float32.")] = None,
    half: Annotated[Path | None, typer.Option(help="Output .onnx file in 16 bits.")] = None,
    eight_bits: Annotated[
        Path | None, typer.Option(help="Output .onnx file with 8-bit convolutions.")
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option(
            help="Output .pt file: a run's averaged weights in 16 bits, for start_from of a recipe."
        ),
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(
            metavar="WxH",
            help="Make files for single pairs of this size, as TensorRT needs them; default: any size.",
        ),
    ] = None,
    scenes: Annotated[
        Path | None,
        typer.Option(
            help="Further pairs on which ONNX Runtime and PyTorch must agree: a folder as for bench pairs."
        ),
    ] = None,
    reliability: Annotated[
        Path | None, typer.Option(help="Output picture: plot of the confidence's reliability.")
    ] = None,
) -> None:
    """Export a trained network as matcher files for --model, and check that they agree with it.

    Variants in 16 bits, in 8 bits or for one size are made from a trained network or from a matcher file.
    Each is compared with its source, and rejected if it differs too much.
    """
    from stereoweave.data.readers import read_scenes

    size_px = _size_px(size) if size else None
    pairs = [scene.pair for scene in read_scenes(scenes)] if scenes else []
    with require_train_extra():
        from stereoweave.learn.export.files import MatcherFiles, write_matcher_files, write_weights
    if weights:
        typer.echo(write_weights(Path(source), weights))
    if weights and not (out or half or eight_bits):
        return
    files = MatcherFiles(out=out, half=half, eight_bits=eight_bits, size=size_px)
    for line in write_matcher_files(source, files, pairs, reliability):
        typer.echo(line)


def _size_px(size: str) -> tuple[int, int]:
    found = re.fullmatch("([0-9]{1,5})x([0-9]{1,5})", size)
    if found is None:
        raise StereoweaveError(f"--size: expected width x height in pixels, such as 640x480, found {size!r}")
    return int(found[1]), int(found[2])
