"""The command `stereoweave bench submit`."""

from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stereoweave.cli.commands import running_options, shows_steps
from stereoweave.cli.options import Model, Provider, Refined, Threads

if TYPE_CHECKING:
    from stereoweave.bench.submission_formats import Submission

_MOST_PROBLEMS = 20


BenchmarkFolder = Annotated[
    Path,
    typer.Argument(
        help="Folder of the unpacked archives of KITTI 2012, KITTI 2015, Middlebury v3 or ETH3D two-view."
    ),
]
ArchiveFile = Annotated[Path, typer.Option("--out", "-o", help="Archive to write, a new .zip file.")]
BenchmarkName = Annotated[
    str | None,
    typer.Option(
        help="Benchmark: kitti2012, kitti2015, middlebury_v3 or eth3d (default: detected from the folder)."
    ),
]
TrainingOnly = Annotated[
    bool,
    typer.Option(
        "--training-only",
        help="Leave out the test pairs. Middlebury and ETH3D accept that; KITTI takes test pairs only.",
    ),
]
Resolution = Annotated[
    str | None,
    typer.Option(
        metavar="LETTER",
        help="Size of Middlebury's pictures, F, H or Q (default: the only one in the folder).",
    ),
]
Method = Annotated[
    str | None,
    typer.Option(
        metavar="NAME", help="Name of the method in Middlebury's file names (default: Stereoweave)."
    ),
]
CheckedArchive = Annotated[
    Path | None,
    typer.Option(
        metavar="ARCHIVE",
        help="Check an archive, written by this command or another program, and write nothing. The exit "
        "status is 1 if its site would not accept it.",
    ),
]


@shows_steps
def submit(  # noqa: PLR0913 - each is an option of the command line
    folder: BenchmarkFolder,
    out: ArchiveFile = Path("submission.zip"),
    model: Model = "best",
    refined: Refined = False,
    dataset: BenchmarkName = None,
    training_only: TrainingOnly = False,
    resolution: Resolution = None,
    method: Method = None,
    check: CheckedArchive = None,
    threads: Threads = None,
    provider: Provider = "cpu",
) -> None:
    """Write a submission to KITTI, Middlebury or ETH3D.

    All pairs are matched, and the disparity maps and times are packed and checked as the benchmark's site
    expects them. Rerun the same command to resume.
    """
    from rich.console import Console

    from stereoweave.bench.submission_check import read_method
    from stereoweave.bench.submission_formats import DEFAULT_METHOD, Submission
    from stereoweave.bench.submissions import check_new_archive, write_submission
    from stereoweave.data.benchmarks import BENCHMARKS, Choice, find_benchmark, list_benchmark
    from stereoweave.matching.backend import Backend

    name = find_benchmark(folder, dataset)
    pairs = list_benchmark(folder, name, Choice(training_only=training_only, resolution=resolution))
    if check is not None:
        _check(check, Submission(dataset=name, pairs=pairs, method=method or read_method(check, name)))
        return
    submission = Submission(dataset=name, pairs=pairs, method=method or DEFAULT_METHOD)
    check_new_archive(out)
    for note in _list_missing(submission):
        typer.echo(f"stereoweave: warning: {note}", err=True)
    backend = Backend(model=model, threads=threads, provider=provider)
    try:
        written = write_submission(out, submission, backend, refined=refined, console=Console(stderr=True))
    except KeyboardInterrupt:
        kept = "finished pairs are kept; rerun the same command to resume"
        typer.echo(f"stereoweave: {out}: stopped; {kept}", err=True)
        raise typer.Exit(130) from None
    there = f", {written.resumed} already there" if written.resumed else ""
    typer.echo(
        f"{out}: {BENCHMARKS[name].title}, {written.made} pair{'s' * (written.made != 1)} matched{there}, "
        f"{written.mean_time_s:.3g} s per pair"
    )


def _list_missing(submission: "Submission") -> list[str]:
    from stereoweave.data.benchmarks import describe_missing_pairs

    notes = describe_missing_pairs(submission.dataset, submission.pairs)
    return [note.format(running_options()) for note in notes]


def _check(archive: Path, submission: "Submission") -> None:
    """Print the first problems of an archive; the exit status is 1 if there are any."""
    from stereoweave.bench.submission_check import find_problems
    from stereoweave.data.benchmarks import BENCHMARKS

    problems = chain(_list_missing(submission), find_problems(archive, submission))
    shown = list(islice(problems, _MOST_PROBLEMS))
    more = sum(1 for _ in problems)
    if shown:
        typer.echo("\n".join([*shown, *([f"and {more} more"] if more else [])]))
        raise typer.Exit(1)
    count = len(submission.pairs)
    title = BENCHMARKS[submission.dataset].title
    typer.echo(f"{archive}: {count} pair{'s' * (count != 1)}, as {title} expects them")
