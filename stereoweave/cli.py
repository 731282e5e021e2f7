"""The commands: stereoweave depth | view | bench | synth | train | export."""

import json
import math
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stereoweave import __version__
from stereoweave.errors import StereoweaveError
from stereoweave.synth_commands import synth

if TYPE_CHECKING:
    from stereoweave.benchmark import Row
    from stereoweave.matcher import Matcher
    from stereoweave.report import Summary
    from stereoweave.stereo import Estimate, StereoPair

FILES = ("disparity.pfm", "disparity.png", "depth.png", "preview.png", "confidence.png", "report.html")

# What stereoweave bench pairs shows of its rows, by heading and column.
PAIRS_TABLES = {
    "Errors, mean over the scenes": {
        "EPE px": "epe_px",
        "bad-1 %": "bad1_percent",
        "bad-2 %": "bad2_percent",
        "D1 %": "d1_percent",
        "edge EPE": "edge_epe_px",
        "edge bad-1": "edge_bad1_percent",
        "flying %": "flying_percent",
    },
    "Cost and confidence, mean over the scenes": {
        "ms": "time_ms",
        "x SGBM": "time_relative",
        "RAM MB": "memory_mb",
        "AUSE px": "ause_px",
        "AUSE %": "ause_bad1_percent",
        "calibr. error": "calibration_error",
    },
}

Pictures = Annotated[
    list[Path],
    typer.Argument(
        metavar="PICTURE",
        help="LEFT RIGHT, rectified and of one size; or one picture with both side by side.",
    ),
]
Model = Annotated[str, typer.Option(help="The name of a shipped network, or an .onnx file.")]
Threads = Annotated[int | None, typer.Option(min=1, help="Processor threads; as many as cores unless given.")]

RecipeFile = Annotated[
    Path, typer.Argument(metavar="RECIPE", help="A TOML file, such as recipes/paper/experiment.toml.")
]
RunsFolder = Annotated[Path, typer.Option("--out", "-o", help="The folder of the trainings.")]
ReportFolder = Annotated[Path, typer.Option(help="The folder for rows, tables and figures.")]
Seeds = Annotated[int, typer.Option(min=1, help="How often each training is repeated.")]
Jobs = Annotated[int, typer.Option(min=1, help="Trainings at a time.")]

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
bench = typer.Typer(help="Score matchers side by side.")
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

    pair = _read(pictures, calib)
    matcher = _matcher(model, threads)
    with _results_in(out) as folder:
        start_s = time.perf_counter()
        estimate = matcher.estimate(pair.left, pair.right)
        estimate_ms = 1000 * (time.perf_counter() - start_s)
        names = tuple(picture.name for picture in pictures)
        summary = summarize(pair, estimate, pictures=names, model=model, estimate_ms=estimate_ms)
        notes = _write_maps(folder, pair, estimate, summary) + hints(pair, estimate, matcher)
        write_report(folder / "report.html", pair, estimate, summary, threads)
    (_tell_json if as_json else _tell)(summary, notes, out)


@app.command()
def view(  # noqa: PLR0913 - each is a word of the command line
    pictures: Pictures,
    out: Annotated[Path, typer.Option("--out", "-o", help="The picture to write.")],
    position: Annotated[
        float, typer.Option(help="The viewpoint: 0 is the left camera, 1 the right; -0.5 to 1.5.")
    ] = 0.5,
    model: Model = "small",
    threads: Threads = None,
) -> None:
    """A new view of a stereo pair, from between its two cameras or a little beyond them."""
    from stereoweave.hints import hints
    from stereoweave.io import picture_kind, write_image
    from stereoweave.rendering import check_position, render

    check_position(position)
    picture_kind(out)
    _place_for(out)
    pair = _read(pictures)
    matcher = _matcher(model, threads)
    estimate = matcher.estimate(pair.left, pair.right)
    new = render(pair.left, pair.right, estimate, position, threads)
    write_image(out, new.image)
    typer.echo(f"{out}: view at {position:g}, {100 * (~new.drawn).mean():.1f} % of it seen by neither camera")
    for hint in hints(pair, estimate, matcher):
        typer.echo(hint)


