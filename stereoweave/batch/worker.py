"""One worker of a large batch: processes the pairs of a chunk, then writes their rows.

A chunk is marked as begun in the meantime. A mark found at the start was left by a killed worker, and one of
its pairs may be the cause. The chunk's pairs are then processed in a child process, which may be killed in
the worker's place.
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

from stereoweave.batch.manifest import Planned, read_chunk, read_rows, write_rows
from stereoweave.errors import OutputInUseError, ProviderError, StereoweaveError, format_error
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
# A process may also be killed because others need memory.
_MOST_TRIES = 3
# Consecutive processes that may be killed during startup before it is an error.
_MOST_FALSE_STARTS = 10
_KILLED = "its process was killed every time; is the memory full?"
# Younger files may belong to a running worker.
_LEFT_BEHIND_S = 600
_FULL_OR_GONE = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.ESTALE}


@dataclass(frozen=True)
class Counts:
    """Numbers of pairs and videos processed, finished before and failed; `named` has the first failures."""

    made: int = 0
    there: int = 0
    failed: int = 0
    named: tuple[tuple[str, str], ...] = ()

    def __add__(self, other: "Counts") -> "Counts":
        named = (*self.named, *other.named)[:_NAMED_FAILURES]
        return Counts(self.made + other.made, self.there + other.there, self.failed + other.failed, named)

    @property
    def all(self) -> int:
        """Sum of all three."""
        return self.made + self.there + self.failed


@dataclass(frozen=True)
class Worker:
    """Processes planned pairs and videos.

    Attributes:
        source: The pictures and videos.
        destination: Holds plan, rows and results.
        job: Settings for each pair.
        carried: The job's files that only the driver may have: kind (`model` or `calibration`), name and
            content.
    """

    source: Store
    destination: Store
    job: DepthJob
    carried: tuple[tuple[str, str, bytes], ...] = ()

    def __call__(self, chunks: Sequence[int]) -> Counts:
        """Process the missing pairs of several chunks."""
        return sum(map(self.make_chunk, chunks), Counts())

    def make_chunk(self, chunk: int) -> Counts:
        """Process a chunk's missing, failed and changed pairs, and write its rows."""
        planned, rows = read_chunk(self.destination, chunk), read_rows(self.destination, chunk)
        missing = [one for one in planned if not self._is_made(one, rows.get(one.name))]
        mark = f"{BEGUN}/{chunk:08d}.json"
        rows |= {row["pair"]: row for row in self._rows(missing, mark)}
        if missing or rows.keys() != {one.name for one in planned}:
            write_rows(self.destination, chunk, [rows[one.name] for one in planned])
            self.destination.remove(mark)
        failed = tuple((one.name, rows[one.name]["error"]) for one in missing if rows[one.name]["error"])
        there = len(planned) - len(missing)
        return Counts(len(missing) - len(failed), there, len(failed), failed[:_NAMED_FAILURES])

    def _is_made(self, planned: Planned, row: ManifestRow | None) -> bool:
        return row is not None and not row["error"] and self._holds(planned, row)

    def _holds(self, planned: Planned, row: ManifestRow) -> bool:
        """Test whether a row matches the current files and its results exist."""
        if tuple(row["versions"]) != planned.versions:
            return False
        folder = planned.name
        there = {file.path.removeprefix(f"{folder}/") for file in self.destination.files(folder)}
        return there.issuperset(row["files"])

    def _rows(self, missing: Sequence[Planned], mark: str) -> list[ManifestRow]:
        if not missing:
            return []
        if self.destination.exists(mark):
            return self._rows_apart(missing, mark)
        self.destination.write_bytes(mark, b"{}")
        return [self.row(planned) for planned in missing]

    def _rows_apart(self, missing: Sequence[Planned], mark: str) -> list[ManifestRow]:
        """Make the rows in a child process; records the tries of each pair and limits them."""
        notes = self._notes(mark)
        tries, rows = notes.get("tries", {}), {row["pair"]: row for row in notes.get("rows", [])}
        with _Apart(self) as apart:
            for planned in missing:
                if planned.name in rows and self._holds(planned, rows[planned.name]):
                    continue
                row = None
                while row is None and tries.get(planned.name, 0) < _MOST_TRIES:
                    apart.begin()
                    tries[planned.name] = tries.get(planned.name, 0) + 1
                    noted = json.dumps({"tries": tries, "rows": list(rows.values())})
                    self.destination.write_bytes(mark, noted.encode())
                    row = apart.row(planned)
                rows[planned.name] = row or self._empty_row(planned) | {"error": _KILLED}
        return list(rows.values())

    def _notes(self, mark: str) -> dict[str, Any]:
        try:
            return json.loads(self.destination.read_bytes(mark))
        except ValueError:  # another run has just finished the chunk, or a power failure lost the file
            return {}

    def row(self, planned: Planned) -> ManifestRow:
        """Process a pair or video and return its row; the pair's own errors go into the row.

        Raises:
            StereoweaveError: The source, the destination or the provider fails.
        """
        start_s = time.perf_counter()
        row, job = self._empty_row(planned), self._loaded_job
        with tempfile.TemporaryDirectory(prefix="stereoweave-") as name:
            try:
                if planned.is_film:
                    row |= self._film(planned, Path(name), job)
                else:
                    row |= self._pair(planned, Path(name), job)
            except _StoreError:
                raise
            except Exception as error:  # a library may raise anything on a bad picture; the others continue
                self._check_disk(error)
                if any(isinstance(cause, ProviderError) for cause in _causes(error)):
                    _check_runs(job.backend.matcher())
                kind = "" if isinstance(error, StereoweaveError) else f"{type(error).__name__}: "
                line = kind + format_error(error, job.name_of).replace(f"{name}/pictures", self.source.place)
                row["error"] = " ".join(line.split())
        return row | {"seconds": round(time.perf_counter() - start_s, 3)}

    def _empty_row(self, planned: Planned) -> ManifestRow:
        empty = dict.fromkeys(
            ("disparity_min_px", "disparity_median_px", "disparity_max_px", "confident_percent")
        )
        names = [file.rpartition("/")[2] for file in planned.files]
        row = {"pair": planned.name, "pictures": names, "versions": list(planned.versions)}
        return (
            row
            | empty
            | {"width_px": None, "height_px": None, "seconds": None, "error": None}
            | {
                "checks": [],
                "files": [],
            }
        )

    def _pair(self, planned: Planned, scratch: Path, job: DepthJob) -> ManifestRow:
        pictures, calibration = self._fetched(planned, scratch / "pictures")
        if calibration and not job.request.calibration:
            job = replace(job, request=replace(job.request, calibration=calibration))
        with self._results(planned, scratch) as out:
            summary, notes = make_depth(pictures, out, job)
        return {
            "disparity_min_px": summary.disparity_min_px,
            "disparity_median_px": summary.disparity_median_px,
            "disparity_max_px": summary.disparity_max_px,
            "confident_percent": summary.confident_percent,
            "width_px": summary.width_px,
            "height_px": summary.height_px,
            "checks": [note.format(job.name_of) for note in notes],
            "files": _names(out),
        }

    def _film(self, planned: Planned, scratch: Path, job: DepthJob) -> ManifestRow:
        from rich.console import Console

        from stereoweave.io.animation import require_video_extra

        with require_video_extra("a video"):
            from stereoweave.video.convert import convert_video
            from stereoweave.video.job import VideoJob
            from stereoweave.video.parts import parts_folder
            from stereoweave.video.reader import open_video

        films, _ = self._fetched(planned, scratch / "pictures")
        film_job = VideoJob(depth16=True, backend=job.backend, name_of=job.name_of)
        video = open_video(films, job.request.format)
        with self._results(planned, scratch) as out:
            make = partial(convert_video, video, films, out / FILM, film_job, Console(quiet=True))
            begun = parts_folder(out / FILM)
            was_begun = begun.exists()
            try:
                tally = make()
            except StereoweaveError as error:
                self._check_disk(error)
                kept = ProviderError | OutputInUseError
                if not was_begun or any(isinstance(cause, kept) for cause in _causes(error)):
                    raise
                # Parts of a killed worker, damaged or from other files.
                shutil.rmtree(begun, ignore_errors=True)
                tally = make()
        width, height = video.size_px
        return {"width_px": width, "height_px": height, "checks": tally.named, "files": _names(out)}

    def _fetched(self, planned: Planned, into: Path) -> tuple[tuple[Path, ...], Path | None]:
        """Copy the files and the calibration to this machine."""
        try:
            files = tuple(self.source.fetch(file, into) for file in planned.files)
            return files, self.source.fetch(planned.calibration, into) if planned.calibration else None
        except StereoweaveError:
            with _of_the_store():
                self.source.check_source()
            raise  # the store works, so the file is at fault

    @contextmanager
    def _results(self, planned: Planned, scratch: Path) -> Iterator[Path]:
        """Give a folder for the results, and upload them to the destination if that is not a folder."""
        if self.destination.folder is not None:
            folder = self.destination.folder / planned.name
            remove_left_behind(folder)
            yield folder
            return
        folder = scratch / "results"
        folder.mkdir()
        yield folder
        with _of_the_store():
            stored = {file.path for file in self.destination.files(planned.name)}
            fresh = {f"{planned.name}/{name}": folder / name for name in _names(folder)}
            for path, file in fresh.items():
                self.destination.put(file, path)
            for stale in stored - fresh.keys():
                self.destination.remove(stale)

    def _check_disk(self, error: Exception) -> None:
        """Raise if a disk is full or gone, because all further pairs would fail too."""
        if any(isinstance(cause, OSError) and cause.errno in _FULL_OR_GONE for cause in _causes(error)):
            raise _StoreError.from_error(error).with_prefix(f"{self.destination.place}: ") from error

    @functools.cached_property
    def _loaded_job(self) -> DepthJob:
        """The job with its carried files on this machine, and its network even if its file is replaced."""
        job = self.job
        for kind, name, content in self.carried:
            path = _carried(name, content)
            if kind == "model":
                job = replace(job, backend=replace(job.backend, model=str(path)))
            else:
                job = replace(job, request=replace(job.request, calibration=path))
        return replace(job, backend=job.backend.pin())

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the loaded job: networks cannot be pickled."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


