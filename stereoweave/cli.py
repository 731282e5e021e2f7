"""The commands: stereoweave depth | measure | view | video | live | app | check | rectify | train, more."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from stereoweave import __version__
from stereoweave.bench_commands import bench
from stereoweave.command_line import needing_the_train_extra
from stereoweave.depth_commands import depth, measure
from stereoweave.errors import StereoweaveError
from stereoweave.live_commands import live
from stereoweave.page_commands import app as page
from stereoweave.rig_commands import calibrate, check, rectify
from stereoweave.synth_commands import synth
from stereoweave.video_commands import video
from stereoweave.view_commands import view

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
app.add_typer(bench, name="bench")
app.add_typer(synth, name="synth")


def main(arguments: Sequence[str] | None = None) -> int:
    """0 where the command line went well; 2 after a mistake of the caller's, told in one line on stderr."""
    try:
        return app(arguments, prog_name="stereoweave", standalone_mode=False) or 0
    except typer.TyperException as error:
        message = error.format_message().rstrip(".") + "; see stereoweave --help"
    except (StereoweaveError, OSError) as error:
        message = str(error)
    typer.echo("stereoweave: " + " ".join(message.splitlines()), err=True)
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


for command in (depth, measure, view, video, live, check, rectify, calibrate):
    app.command()(command)
app.command("app")(page)


@app.command()
def train(
    recipe: Annotated[Path, typer.Argument(help="A TOML file, such as recipes/weave_small.toml.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The folder of the run.")],
) -> None:
    """Train the network of a recipe; a run that was stopped continues where it was."""
    from stereoweave.learn.recipe import read_recipe

    read_recipe(recipe)  # what is wrong with it is said before PyTorch takes seconds to load
    with needing_the_train_extra():
        from stereoweave.learn.train import train as train_recipe
    train_recipe(recipe, out)


@app.command()
def export(
    run: Annotated[Path, typer.Argument(help="The folder of a run, or a checkpoint in it.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The .onnx file to write.")],
    scenes: Annotated[
        Path | None, typer.Option(help="Pairs on which both must agree too; a folder as for bench pairs.")
    ] = None,
    reliability: Annotated[
        Path | None, typer.Option(help="A picture to write: how often the confidence comes true.")
    ] = None,
    eight_bits: Annotated[
        Path | None, typer.Option(help="A second .onnx file to write, whose convolutions compute in 8 bits.")
    ] = None,
) -> None:
    """Turn a trained network into a file that --model takes, and prove that both agree."""
    from stereoweave.data.readers import read_scenes

    pairs = [scene.pair for scene in read_scenes(scenes)] if scenes else []
    with needing_the_train_extra():
        from stereoweave.learn.calibrate import draw_reliability
        from stereoweave.learn.export import export as export_run
    card = export_run(run, out, pairs)
    if reliability and "confidence" in card:
        draw_reliability(card["confidence"], reliability)
    typer.echo(
        f"{out}: ONNX Runtime and PyTorch differ by at most {card['onnx_differs_px']:.4f} px "
        f"over {1 + len(pairs)} pairs"
    )
    if eight_bits:
        from stereoweave.learn.quantise import quantise

        quantised = quantise(out, eight_bits)
        lost_px = quantised["epe_px"] - quantised["epe_px_of_32_bits"]
        typer.echo(f"{eight_bits}: 8 bits change the mean error by {lost_px:+.3f} px")