@bench.command()
def pairs(  # noqa: PLR0913 - each is a word of the command line
    folder: Annotated[
        Path,
        typer.Argument(
            help="Holds a folder a scene, of left.png, right.png, disparity.png; or what synth make made."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="The CSV file to write.")] = Path("pairs.csv"),
    model: Annotated[
        list[str] | None,
        typer.Option(help="As for depth; may be given again. All shipped networks unless given."),
    ] = None,
    dataset: Annotated[
        str | None, typer.Option(help="The folder holds this dataset, as its authors' archives unpack.")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(help="A picture to write: errors against time. Extra 'train'.")
    ] = None,
    sparsification: Annotated[
        Path | None, typer.Option(help="A picture to write: errors by confidence. Extra 'train'.")
    ] = None,
    threads: Threads = None,
) -> None:
    """Errors, edges, confidence, time and memory of networks and OpenCV's matchers on known disparity."""
    from functools import partial

    import cv2

    from stereoweave.benchmark import MEAN, network, score_pairs, with_memory, write_csv
    from stereoweave.data.readers import read_scenes
    from stereoweave.io import picture_kind
    from stereoweave.matcher import shipped_models
    from stereoweave.opencv_matchers import SGBM
    from stereoweave.threads import thread_count

    _place_for(out)
    for picture in filter(None, (plot, sparsification)):
        picture_kind(picture)
        _place_for(picture)
        with _needing_the_train_extra("a plot needs matplotlib"):
            from stereoweave import benchmark_plots
    scenes = read_scenes(folder, dataset)
    cv2.setNumThreads(thread_count(threads))
    makers = {name: partial(network, name, threads) for name in model or shipped_models()}
    scores = score_pairs(makers, scenes)
    rows = with_memory(scores.rows, makers, scores.largest)
    write_csv(out, rows)
    means = [row for row in rows if row.scene == MEAN]
    if plot:
        benchmark_plots.draw_error_over_time(plot, means)
    if sparsification:
        benchmark_plots.draw_sparsification(
            sparsification, {name: scores.curves[name] for name in (*makers, SGBM)}
        )
    _tell_rows(means)
    typer.echo(f"rows: {out}")


@bench.command()
def networks(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN...", help="Folders of stereoweave train, or checkpoints."),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="The CSV file to write.")] = Path("networks.csv"),
    pairs: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Where kept pairs are, or are made; beside the first run unless given.",
        ),
    ] = None,
) -> None:
    """Errors of trained networks on the pairs held out from them, and of the right views made with them."""
    from rich.console import Console

    _place_for(out)
    with _needing_the_train_extra():
        from stereoweave.learn.evaluation import evaluate
    rows = evaluate(runs, pairs or runs[0].parent / "pairs", Console())
    _write_and_tell(out, "Means over the held-out pairs", rows)


@bench.command()
def speed(
    recipe: RecipeFile,
    out: Annotated[Path, typer.Option("--out", "-o", help="The CSV file to write.")] = Path("speed.csv"),
) -> None:
    """Time of the paper's network and its rivals for a pair of 640x480, in PyTorch and in ONNX Runtime."""
    from stereoweave.learn.recipe import read_recipe

    _place_for(out)
    read = read_recipe(recipe)
    with _needing_the_train_extra():
        from stereoweave.learn.speed import run_times
    _write_and_tell(out, "A pair of 640x480", run_times(read))


