"""Depth estimation for large numbers of pairs and videos, by workers on one or many machines.

Pictures and results are in folders or object stores. Parquet files hold the plan and the rows of each chunk
(`manifest`); this module distributes chunk numbers to the workers. Rerun the same command to resume after any
interruption; chunks that have rows are only checked, and all others are processed. In a folder, a second
concurrent run is refused. In an object store, two concurrent runs do all the work twice but damage nothing.
"""

import json
import platform
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from uuid import uuid4

import typer
from rich.console import Console

from stereoweave.batch.manifest import MANIFEST, PLAN, ChunkPlan, extend_plan
from stereoweave.batch.worker import BEGUN, ChunkWorker, Counts, remove_abandoned
from stereoweave.cameras.calibration_files import read_calibration_bytes
from stereoweave.errors import StereoweaveError
from stereoweave.io.files import reading
from stereoweave.io.output_lock import lock_output
from stereoweave.io.run_folder import check_claim, check_unclaimed, describe_run, parse_description
from stereoweave.io.stores import Store, store_at
from stereoweave.matching.providers import CPU
from stereoweave.outputs.results import DepthJob, job_facts
from stereoweave.pictures.pair_finding import BATCH_FILE
from stereoweave.system.progress import progress
from stereoweave.system.ray_engine import Engine, connect, count_slots, stream

# Ray Data keeps state per task. Above this number of chunks, several chunks share a task.
_MOST_TASKS = 2000


@dataclass(frozen=True)
class ClusterTally:
    """Counts of a batch.

    Attributes:
        made: Number of pairs and videos processed.
        there: Number of pairs and videos finished by earlier runs.
        failed: Number of pairs and videos that failed.
        named: Names and errors of the first failures.
        manifest: Path or URL of the folder of Parquet files that hold a row for each pair or video.
    """

    made: int
    there: int
    failed: int
    named: tuple[tuple[str, str], ...]
    manifest: str


def run_cluster(
    source: str | Path,
    destination: str | Path,
    job: DepthJob | None = None,
    engine: Engine | None = None,
    *,
    console: Console | None = None,
) -> ClusterTally:
    """Process every unfinished pair and video in the source, and write a row for each.

    Results are written to destination/name: for a pair, the files that `depth` writes for many pairs; for a
    video, its disparity as 16-bit grey in depth.mkv. All machines in a cluster must be able to access the
    source and the destination at the same paths or URLs.

    Args:
        source: A folder, or the URL of a folder in an object store.
        destination: A new folder or URL, or the folder or URL of an interrupted batch with the same job.
        job: Settings for each pair.
        engine: The cluster and its workers; default: this machine.
        console: Console for the progress bar; default: no progress bar.

    Raises:
        StereoweaveError: The source, the destination, the cluster, the model or the provider cannot be used
            or fails, or another run is writing to the destination. Finished results are kept; repeat the call
            to resume.
    """
    engine = engine or Engine()
    job = _adapt_job(job or DepthJob(), engine)
    console = console or Console(quiet=True)
    source_store, destination_store = _open_store(source), _open_store(destination)
    if job.backend.provider == CPU:
        replace(job.backend, threads=1).check()  # report an unknown model once, not for each pair
    source_store.check_source()
    destination_store.check_destination()
    with _lock_folder(destination_store), connect(engine):
        workers = count_slots(engine)
        _claim(destination_store, job, source_store)
        plan = extend_plan(source_store, destination_store, min(workers, engine.workers or workers))
        for note in plan.notes:
            console.print(note, markup=False, highlight=False, soft_wrap=True)
        files = tuple(_read_job_files(job))
        worker = ChunkWorker(source_store, destination_store, job, files, run=uuid4().hex)
        counts = _process_chunks(worker, plan, engine, console)
        _remove_abandoned_files(destination_store)
    return ClusterTally(
        counts.made, counts.there, counts.failed, counts.named, destination_store.at(MANIFEST)
    )


def run_cluster_command(
    source: str, destination: str, job: DepthJob, engine: Engine, *, as_json: bool = False
) -> int:
    """Run a batch, print its counts, and return the exit code: 0, 1 if a pair failed, or 130 after Ctrl-C."""
    try:
        tally = run_cluster(source, destination, job, engine, console=Console(stderr=True))
    except KeyboardInterrupt:
        kept = "finished results are kept; rerun the same command to resume"
        typer.echo(f"stereoweave: {destination}: stopped; {kept}", err=True)
        return 130
    if as_json:
        typer.echo(json.dumps({**asdict(tally), "named": dict(tally.named)}, indent=2))
    else:
        _print_counts(tally, destination)
    return 1 if tally.failed else 0


