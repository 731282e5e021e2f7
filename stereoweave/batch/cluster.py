"""Depth of very many pairs and films, by workers on one machine or many, in folders or object stores.

What is to be made and what came of it is in Parquet files by chunks (`manifest`); here are their numbers.
A run that was stopped in whatever way goes on with the same command: chunks whose rows are written are looked
through, and all others made. On a disk a second run is refused while one goes on; in an object store two at
once do everything twice, and harm nothing.
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

import typer
from rich.console import Console

from stereoweave.batch.manifest import MANIFEST, PLAN, ChunkPlan, extend_plan
from stereoweave.batch.worker import BEGUN, Counts, Worker, remove_left_behind
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
from stereoweave.system.ray_engine import Engine, connect, room, stream

# Ray Data remembers something of each task; chunks beyond so many share one.
_MOST_TASKS = 2000


@dataclass(frozen=True)
class ClusterTally:
    """How a batch ended.

    Attributes:
        made: How many pairs and films were made.
        there: How many were there before.
        failed: How many failed.
        named: Names and reasons of the first failed ones.
        manifest: Path or URL of the folder of Parquet files that has a row for each.
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
    """Makes the results of every pair and film in the source that are not there yet, and a row for each.

    Of a pair it makes what `depth` makes of many, of a film depth.mkv, its disparity in 16-bit grey; each in
    destination/name. On a cluster both places have to be seen by all machines, under the same names.

    Args:
        source: A folder, or the URL of one in an object store.
        destination: A new one, or one that the same job was begun in.
        job: What is made of each pair.
        engine: Where.
        console: Where progress is shown; nowhere unless given.

    Raises:
        StereoweaveError: A place, the cluster, the network or the provider cannot be used, or not any more,
            or another run writes to the destination. What is made stays, and the same call goes on.
    """
    engine = engine or Engine()
    job = _for_many(job or DepthJob(), engine)
    console = console or Console(quiet=True)
    read_from, write_to = _store(source), _store(destination)
    if job.backend.provider == CPU:
        replace(job.backend, threads=1).matcher()  # an unknown network is one error, not one for each pair
    read_from.check_source()
    write_to.check_destination()
    with _alone(write_to), connect(engine):
        workers = room(engine)
        _claim(write_to, job, read_from)
        plan = extend_plan(read_from, write_to, min(workers, engine.workers or workers))
        for note in plan.notes:
            console.print(note, markup=False, highlight=False, soft_wrap=True)
        worker = Worker(read_from, write_to, job, tuple(_carried(job)))
        counts = _run(worker, plan, engine, console)
        _tidy(write_to)
    return ClusterTally(counts.made, counts.there, counts.failed, counts.named, write_to.at(MANIFEST))


def batch_on_cluster(
    source: str, destination: str, job: DepthJob, engine: Engine, *, as_json: bool = False
) -> int:
    """Makes a batch and tells how it went; the exit code: 1 if a pair failed, 130 if Ctrl-C ended it."""
    try:
        tally = run_cluster(source, destination, job, engine, console=Console(stderr=True))
    except KeyboardInterrupt:
        kept = "what is finished stays, and the same command goes on"
        typer.echo(f"stereoweave: {destination}: stopped; {kept}", err=True)
        return 130
    if as_json:
        typer.echo(json.dumps({**asdict(tally), "named": dict(tally.named)}, indent=2))
    else:
        _tell(tally, destination)
    return 1 if tally.failed else 0


def _tell(tally: ClusterTally, destination: str) -> None:
    count = tally.made + tally.there + tally.failed
    there = f", {tally.there} were there" if tally.there else ""
    failed = f", {tally.failed} failed" if tally.failed else ""
    typer.echo(
        f"{destination}: {count} {'pair' if count == 1 else 'pairs'}: {tally.made} made{there}{failed}"
    )
    for name, error in tally.named:
        typer.echo(f"failed: {name}: {error}")
    if tally.failed > len(tally.named):
        typer.echo(f"failed: {tally.failed - len(tally.named)} more, in the manifest")
    typer.echo(f"manifest: {tally.manifest}")


def _run(worker: Worker, plan: ChunkPlan, engine: Engine, console: Console) -> Counts:
    """Makes all chunks of a plan."""
    counts, start_s = Counts(), time.perf_counter()
    of_each = -(-len(plan.chunks) // _MOST_TASKS)
    tasks = [plan.chunks[first : first + of_each] for first in range(0, len(plan.chunks), of_each)]
    with closing(stream(partial(_ready, worker), tasks, engine)) as results, progress(console) as bar:
        shown = bar.add_task("depth", total=plan.count, loss="", rate="")
        for result in results:
            counts += result
            rate = f"{(counts.made + counts.failed) / (time.perf_counter() - start_s):.1f} pairs/s"
            failed = f"{counts.failed} failed" if counts.failed else ""
            bar.update(shown, completed=counts.all, rate=rate, loss=failed)
    return counts


def _ready(worker: Worker) -> Worker:
    """The worker, on a machine that sees both places."""
    try:
        for store in (worker.source, worker.destination):
            if store.folder is not None:
                store.check_source()
    except StereoweaveError as error:
        raise StereoweaveError(
            f"{platform.node()}: {error}; all machines of a cluster need it on a disk that they share, "
            "or take an object store"
        ) from error
    return worker


def _for_many(job: DepthJob, engine: Engine) -> DepthJob:
    """The job without reports, unless they are asked for, with the threads that a worker has to itself."""
    always = tuple(file for file in job.always if file != "report.html")
    return replace(job, always=always, backend=replace(job.backend, threads=engine.threads_each))


def _store(place: str | Path) -> Store:
    """The store of a place; workers have other working folders, so a path is made absolute."""
    store = store_at(place)
    return store if store.folder is None else store_at(store.folder.absolute())


def _alone(destination: Store) -> AbstractContextManager[None]:
    """Keeps a second run out of a folder on a disk; an object store has no locks."""
    return lock_output(destination.folder) if destination.folder else nullcontext()


def _claim(destination: Store, job: DepthJob, source: Store) -> None:
    """Writes down whose folder this is, or refuses one that is another's."""
    facts = {"made by": "stereoweave batch", "source": source.place, **job_facts(job)}
    if destination.exists(BATCH_FILE):
        place = destination.at(BATCH_FILE)
        text = destination.read_bytes(BATCH_FILE).decode("utf-8", "replace")
        check_claim(place, facts, parse_description(place, text, "the description of a batch"))
        return
    others = (file.path for file in islice(destination.files(), 1))
    check_unclaimed(destination.place, BATCH_FILE, others)
    destination.write_bytes(BATCH_FILE, describe_run(facts).encode())


def _carried(job: DepthJob) -> Iterator[tuple[str, str, bytes]]:
    """The job's own files, which workers on other machines cannot read: kind, name and content."""
    model, calibration = Path(job.backend.model), job.request.calibration
    if str(model).endswith(".onnx") and model.is_file():  # else a name that they all know
        with reading(model, "a model"):
            yield "model", model.name, model.read_bytes()
    if calibration and calibration.is_file():
        yield "calibration", calibration.name, read_calibration_bytes(calibration)


def _tidy(destination: Store) -> None:
    if destination.folder is not None:
        for below in ("", MANIFEST, PLAN, BEGUN):
            remove_left_behind(destination.folder / below)
