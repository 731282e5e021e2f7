"""Checks of a submission: every file is there, has the right size, and contains what the site expects."""

import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from zipfile import BadZipFile, ZipFile

from stereoweave.bench.submission_formats import MOST_TIME_BYTES, Submission, find_method
from stereoweave.data.benchmarks import BenchmarkPair
from stereoweave.errors import FormatError, reason
from stereoweave.io.decoding import check_regular

_DAMAGED = (BadZipFile, zlib.error, OSError, EOFError, ValueError, RuntimeError, OverflowError, MemoryError)


def read_names(archive: Path) -> list[str]:
    """Return the names of the files in a zip archive, without its folders.

    Raises:
        FormatError: The file is missing or no zip archive.
    """
    check_regular(archive, "a zip archive")
    try:
        with ZipFile(archive) as opened:
            return [name for name in opened.namelist() if not name.endswith("/")]
    except _DAMAGED as error:
        raise FormatError(f"{archive}: expected a zip archive, found {reason(error)}") from error


def read_method(archive: Path, dataset: str) -> str:
    """Return the name of the method that an archive's files have; the default name if there is none.

    Raises:
        FormatError: The file is missing or no zip archive.
    """
    return find_method(dataset, iter(read_names(archive)))


def find_problems(archive: Path, submission: Submission) -> Iterator[str]:
    """Yield a line for each problem of an archive: the file, what was expected, and what was found.

    Raises:
        FormatError: The file is missing or no zip archive.
    """
    names = read_names(archive)
    yield from _compare_names(names, list(submission.files()))
    with ZipFile(archive) as opened, TemporaryDirectory() as folder:
        for pair in submission.pairs:
            if (name := submission.map_file(pair)) in names:
                yield from _check_map(opened, name, submission, pair, Path(folder))
            if (name := submission.time_file(pair) or "") in names:
                yield from _check_time(opened, name, submission)


def _compare_names(names: list[str], expected: list[str]) -> Iterator[str]:
    found, wanted = Counter(names), set(expected)
    parent = names[0].partition("/")[0] if names else ""
    if wanted.isdisjoint(found) and any(f"{parent}/{name}" in found for name in wanted):
        yield f"{parent}: expected {expected[0]} in the root of the archive, found this folder around it"
        return
    yield from (f"{name}: expected a file, found none" for name in expected if name not in found)
    for name, times in found.items():
        if name not in wanted:
            yield f"{name}: expected only the maps and times of the pairs, found another file"
        elif times > 1:
            yield f"{name}: expected one file of this name, found {times}"


def _check_map(
    archive: ZipFile, name: str, submission: Submission, pair: BenchmarkPair, folder: Path
) -> Iterator[str]:
    try:
        content = _read(archive, name, submission.format.most_bytes(pair.size_px))
        extracted = folder / f"map{Path(name).suffix}"
        extracted.write_bytes(content)
        problem = submission.format.find_problem(extracted, pair.size_px)
    except FormatError as error:
        problem = str(error).removeprefix(f"{folder / 'map'}{Path(name).suffix}: ")
    if problem:
        yield f"{name}: {problem}"


def _check_time(archive: ZipFile, name: str, submission: Submission) -> Iterator[str]:
    try:
        text = _read(archive, name, MOST_TIME_BYTES).decode(errors="replace")
    except FormatError as error:
        yield f"{name}: {error}"
        return
    if submission.format.parse_time(text) is None:
        expected = submission.format.format_time(1.5)
        yield f"{name}: expected a time in seconds, such as '{expected}', found {text!r:.60}"


def _read(archive: ZipFile, name: str, most_bytes: int) -> bytes:
    """Return the content of a file in an archive, whose header may lie about its size."""
    try:
        with archive.open(name) as file:
            content = file.read(most_bytes + 1)
    except _DAMAGED as error:
        raise FormatError(f"expected an intact file, found {reason(error)}") from error
    if len(content) > most_bytes:
        raise FormatError(f"expected at most {most_bytes} bytes, found more")
    return content