@bench.command()
def costs(
    runs: Annotated[list[Path], typer.Argument(help="Folders of runs, or checkpoints in them.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="A CSV file to write, too.")] = None,
) -> None:
    """What every stage of trained WeaveNets costs: multiply-adds, bytes moved, time; a Markdown table.

    The last columns compare it with the peak, a large matrix product measured in the same run.
    """
    from stereoweave.benchmark import write_csv

    if out:
        _place_for(out)
    with _needing_the_train_extra():
        from stereoweave.learn.costs import markdown, stage_costs
    rows = stage_costs(runs)
    if out:
        write_csv(out, rows)
    typer.echo(markdown(rows))


@bench.command()
def paper(
    recipe: RecipeFile,
    out: RunsFolder,
    report: ReportFolder,
    seeds: Seeds = 3,
    jobs: Jobs = 1,
) -> None:
    """The paper's experiment: train its network, its rivals and every variant, and compare with its tables.

    Stopped and started again it goes on where it was.
    """
    from stereoweave.learn.trials import CLAIMS

    _experiment(recipe, out, report, seeds, jobs, CLAIMS)


@bench.command()
def ablations(
    recipe: RecipeFile,
    out: RunsFolder,
    report: Annotated[
        Path,
        typer.Option(
            help="The CSV file to write, a row a training. Rows of other recipes are dropped, those of the "
            "same are taken as they are: remove the file after a change of code."
        ),
    ],
    rendered: Annotated[
        Path, typer.Option(metavar="FOLDER", help="Held-out pairs of stereoweave synth make.")
    ] = Path("runs/synth_val/rooms"),
    seeds: Seeds = 2,
) -> None:
    """WeaveNet's choices made otherwise, one at a time: train each, score it on collages and rendered pairs.

    Stopped and started again it goes on where it was.
    """
    from rich.console import Console

    from stereoweave.learn.recipe import read_recipe

    base = read_recipe(recipe)
    _place_for(report)
    with _needing_the_train_extra():
        from stereoweave.learn.ablations import plan, run_ablations
    run_ablations(plan(base, seeds), out, rendered, report, Console())
    typer.echo(f"rows: {report}")


@bench.command()
def exponent(
    recipe: RecipeFile,
    out: RunsFolder,
    report: ReportFolder,
    seeds: Seeds = 3,
    jobs: Jobs = 1,
) -> None:
    """The paper's Fig. 2: the curves of the depth adjustment, and the validation loss with and without it."""
    from stereoweave.learn.trials import ADJUSTMENT

    _experiment(recipe, out, report, seeds, jobs, (ADJUSTMENT,))


def _experiment(  # noqa: PLR0913 - the words of two command lines
    recipe: Path, out: Path, report: Path, seeds: int, jobs: int, claims: Sequence[str]
) -> None:
    from rich.console import Console

    from stereoweave.learn.recipe import read_recipe

    base, console = read_recipe(recipe), Console()
    with _needing_the_train_extra():
        from stereoweave.learn.paper import plan, run_trials
        from stereoweave.learn.paper_report import write_report
    planned = plan(base, out, seeds, console, claims)
    run_trials(planned, out, jobs, console)
    write_report(base, planned, out, report)
    typer.echo(f"tables: {report / 'paper.md'}")


@app.command()
def train(
    recipe: Annotated[Path, typer.Argument(help="A TOML file, such as recipes/weave_small.toml.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The folder of the run.")],
) -> None:
    """Train the network of a recipe; a run that was stopped continues where it was."""
    from stereoweave.learn.recipe import read_recipe

    read_recipe(recipe)  # what is wrong with it is said before PyTorch takes seconds to load
    with _needing_the_train_extra():
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
    with _needing_the_train_extra():
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


def _read(pictures: list[Path], calib: Path | None = None) -> "StereoPair":
    from stereoweave.io import calibrated, read_pair, read_side_by_side

    match pictures:
        case [left, right]:
            pair = read_pair(left, right)
        case [both]:
            pair = read_side_by_side(both)
        case _:
            names = " ".join(map(str, pictures))
            raise StereoweaveError(
                f"expected LEFT RIGHT or SIDE_BY_SIDE, one or two pictures, found {len(pictures)}: {names}"
            )
    return calibrated(pair, calib) if calib else pair


def _matcher(model: str, threads: int | None) -> "Matcher":
    from stereoweave.matcher import Matcher

    return Matcher(model, threads=threads)


@contextmanager
def _results_in(out: Path) -> Iterator[Path]:
    """A temporary folder, whose files move into `out` in the end; after an error nothing of either is left.

    Files of an earlier result that this one does not have are removed, so that all in `out` belong together.
    """
    standing = _place_for(*(out / file for file in FILES))
    with tempfile.TemporaryDirectory(prefix=".stereoweave-", dir=standing) as name:
        yield Path(name)
        out.mkdir(parents=True, exist_ok=True)
        for file in FILES:
            fresh = Path(name, file)
            fresh.replace(out / file) if fresh.exists() else (out / file).unlink(missing_ok=True)


def _place_for(*files: Path) -> Path:
    """The nearest folder above files of one folder that is there, tried; an error if a file is a folder."""
    from stereoweave.io import make_folder

    for file in files:
        if file.is_dir():
            raise StereoweaveError(f"{file}: expected a file that can be written, found a folder")
    return make_folder(next(path for path in files[0].parents if path.exists()))


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


def _tell_rows(rows: "list[Row]") -> None:
    """Print the means in two tables, since one would be wider than a terminal."""
    from rich.console import Console
    from rich.table import Column, Table

    for title, columns in PAIRS_TABLES.items():
        numbers = (Column(name, justify="right") for name in columns)
        table = Table(Column("matcher", no_wrap=True), *numbers, title=title)
        for row in rows:
            cells = [getattr(row, field) for field in columns.values()]
            table.add_row(Path(row.matcher).name, *("–" if math.isnan(x) else f"{x:.2f}" for x in cells))
        Console().print(table)


def _write_and_tell(out: Path, title: str, rows: Sequence[Any]) -> None:
    """Write dataclass rows as CSV, print them as a table, and name the file."""
    from stereoweave.benchmark import write_csv

    write_csv(out, rows)
    _tell_table(title, rows)
    typer.echo(f"rows: {out}")


def _tell_table(title: str, rows: Sequence[Any]) -> None:
    """Print dataclass rows as a table, under their fields' names; nothing is cut to fit a terminal."""
    from rich.console import Console
    from rich.table import Column, Table

    table = Table(*(Column(name, overflow="fold") for name in asdict(rows[0])), title=title)
    for row in rows:
        cells = asdict(row).values()
        table.add_row(*(f"{cell:.2f}" if isinstance(cell, float) else str(cell) for cell in cells))
    Console().print(table)


@contextmanager
def _needing_the_train_extra(what: str = "this command needs PyTorch and its company") -> Iterator[None]:
    try:
        yield
    except ModuleNotFoundError as missing:
        raise StereoweaveError(
            f"{what}, found no module {missing.name}; "
            "install the extra 'train': pip install 'stereoweave[train]', from the wheel or the copy you have"
        ) from missing