class _StoreError(StereoweaveError):
    """Failure of the source or destination as a whole."""


@contextmanager
def _of_the_store() -> Iterator[None]:
    try:
        yield
    except StereoweaveError as error:
        raise _StoreError.from_error(error) from error


class _Apart:
    """A child process that makes rows; restarted after it is killed."""

    def __init__(self, worker: Worker) -> None:
        self._worker = worker
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> "_Apart":
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool:
            self._pool.shutdown()

    def begin(self) -> None:
        """Start the process unless it runs, and wait for it."""
        false_starts = 0
        while self._pool is None:
            threads = self._worker.job.backend.threads or 1
            pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), begin_work, (threads,))
            try:
                pool.submit(_keep_worker, self._worker).result()
                self._pool = pool
            except BrokenProcessPool as error:
                false_starts += 1
                if false_starts == _MOST_FALSE_STARTS:
                    raise StereoweaveError(
                        f"{platform.node()}: expected a process that loads the network, found it killed "
                        f"{false_starts} times in a row; is the memory full?"
                    ) from error
            finally:
                if self._pool is None:
                    pool.shutdown()

    def row(self, planned: Planned) -> ManifestRow | None:
        """Process a pair or video in the child process; None if that was killed."""
        assert self._pool is not None
        try:
            return self._pool.submit(_make_row, planned).result()
        except BrokenProcessPool:
            self._pool.shutdown()
            self._pool = None
            return None


