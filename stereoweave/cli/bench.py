"""The commands stereoweave bench pairs | collages | views | flicker | networks | parity | training."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from stereoweave.cli.options import (
    Cluster,
    Model,
    Provider,
    Threads,
    engine_of,
    needing_the_synth_extra,
    needing_the_train_extra,
    parse_size_px,
    place_for,
)
from stereoweave.cli.tables import (
    FLICKER_TABLES,
    PAIRS_TABLES,
    VIEWS_TABLES,
    print_classes,
    print_means,
    write_and_print,
)

# What is added to a network's name where `refining` comes after it.
REFINED = " refined"

Classes = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="A second CSV file to write: errors outside the right picture, where occluded, near edges, "
        "where plain, weakly textured, textured.",
    ),
]

bench = typer.Typer(help="Score matchers side by side.")


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
    classes: Classes = None,
    cluster: Cluster = None,
    threads: Threads = None,
    provider: Provider = "cpu",
) -> None:
    """Errors, edges, confidence, time and memory of networks and OpenCV's matchers on known disparity.

    With --cluster each scene is scored by one worker of --threads cores, 1 unless given, so that the times
    beside SGBM's stay comparable; the memory is measured here.
    """
    import cv2

    from stereoweave.bench.pairs import MEAN, score_pairs, with_memory, write_csv
    from stereoweave.data.readers import list_scenes
    from stereoweave.matching.opencv import SGBM
    from stereoweave.system.threads import thread_count

    for file in filter(None, (out, classes)):
        place_for(file)
    _check_plots(plot, sparsification)
    engine = engine_of(cluster, cpus_each=threads or 1)
    threads = engine.threads_each if engine else threads
    cv2.setNumThreads(thread_count(threads))
    makers = _makers(model, threads, provider)
    scores = score_pairs(makers, partial(list_scenes, folder.absolute(), dataset), engine)
    rows = with_memory(scores.rows, makers, scores.largest)
    write_csv(out, rows, scores.machine)
    means = [row for row in rows if row.scene == MEAN]
    if plot or sparsification:
        _draw_plots(plot, sparsification, means, {name: scores.curves[name] for name in (*makers, SGBM)})
    print_means(PAIRS_TABLES, "matcher", means)
    if classes:
        _write_classes(classes, scores)
    typer.echo(f"rows: {out}")


@bench.command()
def collages(
    out: Annotated[Path, typer.Option("--out", "-o", help="The folder of the set, new or empty.")],
    pairs: Annotated[int, typer.Option(min=1, help="How many.")] = 16,
    seed: Annotated[
        int, typer.Option(min=0, help="1000003 gives the pairs that trainings validate on.")
    ] = 1_000_003,
    size: Annotated[str, typer.Option(help="Width and height in pixels.")] = "384x256",
) -> None:
    """Write held-out collages, the painted pairs that networks train on, as a set that bench pairs reads."""
    with needing_the_train_extra():
        from stereoweave.learn.data.collage_set import write_collages
    width_px, height_px = parse_size_px(size)
    write_collages(out, pairs, seed, (height_px, width_px))
    typer.echo(f"{out}: {pairs} pair{'s' * (pairs != 1)} made")


@bench.command()
def views(  # noqa: PLR0913 - each is a word of the command line
    folder: Annotated[
        Path,
        typer.Argument(
            help="Holds a folder a scene, of left.png, right.png and view_<position>.png; or what "
            "synth make --view made."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="The CSV file to write.")] = Path("views.csv"),
    model: Annotated[
        list[str] | None,
        typer.Option(help="As for depth; may be given again. All shipped networks unless given."),
    ] = None,
    cluster: Cluster = None,
    threads: Threads = None,
    provider: Provider = "cpu",
) -> None:
    """Errors of new views against pictures taken there: all pixels, smooth ones, depth edges, hidden ones.

    With --cluster each scene is scored by one worker of --threads cores, 1 unless given.
    """
    import cv2

    from stereoweave.bench.pairs import MEAN, write_csv
    from stereoweave.bench.view_scenes import list_view_scenes
    from stereoweave.bench.views import score_scenes
    from stereoweave.system.threads import thread_count

    place_for(out)
    engine = engine_of(cluster, cpus_each=threads or 1)
    threads = engine.threads_each if engine else threads
    cv2.setNumThreads(thread_count(threads))
    scenes = partial(list_view_scenes, folder.absolute())
    scores = score_scenes(_makers(model, threads, provider), scenes, threads, engine)
    write_csv(out, scores.rows, scores.machine)
    print_means(VIEWS_TABLES, "method", [row for row in scores.rows if row.scene == MEAN])
    typer.echo(f"rows: {out}")


@bench.command()
def flicker(  # noqa: PLR0913 - each is a word of the command line
    scenes: Annotated[list[str], typer.Argument(metavar="SCENE...", help="As for synth make.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The CSV file to write.")] = Path("flicker.csv"),
    model: Model = "small",
    frames: Annotated[int, typer.Option(min=2, max=120, help="Of each film.")] = 12,
    threads: Threads = None,
    provider: Provider = "cpu",
) -> None:
    """What steadying is worth: flicker and errors of depth with it and without, on rendered noisy films."""
    place_for(out)
    with needing_the_synth_extra():
        from stereoweave.bench.flicker import flicker_rows, means
    from stereoweave.bench.pairs import write_csv

    rows = list(flicker_rows(scenes, model, frames=frames, threads=threads, provider=provider))
    write_csv(out, rows)
    print_means(FLICKER_TABLES, "film", means(rows))
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

    place_for(out)
    with needing_the_train_extra():
        from stereoweave.learn.evaluation import evaluate
    rows = evaluate(runs, pairs or runs[0].parent / "pairs", Console())
    write_and_print(out, "Means over the held-out pairs", rows)


@bench.command()
def parity(
    checkpoints: Annotated[
        list[Path], typer.Argument(metavar="CHECKPOINT...", help="Of shipped networks, as in checkpoints/.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="The CSV file to write.")] = Path("parity.csv"),
) -> None:
    """How far every variant of shipped networks is from PyTorch, on every provider that is here."""
    from stereoweave.bench.pairs import write_csv

    place_for(out)
    with needing_the_train_extra():
        from stereoweave.learn.export.parity import markdown
        from stereoweave.learn.export.parity import parity as measured
    rows = measured(checkpoints)
    write_csv(out, rows)
    typer.echo(markdown(rows))
    typer.echo(f"rows: {out}")


@bench.command()
def training(
    run: Annotated[Path, typer.Argument(help="The folder of a run of stereoweave train.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The CSV file; rows of other runs in it stay.")],
) -> None:
    """Learning curve of a run: its held-out scores against the pairs seen, and the power laws they follow."""
    place_for(out)
    with needing_the_train_extra():
        from stereoweave.learn.training.curves import record_curve
    for name, law in record_curve(run, out).items():
        typer.echo(f"{name}: {law.at_10000_pairs:.4g} * (pairs / 10,000)^-{law.exponent:.3f}")


def _makers(models: Sequence[str] | None, threads: int | None, provider: str) -> dict[str, Callable[[], Any]]:
    """What makes each network, as it is and refined; all shipped ones unless some are named."""
    from stereoweave.bench.pairs import network
    from stereoweave.matching.matcher import MODES, shipped_models

    makers: dict[str, Callable[[], Any]] = {}
    for name in models or shipped_models():
        # A worker of a cluster has another current folder.
        model = str(Path(name).absolute()) if Path(name).is_file() else name
        makers[name] = partial(network, model, threads, provider=provider)
        if name not in MODES:  # which refine by themselves
            makers[name + REFINED] = partial(network, model, threads, refined=True, provider=provider)
    return makers


def _check_plots(*pictures: Path | None) -> None:
    """Fail before anything is scored where a picture cannot be drawn or written."""
    from stereoweave.io.files import picture_kind

    for picture in filter(None, pictures):
        picture_kind(picture)
        place_for(picture)
        with needing_the_train_extra("a plot needs matplotlib"):
            from stereoweave.bench import plots as benchmark_plots  # noqa: F401 - imported to see that it can be


def _draw_plots(
    plot: Path | None, sparsification: Path | None, means: Sequence[Any], curves: Mapping[str, Any]
) -> None:
    from stereoweave.bench import plots as benchmark_plots

    if plot:
        benchmark_plots.draw_error_over_time(plot, means)
    if sparsification:
        benchmark_plots.draw_sparsification(sparsification, curves)


def _write_classes(file: Path, scores: Any) -> None:
    """Write the errors by class, and print their means."""
    from stereoweave.bench.pairs import MEAN, write_csv

    write_csv(file, scores.class_rows, scores.machine)
    print_classes([row for row in scores.class_rows if row.scene == MEAN])
    typer.echo(f"errors by class: {file}")
