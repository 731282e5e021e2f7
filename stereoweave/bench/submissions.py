"""Submissions to public benchmarks: matching of all pairs, and the archive for the benchmark's site.

Finished pairs are kept in a folder beside the archive, from which an interrupted run resumes.
"""

import hashlib
import math
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
from jaxtyping import Float32
from rich.console import Console

from stereoweave import __version__
from stereoweave.bench.submission_check import find_problems
from stereoweave.bench.submission_formats import Submission
from stereoweave.data.benchmarks import BenchmarkPair
from stereoweave.errors import StereoweaveError
from stereoweave.io.files import make_folder, make_parent_folder, reading, remove_leftovers, replacing
from stereoweave.io.images import read_pair
from stereoweave.io.output_lock import lock_output
from stereoweave.io.run_folder import check_claim, check_unclaimed, describe_run, parse_description
from stereoweave.matching.backend import Backend
from stereoweave.matching.estimate import match
from stereoweave.matching.matcher import MODES, Matcher, model_file
from stereoweave.matching.options import MatchOptions
from stereoweave.system.progress import progress

_SETTINGS_FILE = "submission.json"
# The maps compress little, and higher levels take several times as long.
_COMPRESSION_LEVEL = 3


@dataclass(frozen=True, kw_only=True)
class Written:
    """What `write_submission` did.

    Attributes:
        made: Number of pairs matched.
        resumed: Number of pairs that an interrupted run had matched.
        mean_time_s: Mean time per pair, for the site's form.
    """

    made: int
    resumed: int
    mean_time_s: float


def parts_folder(out: Path) -> Path:
    """Return the folder for the finished pairs of an unfinished submission."""
    return out.with_name(f"{out.name}.parts")


def check_new_archive(out: Path) -> None:
    """Raise a StereoweaveError unless an archive of this name can be written and does not exist yet."""
    if out.suffix.lower() != ".zip":
        raise StereoweaveError(f"{out}: expected a file extension of .zip, found {out.suffix or 'none'}")
    make_parent_folder(out)
    if out.exists():
        raise StereoweaveError(f"{out}: expected a new file, found one; remove it, or choose another name")


def write_submission(
    out: Path, submission: Submission, backend: Backend, *, refined: bool = False, console: Console
) -> Written:
    """Match all pairs of a submission, and write the archive for the benchmark's site.

    The archive is checked (`find_problems`) before it gets its name. The time of a pair is that of matching
    alone, after one pair that is not timed; pictures are in memory and the network is loaded.

    Args:
        out: The archive, a new .zip file.
        submission: The pairs and the format.
        backend: The network.
        refined: Whether to match once more wherever the network is not certain.
        console: Console that shows the progress.

    Raises:
        StereoweaveError: The archive exists or cannot be written, another command is writing it, or the
            folder of finished pairs belongs to a run with other settings.
        FormatError: A picture is damaged or too small.
        MatcherError: The network is unknown or invalid, or the provider is unavailable.
    """
    check_new_archive(out)
    matcher = backend.matcher()
    with lock_output(out):
        folder = parts_folder(out)
        _claim(folder, _describe(submission, backend, refined))
        missing = [pair for pair in submission.pairs if not _is_finished(folder, submission, pair)]
        with _keeping_parts(folder):
            _match_pairs(folder, submission, missing, partial(_match_timed, matcher, refined), console)
        times_s = [_read_time_s(folder, pair) for pair in submission.pairs]
        _pack(out, folder, submission, times_s)
        shutil.rmtree(folder)
    return Written(
        made=len(missing),
        resumed=len(submission.pairs) - len(missing),
        mean_time_s=sum(times_s) / len(times_s),
    )


def _describe(submission: Submission, backend: Backend, refined: bool) -> dict[str, Any]:
    """Return what determines maps and times; the method's name does not."""
    network = model_file(backend.model)
    with reading(network, "a matcher file"):
        digest = hashlib.sha256(network.read_bytes()).hexdigest()
    return {
        "stereoweave": __version__,
        "model": f"{Path(backend.model).name} {digest[:12]}",
        "refined": refined or str(backend.model) in MODES,
        "provider": backend.provider,
        "threads": backend.threads,
        "dataset": submission.dataset,
        "first_picture": str(submission.pairs[0].left.absolute()),
    }


