"""The commands `stereoweave train` and `stereoweave export`."""

from pathlib import Path
from typing import Annotated

import typer

from stereoweave.cli.commands import shows_steps
from stereoweave.cli.options import parse_size_px, require_train_extra


@shows_steps
def train(
    recipe: Annotated[
        Path, typer.Argument(help="Recipe in TOML, such as recipes/ablations/weave_small.toml.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the run: a new one, or one to resume.")],
) -> None:
    """Train the network of a recipe, or resume an interrupted run."""
    from stereoweave.learn.distributed import report_once

    with report_once(), require_train_extra():
        from stereoweave.learn.recipe import read_recipe

        read_recipe(recipe)  # reports errors before PyTorch is loaded, which takes seconds
    with require_train_extra():
        from stereoweave.learn.training.loop import train as train_recipe
    train_recipe(recipe, out)


@shows_steps
def export(  # noqa: PLR0913 - each is an option of the command line
    source: Annotated[
        str,
        typer.Argument(help="Run folder, checkpoint, shipped network or .onnx matcher file."),
    ],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Output .onnx file in float32.")] = None,
    half: Annotated[Path | None, typer.Option(help="Output .onnx file in 16 bits.")] = None,
    eight_bits: Annotated[
        Path | None, typer.Option(help="Output .onnx file with 8-bit convolutions.")
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option(
            help="Output .pt file: a run's averaged weights in 16 bits, for start_from in a recipe."
        ),
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(
            metavar="WxH",
            help="Make files for single pairs of this size only, as TensorRT requires (default: any size).",
        ),
    ] = None,
    scenes: Annotated[
        Path | None,
        typer.Option(
            help="Folder, as for bench pairs, of further pairs on which ONNX Runtime and PyTorch must agree."
        ),
    ] = None,
    reliability: Annotated[
        Path | None, typer.Option(help="Output picture: reliability diagram of the confidence.")
    ] = None,
) -> None:
    """Export a trained network as matcher files for --model.

    Each file is checked to agree with the network on stereo pairs.
    Variants in 16 bits, in 8 bits or for one size are made from a trained network or from a matcher file.
    Each variant is compared with its source, and rejected if it differs too much.
    """
    from stereoweave.data.readers import read_scenes

    size_px = parse_size_px(size) if size else None
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
