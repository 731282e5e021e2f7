"""Worker that processes the pairs in a chunk of a large batch and then writes their rows.

A chunk in progress is marked in the destination. A mark that already exists was left by a killed worker, and
one of the chunk's pairs may have been the cause. The pairs are then processed in a child process, which can
be killed without stopping the worker.
"""

import errno
import functools
import json
import multiprocessing
import platform
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from stereoweave.batch.manifest import PlanEntry, read_chunk, read_rows, write_rows
from stereoweave.errors import Note, OutputInUseError, ProviderError, Remedy, StereoweaveError, format_error
from stereoweave.io.files import is_leftover
from stereoweave.io.images import SMALLEST_SIDE_PX
from stereoweave.io.stores import Store
from stereoweave.matching.matcher import Matcher
from stereoweave.outputs.results import DepthJob, make_depth
from stereoweave.system.processes import begin_work

ManifestRow = dict[str, Any]

BEGUN = "begun"
FILM = "depth.mkv"
_NAMED_FAILURES = 5
# The pair is not always at fault: a process may also be killed because other processes need memory.
_MOST_TRIES = 3
# An error is raised after this many consecutive processes are killed during startup.
_MOST_FALSE_STARTS = 10
_KILLED_ERROR = "its process was killed on every attempt; did it run out of memory?"
# Newer files may belong to a running worker.
_ABANDONED_AFTER_S = 600
_DISK_ERRNOS = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.ESTALE}


@dataclass(frozen=True)
class Counts:
    """Counts of pairs and videos by outcome.

    Attributes:
        made: Number of pairs and videos processed.
        there: Number of pairs and videos finished by earlier runs.
        failed: Number of pairs and videos that failed.
        named: Names and errors of the first failures.
    """

    made: int = 0
    there: int = 0
    failed: int = 0
    named: tuple[tuple[str, str], ...] = ()

    def __add__(self, other: "Counts") -> "Counts":
        named = (*self.named, *other.named)[:_NAMED_FAILURES]
        return Counts(self.made + other.made, self.there + other.there, self.failed + other.failed, named)

    @property
    def all(self) -> int:
        """The total number of pairs and videos."""
        return self.made + self.there + self.failed


