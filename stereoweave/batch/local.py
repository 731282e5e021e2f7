"""Depth estimation for many pairs by several processes; an interrupted batch can be resumed.

A pair is finished once its folder has `done.json`, which is written last and records the pictures and a
summary. `batch.json` records the settings of the whole batch.
"""

import functools
import json
import multiprocessing
import os
import shutil
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import typer
from rich.console import Console

from stereoweave.errors import StereoweaveError
from stereoweave.io.files import make_folder, reading, remove_leftovers, replacing
from stereoweave.io.output_lock import lock_output
from stereoweave.io.run_folder import check_claim, check_unclaimed, describe_run, parse_description
from stereoweave.io.text import write_table
from stereoweave.matching.backend import Backend, PinnedBackend
from stereoweave.outputs.results import DepthJob, job_facts, make_depth
from stereoweave.pictures.pair_finding import BATCH_FILE, SUMMARY_FILE, FoundPairs, NamedPair
from stereoweave.system.processes import begin_work
from stereoweave.system.progress import progress
from stereoweave.system.threads import usable_cores

_BLAS_THREADS = "OPENBLAS_NUM_THREADS"
DONE_FILE = "done.json"
_NUMBERS = ("disparity_min_px", "disparity_median_px", "disparity_max_px", "confident_percent")
_COLUMNS = ("name", "pictures", "seconds", *_NUMBERS, "warnings", "notes", "error")

# Number of pairs with warnings that are named; the table has all.
_MOST_NAMED = 5

Work = Callable[[NamedPair], str | None]
# A pair and its error, which is None on success.
Outcome = tuple[NamedPair, str | None]


@dataclass(frozen=True)
class LocalTally:
    """Counts of a batch.

    Attributes:
        done: Number of pairs processed.
        skipped: Number of pairs finished by earlier runs.
        failed: Name and error of each failed pair.
        warned: Names of the pairs in the folder whose results have warnings.
    """

    done: int
    skipped: int
    failed: tuple[tuple[str, str], ...]
    warned: tuple[str, ...]


def run_batch(
    pairs: Sequence[NamedPair],
    out: Path,
    job: DepthJob,
    *,
    processes: int | None = None,
    console: Console,
) -> LocalTally:
    """Process every unfinished pair, write its results to `out`/name, and write summary.csv.

    A pair that fails, or whose process is killed, is reported at once; the others continue. summary.csv has a
    row for each pair in the folder, including failed pairs and pairs from earlier runs.

    Args:
        pairs: Pairs to process unless they are finished.
        out: A new folder, or the folder of an interrupted batch with the same job.
        job: Settings for each pair.
        processes: Number of processes; default: one per core. Several processes use one thread each unless
            the job sets the number of threads.
        console: Console for progress and failures.

    Raises:
        StereoweaveError: `out` holds another batch or other files, is in use, or cannot be written to. Also
            raised if the model is unknown or the provider is unavailable.
    """
    processes = min(processes or usable_cores(), max(len(pairs), 1))
    if processes > 1 and job.backend.threads is None:
        job = replace(job, backend=replace(job.backend, threads=1))
    # Report an unknown model or an unavailable provider once, not for each pair.
    replace(job.backend, threads=1).check()
    threads = job.backend.threads
    make_folder(out)
    with lock_output(out):
        _claim(out, job)
        missing = [pair for pair in pairs if not _is_finished(out / pair.name, pair)]
        try:
            failed = _process_pairs(
                functools.partial(_process_pair, out, job), missing, processes, threads, console
            )
        finally:
            _remove_abandoned_files(out)
        rows = _write_summary(out, pairs, dict(failed))
    warned = tuple(row["name"] for row in rows if row.get("warnings"))
    return LocalTally(len(missing) - len(failed), len(pairs) - len(missing), tuple(failed), warned)


def run_batch_command(
    found: FoundPairs, out: Path, job: DepthJob, *, processes: int | None = None, as_json: bool = False
) -> int:
    """Run a batch, print its counts, and return the exit code: 0, 1 if a pair failed, or 130 after Ctrl-C.

    Reports are written only if the job's files include `report.html` or `all`, because writing a report takes
    as long as writing all other files together.
    """
    job = replace(job, always=tuple(file for file in job.always if file != "report.html"))
    for note in found.notes:
        typer.echo(note, err=True)
    try:
        tally = run_batch(found.pairs, out, job, processes=processes, console=Console(stderr=True))
    except KeyboardInterrupt:
        kept = "finished results are kept; rerun the same command to resume"
        typer.echo(f"stereoweave: {out}: stopped; {kept}", err=True)
        return 130
    if as_json:
        facts = {**asdict(tally), "failed": dict(tally.failed), "summary": str(out / SUMMARY_FILE)}
        typer.echo(json.dumps(facts, indent=2))
    else:
        _print_counts(tally, out)
    return 1 if tally.failed else 0