def _claim(folder: Path, facts: dict[str, Any]) -> None:
    """Record the run's settings in the folder of finished pairs, or compare them with those recorded."""
    make_folder(folder)
    path = folder / _SETTINGS_FILE
    if path.exists():
        expected = "the settings of an unfinished submission"
        with reading(path, expected):
            found = parse_description(path, path.read_text(encoding="utf-8"), expected)
        try:
            check_claim(path, facts, found)
        except StereoweaveError as error:
            raise error.with_detail(f"or remove {folder} to start anew") from error
    else:
        check_unclaimed(
            folder, _SETTINGS_FILE, (entry.name for entry in folder.iterdir() if entry.name[0] != ".")
        )
        with replacing(path) as temporary:
            temporary.write_text(describe_run(facts), encoding="utf-8")
    remove_leftovers(folder)


@contextmanager
def _keeping_parts(folder: Path) -> Iterator[None]:
    """Add to an error where the finished pairs are; remove the folder if it has none."""
    try:
        yield
    except BaseException as error:
        if not any(folder.rglob("*.seconds")):
            shutil.rmtree(folder)
        elif isinstance(error, StereoweaveError):
            detail = f"finished pairs are in {folder}; rerun the same command to resume"
            raise error.with_detail(detail) from error
        raise


def _match_pairs(
    folder: Path,
    submission: Submission,
    pairs: list[BenchmarkPair],
    match_timed: Callable[[BenchmarkPair], tuple[Float32[np.ndarray, "h w"], float]],
    console: Console,
) -> None:
    if not pairs:
        return
    total = len(submission.pairs)
    with progress(console) as bar:
        shown = bar.add_task("matching", total=total, completed=total - len(pairs), loss="", rate="")
        match_timed(pairs[0])  # compiles kernels and reserves memory
        for pair in pairs:
            disparity_px, time_s = match_timed(pair)
            # A pair counts as finished once its map exists.
            with replacing(_time_path(folder, pair)) as temporary:
                temporary.write_text(repr(time_s))
            submission.format.write_map(_map_path(folder, submission, pair), disparity_px)
            bar.update(shown, advance=1, rate=f"{pair.name} {time_s:.2f} s")


def _match_timed(
    matcher: Matcher, refined: bool, pair: BenchmarkPair
) -> tuple[Float32[np.ndarray, "h w"], float]:
    """Return the disparity of the left view in px, float32 [H, W], and the time of matching in seconds."""
    pictures = read_pair(pair.left, pair.right)
    options = MatchOptions(range_px=pair.range_px, refined=refined)
    start_s = time.perf_counter()
    found = match(matcher, pictures, options)
    return found.disparity_px, time.perf_counter() - start_s


def _pack(out: Path, folder: Path, submission: Submission, times_s: list[float]) -> None:
    with replacing(out) as temporary:
        with ZipFile(temporary, "w", ZIP_DEFLATED, compresslevel=_COMPRESSION_LEVEL) as archive:
            for pair, time_s in zip(submission.pairs, times_s, strict=True):
                archive.write(_map_path(folder, submission, pair), submission.map_file(pair))
                if time_file := submission.time_file(pair):
                    archive.writestr(time_file, submission.format.format_time(time_s))
        if problem := next(find_problems(temporary, submission), None):
            raise StereoweaveError(
                f"{out}: not written; {problem}; remove {folder}, and run the command again"
            )


def _is_finished(folder: Path, submission: Submission, pair: BenchmarkPair) -> bool:
    return _map_path(folder, submission, pair).exists() and math.isfinite(_read_time_s(folder, pair))


def _read_time_s(folder: Path, pair: BenchmarkPair) -> float:
    """Return the time of a finished pair in seconds; NaN if it is unknown."""
    try:
        return float(_time_path(folder, pair).read_text())
    except (OSError, ValueError):
        return math.nan


def _map_path(folder: Path, submission: Submission, pair: BenchmarkPair) -> Path:
    return folder / f"{pair.name}{Path(submission.format.map_name).suffix}"


def _time_path(folder: Path, pair: BenchmarkPair) -> Path:
    return folder / f"{pair.name}.seconds"