def _print_counts(tally: ClusterTally, destination: str) -> None:
    count = tally.made + tally.there + tally.failed
    there = f", {tally.there} already there" if tally.there else ""
    failed = f", {tally.failed} failed" if tally.failed else ""
    typer.echo(
        f"{destination}: {count} {'pair' if count == 1 else 'pairs'}: {tally.made} made{there}{failed}"
    )
    for name, error in tally.named:
        typer.echo(f"failed: {name}: {error}")
    if tally.failed > len(tally.named):
        typer.echo(f"failed: {tally.failed - len(tally.named)} more, listed in the manifest")
    typer.echo(f"manifest: {tally.manifest}")


def _process_chunks(worker: ChunkWorker, plan: ChunkPlan, engine: Engine, console: Console) -> Counts:
    """Process all chunks of a plan, and return their counts."""
    counts, start_s = Counts(), time.perf_counter()
    per_task = -(-len(plan.chunks) // _MOST_TASKS)
    tasks = [plan.chunks[first : first + per_task] for first in range(0, len(plan.chunks), per_task)]
    with closing(stream(partial(_check_folders, worker), tasks, engine)) as results, progress(console) as bar:
        shown = bar.add_task("depth", total=plan.count, loss="", rate="")
        for result in results:
            counts += result
            rate = f"{(counts.made + counts.failed) / (time.perf_counter() - start_s):.1f} pairs/s"
            failed = f"{counts.failed} failed" if counts.failed else ""
            bar.update(shown, completed=counts.all, rate=rate, loss=failed)
    return counts


def _check_folders(worker: ChunkWorker) -> ChunkWorker:
    """Return the worker; raise an error if this machine cannot access the source or destination folder."""
    try:
        for store in (worker.source, worker.destination):
            if store.folder is not None:
                store.check_source()
    except StereoweaveError as error:
        detailed = error.with_detail(
            "put the folder on a disk that all machines in the cluster share, or use an object store"
        )
        raise detailed.with_prefix(f"{platform.node()}: ") from error
    return worker


def _adapt_job(job: DepthJob, engine: Engine) -> DepthJob:
    """Return the job without the default report, and with the number of threads for one worker."""
    always = tuple(file for file in job.always if file != "report.html")
    return replace(job, always=always, backend=replace(job.backend, threads=engine.threads_each))


def _open_store(place: str | Path) -> Store:
    """Open a folder or URL as a store. Paths become absolute, as workers have different working folders."""
    store = store_at(place)
    return store if store.folder is None else store_at(store.folder.absolute())


def _lock_folder(destination: Store) -> AbstractContextManager[None]:
    """Lock the destination against a second run if it is a folder; object stores have no locks."""
    return lock_output(destination.folder) if destination.folder else nullcontext()


def _claim(destination: Store, job: DepthJob, source: Store) -> None:
    """Record the batch's settings in the destination, or check them against the recorded settings.

    Raises:
        StereoweaveError: The destination holds another batch or other files.
    """
    facts = {"made by": "stereoweave batch", "source": source.place, **job_facts(job)}
    if destination.exists(BATCH_FILE):
        place = destination.at(BATCH_FILE)
        text = destination.read_bytes(BATCH_FILE).decode("utf-8", "replace")
        check_claim(place, facts, parse_description(place, text, "the description of a batch"))
        return
    others = (file.path for file in islice(destination.files(), 1))
    check_unclaimed(destination.place, BATCH_FILE, others)
    destination.write_bytes(BATCH_FILE, describe_run(facts).encode())


def _read_job_files(job: DepthJob) -> Iterator[tuple[str, str, bytes]]:
    """Yield the kind, name and content of each job file that may not exist on other machines."""
    model, calibration = Path(job.backend.model), job.request.calibration
    if str(model).endswith(".onnx") and model.is_file():  # otherwise it is a shipped model
        with reading(model, "a model"):
            yield "model", model.name, model.read_bytes()
    if calibration and calibration.is_file():
        yield "calibration", calibration.name, read_calibration_bytes(calibration)


def _remove_abandoned_files(destination: Store) -> None:
    if destination.folder is not None:
        for below in ("", MANIFEST, PLAN, BEGUN):
            remove_abandoned(destination.folder / below)