def _print_counts(tally: LocalTally, out: Path) -> None:
    count = tally.done + tally.skipped + len(tally.failed)
    there = f", {tally.skipped} already there" if tally.skipped else ""
    failed = f", {len(tally.failed)} failed" if tally.failed else ""
    typer.echo(f"{out}: {count} {'pair' if count == 1 else 'pairs'}: {tally.done} made{there}{failed}")
    for name, error in tally.failed:
        typer.echo(f"failed: {name}: {error}")
    if tally.warned:
        shown = ", ".join(tally.warned[:_MOST_NAMED]) + (", ..." if len(tally.warned) > _MOST_NAMED else "")
        typer.echo(f"with warnings: {len(tally.warned)} ({shown}); see the column warnings of the table")
    typer.echo(f"table: {out / SUMMARY_FILE}")


def _process_pairs(
    work: Work, pairs: Sequence[NamedPair], processes: int, threads: int | None, console: Console
) -> list[tuple[str, str]]:
    """Process all pairs, show each failure at once, and return the names and errors of the failed pairs."""
    failed: list[tuple[str, str]] = []
    start_s = time.perf_counter()
    with closing(_collect_outcomes(work, pairs, processes, threads)) as outcomes, progress(console) as bar:
        shown = bar.add_task("depth", total=len(pairs), loss="", rate="")
        for made, (pair, error) in enumerate(outcomes, 1):
            if error:
                failed.append((pair.name, error))
                line = f"{pair.name}: {error}"
                console.print(line, markup=False, highlight=False, soft_wrap=True)
            rate = f"{made / (time.perf_counter() - start_s):.1f} pairs/s"
            bar.update(shown, advance=1, rate=rate, loss=f"{len(failed)} failed" if failed else "")
    return failed


def _collect_outcomes(
    work: Work, pairs: Sequence[NamedPair], processes: int, threads: int | None
) -> Generator[Outcome, None, None]:
    """Yield the outcome of each pair as soon as the pair is finished.

    After a process is killed, each pair that was in progress is processed again on its own, to find the pair
    that is responsible.
    """
    waiting = deque(pairs)
    while waiting:
        for pair in (yield from _process_until_killed(work, waiting, processes, threads)):
            if (yield from _process_until_killed(work, deque([pair]), 1, threads)):
                yield pair, "its process was killed; did it run out of memory?"


def _process_until_killed(
    work: Work, waiting: deque[NamedPair], processes: int, threads: int | None
) -> Generator[Outcome, None, list[NamedPair]]:
    """Yield the outcomes of the waiting pairs until a process is killed; return those still in progress."""
    pending: dict[Future[str | None], NamedPair] = {}
    with _start_pool(processes, threads or usable_cores()) as pool:
        try:
            while waiting or pending:
                # Submit only one pair per process, so that few pairs are in progress if a process is killed.
                while waiting and len(pending) < processes:
                    pending[pool.submit(work, waiting[0])] = waiting[0]
                    waiting.popleft()
                finished, _ = wait(pending, return_when=FIRST_COMPLETED)
                for future in sorted(finished, key=lambda future: future.exception() is not None):
                    error = future.result()
                    yield pending.pop(future), error
        except BrokenProcessPool:
            pass
    return list(pending.values())


@contextmanager
def _start_pool(processes: int, threads: int) -> Iterator[ProcessPoolExecutor]:
    """Yield a pool of processes; if an error occurs, terminate the processes."""
    others = multiprocessing.active_children()
    # Spawn the processes, because the threads of OpenCV and ONNX Runtime are in an unknown state in a forked
    # child.
    context = multiprocessing.get_context("spawn")
    with (
        _limit_blas_threads(threads),
        ProcessPoolExecutor(processes, context, begin_work, (threads,)) as pool,
    ):
        try:
            yield pool
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for child in multiprocessing.active_children():
                if child not in others:
                    child.terminate()
                    child.join()
            raise


@contextmanager
def _limit_blas_threads(threads: int) -> Iterator[None]:
    """Limit the threads of OpenBLAS, NumPy's matrix library, in processes started within the block.

    OpenBLAS reads an environment variable once, when it is loaded. After each matrix product, its threads
    busy-wait, and would thus slow down the other processes.
    """
    before = os.environ.get(_BLAS_THREADS)
    os.environ[_BLAS_THREADS] = str(threads)
    try:
        yield
    finally:
        os.environ.pop(_BLAS_THREADS)
        if before is not None:
            os.environ[_BLAS_THREADS] = before