@dataclass(frozen=True)
class ChunkWorker:
    """Callable that processes planned pairs and videos.

    Attributes:
        source: Store of the pictures and videos.
        destination: Store of the plan, the rows and the results.
        job: Settings for each pair.
        job_files: Kind (`model` or `calibration`), name and content of each job file that may exist only on
            the driver's machine.
        run: Identifier of the run. Pairs that failed in another run are tried again.
    """

    source: Store
    destination: Store
    job: DepthJob
    job_files: tuple[tuple[str, str, bytes], ...] = ()
    run: str = ""

    def __call__(self, chunks: Sequence[int]) -> Counts:
        """Process the unfinished pairs in several chunks, and return the counts of all pairs."""
        return sum(map(self.make_chunk, chunks), Counts())

    def make_chunk(self, chunk: int) -> Counts:
        """Process the missing, failed and changed pairs in a chunk, write the rows, and return the counts."""
        entries, rows = read_chunk(self.destination, chunk), read_rows(self.destination, chunk)
        missing = [entry for entry in entries if not self._is_done(entry, rows.get(entry.name))]
        mark = f"{BEGUN}/{chunk:08d}.json"
        rows |= {row["pair"]: row for row in self._make_rows(missing, mark)}
        if missing or rows.keys() != {entry.name for entry in entries}:
            write_rows(self.destination, chunk, [rows[entry.name] for entry in entries])
            self.destination.remove(mark)
        errors = ((entry.name, rows[entry.name]["error"]) for entry in missing)
        failed = tuple((name, error) for name, error in errors if error)
        there = len(entries) - len(missing)
        return Counts(len(missing) - len(failed), there, len(failed), failed[:_NAMED_FAILURES])

    def _is_done(self, entry: PlanEntry, row: ManifestRow | None) -> bool:
        return row is not None and not row["error"] and self._is_current(entry, row)

    def _is_current(self, entry: PlanEntry, row: ManifestRow) -> bool:
        """Return whether a row was made from the current files and all its results exist."""
        if tuple(row["versions"]) != entry.versions:
            return False
        folder = entry.name
        there = {file.path.removeprefix(f"{folder}/") for file in self.destination.files(folder)}
        return there.issuperset(row["files"])

    def _make_rows(self, missing: Sequence[PlanEntry], mark: str) -> list[ManifestRow]:
        """Process pairs and return their rows; use a child process if an earlier worker was killed."""
        if not missing:
            return []
        if self.destination.exists(mark):
            return self._make_rows_in_child(missing, mark)
        self.destination.write_bytes(mark, b"{}")
        return [self.make_row(entry) for entry in missing]

    def _make_rows_in_child(self, missing: Sequence[PlanEntry], mark: str) -> list[ManifestRow]:
        """Process pairs in a child process, each with a limited number of attempts; return their rows."""
        tries, rows = self._read_attempts(mark)
        with _RowProcess(self) as child:
            for entry in missing:
                if entry.name in rows and self._is_current(entry, rows[entry.name]):
                    continue
                row = None
                while row is None and tries.get(entry.name, 0) < _MOST_TRIES:
                    child.start()
                    tries[entry.name] = tries.get(entry.name, 0) + 1
                    marked = {"run": self.run, "tries": tries, "rows": list(rows.values())}
                    self.destination.write_bytes(mark, json.dumps(marked).encode())
                    row = child.make_row(entry)
                rows[entry.name] = row or self._make_empty_row(entry) | {"error": _KILLED_ERROR}
        return list(rows.values())

    def _read_attempts(self, mark: str) -> tuple[dict[str, int], dict[str, ManifestRow]]:
        """Return the number of attempts at each pair, and the rows, that killed workers have left in a mark.

        Of another run, only the rows of pairs that did not fail.
        """
        marked = self._read_mark(mark)
        rows = {row["pair"]: row for row in marked.get("rows", [])}
        if marked.get("run", self.run) == self.run:
            return marked.get("tries", {}), rows
        return {}, {name: row for name, row in rows.items() if not row["error"]}

    def _read_mark(self, mark: str) -> dict[str, Any]:
        try:
            return json.loads(self.destination.read_bytes(mark))
        except ValueError:  # another run has just removed the mark, or a power failure damaged it
            return {}

    def make_row(self, entry: PlanEntry) -> ManifestRow:
        """Process a pair or video and return its row, which records any error that concerns only this pair.

        Raises:
            StereoweaveError: The source, the destination or the provider fails for every pair.
        """
        start_s = time.perf_counter()
        row, job = self._make_empty_row(entry), self._loaded_job
        with tempfile.TemporaryDirectory(prefix="stereoweave-") as name:
            try:
                if entry.is_film:
                    row |= self._process_video(entry, Path(name), job)
                else:
                    row |= self._process_pair(entry, Path(name), job)
            except _StoreError:
                raise
            except Exception as error:  # a library may raise any error on a bad picture; other pairs continue
                self._check_disk(error)
                if any(isinstance(cause, ProviderError) for cause in _list_causes(error)):
                    _check_provider(job.backend.matcher())
                kind = "" if isinstance(error, StereoweaveError) else f"{type(error).__name__}: "
                line = kind + format_error(error, job.name_of).replace(f"{name}/pictures", self.source.place)
                row["error"] = " ".join(line.split())
        return row | {"seconds": round(time.perf_counter() - start_s, 3)}

    def _make_empty_row(self, entry: PlanEntry) -> ManifestRow:
        empty = dict.fromkeys(
            ("disparity_min_px", "disparity_median_px", "disparity_max_px", "confident_percent")
        )
        names = [file.rpartition("/")[2] for file in entry.files]
        row = {"pair": entry.name, "pictures": names, "versions": list(entry.versions)}
        return (
            row
            | empty
            | {"width_px": None, "height_px": None, "seconds": None, "error": None}
            | {
                "checks": [],
                "files": [],
            }
        )

    def _process_pair(self, entry: PlanEntry, scratch: Path, job: DepthJob) -> ManifestRow:
        pictures, calibration = self._fetch(entry, scratch / "pictures")
        job = replace(job, request=job.request.complete(calibration))
        with self._open_results(entry, scratch) as out:
            made = make_depth(pictures, out, job, owns_out=True)
        summary = made.summary
        return {
            "disparity_min_px": summary.disparity_min_px,
            "disparity_median_px": summary.disparity_median_px,
            "disparity_max_px": summary.disparity_max_px,
            "confident_percent": summary.confident_percent,
            "width_px": summary.width_px,
            "height_px": summary.height_px,
            "checks": [note.format(job.name_of) for note in made.all_notes],
            "files": _list_names(out),
        }

    def _process_video(self, entry: PlanEntry, scratch: Path, job: DepthJob) -> ManifestRow:
        from rich.console import Console

        from stereoweave.io.animation import require_video_extra

        with require_video_extra("a video"):
            from stereoweave.video.calibration import rectify_if_it_fits
            from stereoweave.video.convert import convert_video
            from stereoweave.video.job import VideoJob
            from stereoweave.video.parts import parts_folder
            from stereoweave.video.reader import open_video

        films, _ = self._fetch(entry, scratch / "pictures")
        film_job = VideoJob(
            depth16=True,
            rectify=job.request.rectify is not False,
            backend=job.backend,
            name_of=job.name_of,
        )
        video = open_video(films, job.request.format, sphere=job.request.sphere)
        video = rectify_if_it_fits(video, job.request.calibration, rectify=job.request.rectify)
        with self._open_results(entry, scratch) as out:
            make = partial(convert_video, video, films, out / FILM, film_job, Console(quiet=True))
            begun = parts_folder(out / FILM)
            was_begun = begun.exists()
            try:
                tally = make()
            except StereoweaveError as error:
                self._check_disk(error)
                kept = ProviderError | OutputInUseError
                if not was_begun or any(isinstance(cause, kept) for cause in _list_causes(error)):
                    raise
                # A killed worker left these parts: they are damaged, or were made from other files.
                shutil.rmtree(begun, ignore_errors=True)
                tally = make()
        width, height = video.size_px
        checks = [
            *(
                note.format(job.name_of)
                for note in _note_unused_settings(job, calibrated=video.rig is not None)
            ),
            *tally.notes,
            *tally.named,
        ]
        return {"width_px": width, "height_px": height, "checks": checks, "files": _list_names(out)}

    def _fetch(self, entry: PlanEntry, into: Path) -> tuple[tuple[Path, ...], Path | None]:
        """Copy the files and the calibration to this machine, and return their paths."""
        try:
            files = tuple(self.source.fetch(file, into) for file in entry.files)
            return files, self.source.fetch(entry.calibration, into) if entry.calibration else None
        except StereoweaveError:
            with _convert_store_errors():
                self.source.check_source()
            raise  # the store works, so the file is at fault

    @contextmanager
    def _open_results(self, entry: PlanEntry, scratch: Path) -> Iterator[Path]:
        """Yield a folder for the results; then upload them if the destination is an object store."""
        if self.destination.folder is not None:
            folder = self.destination.folder / entry.name
            remove_abandoned(folder)
            yield folder
            return
        folder = scratch / "results"
        folder.mkdir()
        yield folder
        with _convert_store_errors():
            stored = {file.path for file in self.destination.files(entry.name)}
            fresh = {f"{entry.name}/{name}": folder / name for name in _list_names(folder)}
            for path, file in fresh.items():
                self.destination.put(file, path)
            for stale in stored - fresh.keys():
                self.destination.remove(stale)

    def _check_disk(self, error: Exception) -> None:
        """Raise an error if a disk is full or unavailable, because all further pairs would fail too."""
        if any(isinstance(cause, OSError) and cause.errno in _DISK_ERRNOS for cause in _list_causes(error)):
            raise _StoreError.from_error(error).with_prefix(f"{self.destination.place}: ") from error

    @functools.cached_property
    def _loaded_job(self) -> DepthJob:
        """The job with local copies of its files and with its network loaded.

        If the model file is replaced later, the loaded network stays in use.
        """
        job = self.job
        for kind, name, content in self.job_files:
            path = _write_job_file(name, content)
            if kind == "model":
                job = replace(job, backend=replace(job.backend, model=str(path)))
            else:
                job = replace(job, request=replace(job.request, calibration=path))
        return replace(job, backend=job.backend.pin())

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without the loaded job, because networks cannot be pickled."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


