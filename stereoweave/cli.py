"""The commands: stereoweave depth | view | video | bench | synth | train | export."""

import json
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stereoweave import __version__
from stereoweave.bench_commands import bench
from stereoweave.command_line import (
    Model,
    Pictures,
    Threads,
    load_matcher,
    needing_the_train_extra,
    place_for,
    read_pictures,
)
from stereoweave.errors import StereoweaveError
from stereoweave.synth_commands import synth
from stereoweave.video_commands import video
from stereoweave.view_commands import view

if TYPE_CHECKING:
    from stereoweave.report import Summary
    from stereoweave.stereo import Estimate, StereoPair

FILES = ("disparity.pfm", "disparity.png", "depth.png", "preview.png", "confidence.png", "report.html")

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
    """Depth, and any view between the two cameras, from a rectified stereo pair."""


@app.command()
def depth(  # noqa: PLR0913 - each is a word of the command line
    pictures: Pictures,
    out: Annotated[Path, typer.Option("--out", "-o", help="The folder to write the results into.")],
    calib: Annotated[Path | None, typer.Option(help="Middlebury's calib.txt, for depth in metres.")] = None,
    model: Model = "small",
    threads: Threads = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Depth of a stereo pair: maps, pictures of them, and a report to open in a browser."""
    from stereoweave.hints import hints
    from stereoweave.report import summarize, write_report

    pair = read_pictures(pictures, calib)
    matcher = load_matcher(model, threads)
    with _results_in(out) as folder:
        start_s = time.perf_counter()
        estimate = matcher.estimate(pair.left, pair.right)
        estimate_ms = 1000 * (time.perf_counter() - start_s)
        names = tuple(picture.name for picture in pictures)
        summary = summarize(pair, estimate, pictures=names, model=model, estimate_ms=estimate_ms)
        notes = _write_maps(folder, pair, estimate, summary) + hints(pair, estimate, matcher)
        write_report(folder / "report.html", pair, estimate, summary, threads)
    (_tell_json if as_json else _tell)(summary, notes, out)


app.command()(view)
app.command()(video)


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


@contextmanager
def _results_in(out: Path) -> Iterator[Path]:
    """A temporary folder, whose files move into `out` in the end; after an error nothing of either is left.

    Files of an earlier result that this one does not have are removed, so that all in `out` belong together.
    """
    standing = place_for(*(out / file for file in FILES))
    with tempfile.TemporaryDirectory(prefix=".stereoweave-", dir=standing) as name:
        yield Path(name)
        out.mkdir(parents=True, exist_ok=True)
        for file in FILES:
            fresh = Path(name, file)
            fresh.replace(out / file) if fresh.exists() else (out / file).unlink(missing_ok=True)


def _write_maps(folder: Path, pair: "StereoPair", estimate: "Estimate", summary: "Summary") -> list[str]:
    """Writes every map and picture; the lines that say which of them could not be, and why."""
    from stereoweave.colour import colour_disparity, colour_range_px, grey_confidence
    from stereoweave.io import RangeError, write_depth_png, write_disparity_png, write_image, write_pfm

    notes = []
    write_pfm(folder / "disparity.pfm", estimate.disparity_px)
    try:
        write_disparity_png(folder / "disparity.png", estimate.disparity_px)
    except RangeError:
        notes.append(
            "no disparity.png: it holds 0 to 255.99 px, found "
            f"{summary.disparity_min_px:.2f} to {summary.disparity_max_px:.2f} px; disparity.pfm has them"
        )
    if pair.camera:
        write_depth_png(folder / "depth.png", pair.camera.depth_m(estimate.disparity_px))
    preview = colour_disparity(estimate.disparity_px, colour_range_px(estimate.disparity_px))
    write_image(folder / "preview.png", preview)
    write_image(folder / "confidence.png", grey_confidence(estimate.confidence))
    return notes


def _tell_json(summary: "Summary", notes: list[str], out: Path) -> None:
    files = {file: str(out / file) for file in FILES if (out / file).exists()}
    typer.echo(json.dumps(asdict(summary) | {"notes": notes, "files": files}, indent=2, allow_nan=False))


def _tell(summary: "Summary", notes: list[str], out: Path) -> None:
    size = f"{summary.width_px}x{summary.height_px} px"
    typer.echo(
        f"{' + '.join(summary.pictures)}: {size}, matched by {summary.model} in {summary.estimate_ms:.0f} ms"
    )
    typer.echo(f"disparity {summary.disparity_min_px:.1f} to {summary.disparity_max_px:.1f} px")
    for note in notes:
        typer.echo(note)
    typer.echo(f"report: {out / 'report.html'}")