def _process_pair(out: Path, job: DepthJob, pair: NamedPair) -> str | None:
    """Process a pair and mark it as finished; return its error as one line, or None on success."""
    try:
        folder, sources = out / pair.name, _describe_sources(pair)
        job = replace(job, backend=_pin(job.backend))
        (folder / DONE_FILE).unlink(missing_ok=True)
        job = replace(job, request=job.request.complete(pair.calibration))
        start_s = time.perf_counter()
        made = make_depth(pair.pictures, folder, job, owns_out=True)
        seconds = round(time.perf_counter() - start_s, 3)
        files = sorted(path.name for path in folder.iterdir() if path.name[0] != ".")
        facts = {"sources": sources, "files": files, "seconds": seconds, "summary": asdict(made.summary)}
        for kind, notes in (("notes", made.notes), ("warnings", made.warnings)):
            facts[kind] = [note.format(job.name_of) for note in notes]
        with replacing(folder / DONE_FILE) as temporary:
            temporary.write_text(json.dumps(facts), encoding="utf-8")
    except StereoweaveError as error:
        return " ".join(error.format(job.name_of).split())
    except Exception as error:  # a library may raise any error on a bad picture; other pairs continue
        return " ".join(f"{type(error).__name__}: {error}".split())
    return None


@functools.lru_cache(maxsize=1)
def _pin(backend: Backend) -> PinnedBackend:
    """Load the network once in this process, and keep it even if the model file is replaced."""
    return backend.pin()


def _describe_sources(pair: NamedPair) -> list[list[Any]]:
    """Return the name, size and modification time of each of a pair's files, to detect changes."""
    sources = []
    for path in (*pair.pictures, *([pair.calibration] if pair.calibration else [])):
        with reading(path, "a picture"):
            status = path.stat()
        sources.append([path.name, status.st_size, status.st_mtime_ns])
    return sources


def _is_finished(folder: Path, pair: NamedPair) -> bool:
    facts = _read_done(folder)
    try:
        return bool(facts) and facts["sources"] == _describe_sources(pair)
    except StereoweaveError:
        return False


def _read_done(folder: Path) -> dict[str, Any]:
    """Return the content of a pair's `done.json`, or {} if the pair is unfinished or lacks a result file."""
    try:
        facts = json.loads((folder / DONE_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return facts if all((folder / file).exists() for file in facts["files"]) else {}


def _claim(out: Path, job: DepthJob) -> None:
    """Record the batch's settings in the folder; raise an error if it holds another batch or other files."""
    facts, path = job_facts(job), out / BATCH_FILE
    if path.exists():
        expected = "the description of a batch made by stereoweave depth"
        with reading(path, expected):
            found = parse_description(path, path.read_text(encoding="utf-8"), expected)
        check_claim(path, facts, found)
    else:
        check_unclaimed(out, BATCH_FILE, (entry.name for entry in out.iterdir() if entry.name[0] != "."))
        with replacing(path) as temporary:
            temporary.write_text(describe_run(facts), encoding="utf-8")
    _remove_abandoned_files(out)


def _remove_abandoned_files(out: Path) -> None:
    """Remove temporary files left by killed processes; call this only while no process is writing."""
    # A pair that is made again has its temporary files in its own folder.
    for folder in chain(out.glob(".stereoweave-*"), out.glob("*/.stereoweave-*")):
        shutil.rmtree(folder, ignore_errors=True)
    remove_leftovers(out)


def _write_summary(out: Path, pairs: Sequence[NamedPair], failed: dict[str, str]) -> list[dict[str, Any]]:
    """Write a row for each pair in the folder, sorted by name. Returns the rows."""
    pictures = {pair.name: pair.pictures for pair in pairs}
    rows = {folder.parent.name: _read_row(folder.parent) for folder in out.glob(f"*/{DONE_FILE}")}
    rows |= {
        name: {"name": name, "pictures": " + ".join(path.name for path in pictures[name]), "error": error}
        for name, error in failed.items()
    }
    written = [rows[name] for name in sorted(rows) if rows[name]]
    write_table(out / SUMMARY_FILE, _COLUMNS, written)
    return written


def _read_row(folder: Path) -> dict[str, Any]:
    """Return the summary row of a pair, or {} if the pair is unfinished."""
    if not (facts := _read_done(folder)):
        return {}
    row = {name: facts["summary"][name] for name in _NUMBERS}
    row |= {"name": folder.name, "pictures": " + ".join(facts["summary"]["pictures"])}
    lines = {kind: "; ".join(facts[kind]) for kind in ("notes", "warnings")}
    return row | {"seconds": facts["seconds"], **lines}