# The worker of a child process.
_kept_worker: Worker | None = None


def _keep_worker(worker: Worker) -> None:
    """Keep a worker in this child process, and load its network before the first pair's attempt."""
    global _kept_worker
    _kept_worker = worker
    worker._loaded_job  # noqa: B018 - loads it


def _make_row(planned: Planned) -> ManifestRow:
    """Process a pair or video with the worker of this child process."""
    assert _kept_worker is not None
    return _kept_worker.row(planned)


@functools.cache
def _carried(name: str, content: bytes) -> Path:
    """Write a file of the driver to this machine's disk, for the lifetime of the process."""
    path = Path(_scratch().name, name)
    path.write_bytes(content)
    return path


@functools.cache
def _scratch() -> "tempfile.TemporaryDirectory[str]":
    return tempfile.TemporaryDirectory(prefix="stereoweave-")


def remove_left_behind(folder: Path) -> None:
    """Remove old temporary files of killed workers from a folder."""
    for path in folder.glob(".*"):
        with suppress(FileNotFoundError):
            if time.time() - path.stat().st_mtime < _LEFT_BEHIND_S:
                continue
            if path.name.startswith(".stereoweave-"):
                shutil.rmtree(path, ignore_errors=True)
            elif is_leftover(path):
                path.unlink()


def _check_runs(matcher: Matcher) -> None:
    """Raise if the provider fails even on the smallest pair: then the last pair was not too large."""
    plain = np.zeros((SMALLEST_SIDE_PX, SMALLEST_SIDE_PX, 3), np.uint8)
    matcher.estimate(plain, plain)


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error and the chain of its causes."""
    while error is not None:
        yield error
        error = error.__cause__


def _names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name[0] != "." and path.is_file())