def _note_unused_settings(job: DepthJob, *, calibrated: bool) -> list[Note]:
    """Return a list with a note on the settings that are for pairs only, if any are given."""
    for_pairs = {
        "calibration": job.request.calibration is not None and not calibrated,
        "focal_px": job.request.focal_px is not None,
        "baseline_m": job.request.baseline_m is not None,
        "range_px": job.options.range_px is not None,
        "refined": job.options.refined,
        "raw": job.options.raw,
        "files": bool(job.files),
    }
    given = tuple(setting for setting, is_given in for_pairs.items() if is_given)
    if not given:
        return []
    return [Note("some settings were not used for this video", Remedy("they apply to pairs only", given))]


class _StoreError(StereoweaveError):
    """Error for a source or destination that fails as a whole."""


@contextmanager
def _convert_store_errors() -> Iterator[None]:
    try:
        yield
    except StereoweaveError as error:
        raise _StoreError.from_error(error) from error


class _RowProcess:
    """A child process that processes pairs, and is restarted whenever it is killed."""

    def __init__(self, worker: ChunkWorker) -> None:
        self._worker = worker
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> "_RowProcess":
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool:
            self._pool.shutdown()

    def start(self) -> None:
        """Start the process unless it is running, and wait until it has loaded the network."""
        false_starts = 0
        while self._pool is None:
            threads = self._worker.job.backend.threads or 1
            pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), begin_work, (threads,))
            try:
                pool.submit(_load_worker, self._worker).result()
                self._pool = pool
            except BrokenProcessPool as error:
                false_starts += 1
                if false_starts == _MOST_FALSE_STARTS:
                    raise StereoweaveError(
                        f"{platform.node()}: the child process was killed {false_starts} times in a row "
                        "while loading the network; did it run out of memory?"
                    ) from error
            finally:
                if self._pool is None:
                    pool.shutdown()

    def make_row(self, entry: PlanEntry) -> ManifestRow | None:
        """Process a pair or video in the child process; return its row, or None if the process was killed."""
        assert self._pool is not None
        try:
            return self._pool.submit(_make_row_in_child, entry).result()
        except BrokenProcessPool:
            self._pool.shutdown()
            self._pool = None
            return None


