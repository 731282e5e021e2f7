"""The commands `stereoweave bench pairs | collages | views | flicker | networks | parity | training`.

`submit` is in its own module.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from stereoweave.cli.commands import Commands, shows_steps
from stereoweave.cli.options import (
    Cluster,
    Model,
    Provider,
    Threads,
    make_engine,
    make_parent_folder,
    parse_size_px,
    require_synth_extra,
    require_train_extra,
)
from stereoweave.cli.submit import submit
from stereoweave.cli.tables import (
    FLICKER_TABLES,
    PAIRS_TABLES,
    VIEWS_TABLES,
    print_classes,
    print_means,
    write_and_print,
)
from stereoweave.errors import StereoweaveError

# Suffix of a network's name if its estimates are refined.
REFINED = " refined"

Classes = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Additional CSV file to write: errors by class of pixel (outside the right picture, occluded, "
        "near edges, plain, weakly textured and textured).",
    ),
]
ScenesFolder = Annotated[
    Path,
    typer.Argument(
        help="Folder with a subfolder per scene that contains left.png, right.png and disparity.png; "
        "or a set made by synth make."
    ),
]
Dataset = Annotated[
    str | None,
    typer.Option(
        help="Public dataset that the folder contains, unpacked as its authors distribute it. An unknown "
        "name lists them all."
    ),
]
Plot = Annotated[
    Path | None, typer.Option(help="Picture to write: errors against time. Needs the extra 'train'.")
]
SparsificationPlot = Annotated[
    Path | None,
    typer.Option(
        help="Picture to write: errors of the pixels that remain as the least confident ones are dropped. "
        "Needs the extra 'train'."
    ),
]
CsvFile = Annotated[Path, typer.Option("--out", "-o", help="CSV file to write.")]
HeldOutPairs = Annotated[
    Path | None,
    typer.Option(
        "--pairs",
        metavar="FOLDER",
        help="Folder of the held-out pairs; missing ones are created (default: pairs, beside RUN).",
    ),
]
Models = Annotated[
    list[str] | None,
    typer.Option(help="Network, as for stereoweave depth. Repeatable (default: all shipped networks)."),
]
MatcherNames = Annotated[
    list[str] | None,
    typer.Option(
        help="Classical matcher to score beside OpenCV's: adaptive_window, dynamic_programming or 3dmst. "
        "Repeatable. With it, networks are scored only if --model names them."
    ),
]
McCnn = Annotated[
    list[Path] | None,
    typer.Option(
        "--mc-cnn",
        metavar="FILE",
        help="MC-CNN with the weights of this PyTorch file, published ones or a checkpoint's. Repeatable. "
        "With it, networks are scored only if --model names them. Needs the extra 'train'.",
    ),
]

bench = Commands("Score matchers, new views, videos and trained networks.")
bench.command()(submit)


@bench.command()
@shows_steps
def pairs(  # noqa: PLR0913 - each is an option of the command line
    folder: ScenesFolder,
    out: CsvFile = Path("pairs.csv"),
    model: Models = None,
    matchers: MatcherNames = None,
    mc_cnn: McCnn = None,
    dataset: Dataset = None,
    plot: Plot = None,
    sparsification: SparsificationPlot = None,
    classes: Classes = None,
    cluster: Cluster = None,
    threads: Threads = None,
    provider: Provider = "cpu",
) -> None:
    """Score networks and classical matchers on known disparity.

    Scores cover errors, edges, confidence, time and memory. With --cluster, each scene is scored by one
    worker with --threads cores (default: 1), so that the times of all matchers on a scene are comparable.
    Memory is measured on this machine.
    """
    import cv2

    from stereoweave.bench.classical.matchers import make_classical_matcher
    from stereoweave.bench.opencv_matchers import SGBM
    from stereoweave.bench.pairs import add_memory, merge_makers, score_pairs
    from stereoweave.bench.tables import MEAN, write_csv
    from stereoweave.data.readers import list_scenes
    from stereoweave.system.threads import thread_count

    for file in filter(None, (out, classes)):
        make_parent_folder(file)
    _check_plots(plot, sparsification)
    engine = make_engine(cluster, cpus_each=threads or 1)
    threads = engine.threads_each if engine else threads
    cv2.setNumThreads(thread_count(threads))
    makers = merge_makers(
        {name: partial(make_classical_matcher, name) for name in matchers or ()},
        _list_mc_cnns(mc_cnn or [], threads),
        _list_makers(model, threads, provider) if model or not (matchers or mc_cnn) else {},
    )
    scores = score_pairs(makers, partial(list_scenes, folder.absolute(), dataset), engine)
    rows = add_memory(scores.rows, makers, scores.largest)
    write_csv(out, rows, scores.machine)
    means = [row for row in rows if row.scene == MEAN]
    if plot or sparsification:
        _draw_plots(plot, sparsification, means, {name: scores.curves[name] for name in (*makers, SGBM)})
    print_means(PAIRS_TABLES, "matcher", means)
    if classes:
        _write_classes(classes, scores)
    typer.echo(f"rows: {out}")


@bench.command()
@shows_steps
def collages(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the set, new or empty.")],
    pairs: Annotated[int, typer.Option(min=1, help="Number of pairs.")] = 16,
    seed: Annotated[
        int, typer.Option(min=0, help="Random seed; the default gives the pairs that trainings validate on.")
    ] = 1_000_003,
    size: Annotated[str, typer.Option(help="Width and height in pixels.")] = "384x256",
) -> None:
    """Write a set of held-out collages for bench pairs. They are painted like the training pairs."""
    with require_train_extra():
        from stereoweave.learn.data.collage_set import write_collages
    width_px, height_px = parse_size_px(size)
    write_collages(out, pairs, seed, (height_px, width_px))
    typer.echo(f"{out}: {pairs} pair{'s' * (pairs != 1)} made")


@bench.command()
@shows_steps
def views(  # noqa: PLR0913 - each is an option of the command line
    folder: Annotated[
        Path,
        typer.Argument(
            help="Folder with a subfolder per scene that contains left.png, right.png and one or more "
            "view_<position>.png; or a set made by synth make --view."
        ),
    ],
    out: CsvFile = Path("views.csv"),
    model: Models = None,
    cluster: Cluster = None,
    threads: Threads = None,
    provider: Provider = "cpu",
) -> None:
    """Score new views against reference pictures.

    Scores cover all pixels, smooth regions, depth edges and occluded pixels. With --cluster, each scene is
    scored by one worker with --threads cores (default: 1).
    """
    import cv2

    from stereoweave.bench.tables import MEAN, write_csv
    from stereoweave.bench.view_scenes import list_view_scenes
    from stereoweave.bench.views import score_view_scenes
    from stereoweave.system.threads import thread_count

    make_parent_folder(out)
    engine = make_engine(cluster, cpus_each=threads or 1)
    threads = engine.threads_each if engine else threads
    cv2.setNumThreads(thread_count(threads))
    scenes = partial(list_view_scenes, folder.absolute())
    scores = score_view_scenes(_list_makers(model, threads, provider), scenes, threads, engine)
    write_csv(out, scores.rows, scores.machine)
    print_means(VIEWS_TABLES, "method", [row for row in scores.rows if row.scene == MEAN])
    typer.echo(f"rows: {out}")


@bench.command()
@shows_steps
def flicker(  # noqa: PLR0913 - each is an option of the command line
    scenes: Annotated[
        list[str], typer.Argument(metavar="SCENE...", help="Names of scenes, as for synth make.")
    ],
    out: CsvFile = Path("flicker.csv"),
    model: Model = "small",
    frames: Annotated[int, typer.Option(min=2, max=120, help="Number of frames per video.")] = 12,
    threads: Threads = None,
    provider: Provider = "cpu",
) -> None:
    """Score the temporal filter on rendered videos with noise.

    Flicker and errors are measured with and without the filter.
    """
    make_parent_folder(out)
    with require_synth_extra():
        from stereoweave.bench.flicker import average_rows, score_flicker
    from stereoweave.bench.tables import write_csv

    rows = list(score_flicker(scenes, model, frames=frames, threads=threads, provider=provider))
    write_csv(out, rows)
    print_means(FLICKER_TABLES, "film", average_rows(rows))
    typer.echo(f"rows: {out}")


@bench.command()
@shows_steps
def networks(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN...", help="Run folders of stereoweave train, or checkpoints."),
    ],
    out: CsvFile = Path("networks.csv"),
    pairs: HeldOutPairs = None,
) -> None:
    """Score trained networks on their held-out pairs.

    Scores cover the disparities and the right views projected with them.
    """
    from rich.console import Console

    make_parent_folder(out)
    with require_train_extra():
        from stereoweave.learn.evaluation import evaluate
    rows = evaluate(runs, pairs or runs[0].parent / "pairs", Console())
    write_and_print(out, "Means over the held-out pairs", rows)


@bench.command()
@shows_steps
def parity(
    checkpoints: Annotated[
        list[Path],
        typer.Argument(metavar="CHECKPOINT...", help="Checkpoints of shipped networks, as in checkpoints/."),
    ],
    out: CsvFile = Path("parity.csv"),
) -> None:
    """Compare variants of shipped networks with PyTorch.

    Every variant runs on every provider that is available on this machine.
    """
    from stereoweave.bench.tables import write_csv

    make_parent_folder(out)
    with require_train_extra():
        from stereoweave.learn.export.parity import format_markdown, measure_parity
    rows = measure_parity(checkpoints)
    write_csv(out, rows)
    typer.echo(format_markdown(rows))
    typer.echo(f"rows: {out}")


@bench.command()
@shows_steps
def training(
    run: Annotated[
        Path,
        typer.Argument(
            help="Run folder of stereoweave train; or with --recipe, a run folder of recipes/gpu/train.py "
            "or a checkpoint."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="CSV file to write; rows of other runs are kept.")],
    recipe: Annotated[
        Path | None,
        typer.Option(
            metavar="RECIPE",
            help="Score the network on the held-out pairs and sets of this recipe.",
        ),
    ] = None,
    pairs: HeldOutPairs = None,
) -> None:
    """Record a run's learning curve, and fit power laws to it.

    The curve shows held-out scores against the number of pairs seen. With --recipe, one row is
    recorded, and nothing is fitted.
    """
    make_parent_folder(out)
    from rich.console import Console

    with require_train_extra():
        from stereoweave.learn.recipe import read_recipe
        from stereoweave.learn.training.curves import record_curve, record_network
    if pairs is not None and recipe is None:
        raise StereoweaveError("--pairs: expected only with --recipe, found without it")
    if recipe is not None:
        pairs = pairs or run.parent / "pairs"
        for name, score in record_network(run, read_recipe(recipe), pairs, out, Console()).items():
            typer.echo(f"{name}: {score:.5g}")
        return
    for name, law in record_curve(run, out).items():
        typer.echo(f"{name}: {law.at_10000_pairs:.4g} * (pairs / 10,000)^{-law.exponent:.3f}")


def _list_makers(
    models: Sequence[str] | None, threads: int | None, provider: str
) -> dict[str, Callable[[], Any]]:
    """Return factories of the named networks, also refined if they are not always. Default: all shipped."""
    from stereoweave.bench.pairs import make_matcher
    from stereoweave.matching.matcher import MODES, shipped_models

    makers: dict[str, Callable[[], Any]] = {}
    for name in models or shipped_models():
        # Absolute, because cluster workers have another current folder.
        model = str(Path(name).absolute()) if Path(name).is_file() else name
        makers[name] = partial(make_matcher, model, threads, provider=provider)
        if name not in MODES:  # they always refine
            makers[name + REFINED] = partial(make_matcher, model, threads, refined=True, provider=provider)
    return makers


def _list_mc_cnns(files: Sequence[Path], threads: int | None) -> dict[str, Callable[[], Any]]:
    """Return factories of MC-CNN with the weights of each file."""
    if not files:
        return {}
    with require_train_extra():
        from stereoweave.learn.mc_cnn_matcher import list_mc_cnns
    return list_mc_cnns(files, threads)


def _check_plots(*pictures: Path | None) -> None:
    """Fail before scoring starts if a plot cannot be drawn or written."""
    from stereoweave.io.images import picture_kind

    for picture in filter(None, pictures):
        picture_kind(picture)
        make_parent_folder(picture)
        with require_train_extra("a plot needs matplotlib"):
            from stereoweave.bench import plots as benchmark_plots  # noqa: F401 - checks that matplotlib is installed


def _draw_plots(
    plot: Path | None, sparsification: Path | None, means: Sequence[Any], curves: Mapping[str, Any]
) -> None:
    from stereoweave.bench import plots as benchmark_plots

    if plot:
        benchmark_plots.draw_error_over_time(plot, means)
    if sparsification:
        checked = [row.matcher for row in means if benchmark_plots.is_checked(row)]
        benchmark_plots.draw_sparsification(sparsification, curves, checked)


def _write_classes(file: Path, scores: Any) -> None:
    """Write errors by class, and print their means."""
    from stereoweave.bench.tables import MEAN, write_csv

    write_csv(file, scores.class_rows, scores.machine)
    print_classes([row for row in scores.class_rows if row.scene == MEAN])
    typer.echo(f"errors by class: {file}")