# The worker that this child process runs.
_child_worker: ChunkWorker | None = None


def _load_worker(worker: ChunkWorker) -> None:
    """Store a worker in this child process, and load its network.

    Loading is a separate step so that a failure does not count as an attempt at a pair.
    """
    global _child_worker
    _child_worker = worker
    worker._loaded_job  # noqa: B018 - loads the network


def _make_row_in_child(entry: PlanEntry) -> ManifestRow:
    """Process a pair or video with this child process's worker, and return its row."""
    assert _child_worker is not None
    return _child_worker.make_row(entry)


@functools.cache
def _write_job_file(name: str, content: bytes) -> Path:
    """Write a job file to this machine's disk, and return its path.

    The file is removed when this process exits.
    """
    path = Path(_make_scratch_folder().name, name)
    path.write_bytes(content)
    return path


@functools.cache
def _make_scratch_folder() -> "tempfile.TemporaryDirectory[str]":
    return tempfile.TemporaryDirectory(prefix="stereoweave-")


def remove_abandoned(folder: Path) -> None:
    """Remove old temporary files that killed workers left in a folder."""
    for path in folder.glob(".*"):
        with suppress(FileNotFoundError):
            if time.time() - path.stat().st_mtime < _ABANDONED_AFTER_S:
                continue
            if path.name.startswith(".stereoweave-"):
                shutil.rmtree(path, ignore_errors=True)
            elif is_leftover(path):
                path.unlink()


def _check_provider(matcher: Matcher) -> None:
    """Raise an error if the provider fails even on the smallest pair.

    Such a failure cannot be due to the pair's size.
    """
    plain = np.zeros((SMALLEST_SIDE_PX, SMALLEST_SIDE_PX, 3), np.uint8)
    matcher.estimate(plain, plain)


def _list_causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error, then its chain of causes."""
    while error is not None:
        yield error
        error = error.__cause__


def _list_names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name[0] != "." and path.is_file())
