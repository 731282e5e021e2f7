"""Plan and rows of a large batch, split into many Parquet files so that no process has to read them all.

The files `plan/part-*.parquet` list the pairs and videos with their chunks. The plan is extended, never
rearranged. Each file `manifest/part-*.parquet` holds the rows of one chunk, and is written after the whole
chunk has been processed.
"""

import io
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from itertools import islice
from typing import TYPE_CHECKING, Any

from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.stores import Store, store_at
from stereoweave.pictures.pair_finding import ListedPair, find_pairs_among, note_listing

if TYPE_CHECKING:
    import pyarrow

MANIFEST, PLAN = "manifest", "plan"
MOST_IN_A_CHUNK = 32
"""Maximum number of pairs in a chunk, and thus the maximum number to process again after a worker dies."""
_CHUNKS_PER_WORKER = 8
_CHUNKS_PER_FILE = 64
_PART = re.compile(r"part-(\d{8})\.parquet")


@dataclass(frozen=True)
class PlanEntry:
    """A planned pair or video.

    Attributes:
        name: Name of the pair or video, and of its results folder.
        files: Paths in the source: a left and a right picture, one picture with both views, or a video.
        versions: Size and version of each file and of the calibration, to detect changes.
        calibration: Path of the pair's own calibration in the source, if any.
        is_film: Whether this is a video.
    """

    name: str
    files: tuple[str, ...]
    versions: tuple[str, ...]
    calibration: str | None = None
    is_film: bool = False


@dataclass(frozen=True)
class ChunkPlan:
    """Plan of a batch: the chunk indices, the number of pairs and videos, and notes for the user."""

    chunks: tuple[int, ...]
    count: int
    notes: tuple[str, ...] = ()


def extend_plan(source: Store, destination: Store, workers: int) -> ChunkPlan:
    """Update the destination's plan to match the source's current files, and return the plan.

    New pairs and videos are added in new chunks. Entries of changed files get the new versions. Entries
    of removed files are kept.

    Args:
        source: Store of the pairs and videos.
        destination: Store of the plan.
        workers: Number of workers that share the new chunks.

    Raises:
        StereoweaveError: There are no pairs or videos, or a store cannot be used.
    """
    _read_plan.cache_clear()
    versions = {file.path: f"{file.size_bytes} {file.version}" for file in source.files()}
    listed = find_pairs_among(source.place, versions)
    found = {entry.name: entry for entry in _make_entries(listed.pairs, listed.films, versions)}
    parts = _list_parts(destination, PLAN)
    # This removes all planned entries from `found`; the new entries remain.
    counts = {part: _update_part(destination, part, found) for part in parts}
    if not (found or counts):
        raise StereoweaveError(f"{source.place}: expected videos or pairs of pictures, found none")
    size = max(1, min(MOST_IN_A_CHUNK, len(found) // (_CHUNKS_PER_WORKER * workers)))
    chunks = list(_split_into_chunks(found.values(), size))
    for part, first in enumerate(range(0, len(chunks), _CHUNKS_PER_FILE), max(parts, default=-1) + 1):
        counts[part] = _write_plan(destination, part, chunks[first : first + _CHUNKS_PER_FILE])
    numbers = tuple(
        part * _CHUNKS_PER_FILE + chunk for part, sizes in counts.items() for chunk in range(len(sizes))
    )
    # Remove rows of chunks that are not in the plan. Such rows remain if a plan file was lost, or if two runs
    # extended the plan at the same time.
    for stray in set(_list_parts(destination, MANIFEST)).difference(numbers):
        destination.remove(_part_path(MANIFEST, stray))
    return ChunkPlan(numbers, sum(map(sum, counts.values())), note_listing(source.place, listed))


def read_chunk(destination: Store, chunk: int) -> list[PlanEntry]:
    """Read the entries of a chunk."""
    part, number = divmod(chunk, _CHUNKS_PER_FILE)
    return _read_plan(destination.place, part)[number]


def read_rows(destination: Store, chunk: int) -> dict[str, dict[str, Any]]:
    """Return the rows of a chunk by pair name, or {} if they have not been written yet."""
    path = _part_path(MANIFEST, chunk)
    if not destination.exists(path):
        return {}
    return {row["pair"]: row for row in _read_table(destination, path)}


def write_rows(destination: Store, chunk: int, rows: Sequence[dict[str, Any]]) -> None:
    """Write the rows of a chunk atomically."""
    _write_table(destination, _part_path(MANIFEST, chunk), rows, _make_rows_schema())


def _make_rows_schema() -> "pyarrow.Schema":
    import pyarrow

    names = pyarrow.list_(pyarrow.string())
    return pyarrow.schema(
        {
            "pair": pyarrow.string(),
            "pictures": names,
            "checks": names,
            "disparity_min_px": pyarrow.float32(),
            "disparity_median_px": pyarrow.float32(),
            "disparity_max_px": pyarrow.float32(),
            "confident_percent": pyarrow.float32(),
            "width_px": pyarrow.int32(),
            "height_px": pyarrow.int32(),
            "seconds": pyarrow.float32(),
            "error": pyarrow.string(),
            "files": names,
            "versions": names,
        }
    )


def _make_plan_schema() -> "pyarrow.Schema":
    import pyarrow

    names = pyarrow.list_(pyarrow.string())
    return pyarrow.schema(
        {
            "chunk": pyarrow.int64(),
            "name": pyarrow.string(),
            "files": names,
            "versions": names,
            "calibration": pyarrow.string(),
            "is_film": pyarrow.bool_(),
        }
    )


def _make_entries(
    pairs: Iterable[ListedPair], films: Iterable[ListedPair], versions: dict[str, str]
) -> Iterator[PlanEntry]:
    for listed, is_film in [(pairs, False), (films, True)]:
        for name, files, calibration in listed:
            paths = (*files, calibration) if calibration else files
            file_versions = tuple(versions.get(path, "") for path in paths)  # a file may be missing
            yield PlanEntry(name, files, file_versions, calibration, is_film)


def _split_into_chunks(entries: Collection[PlanEntry], size: int) -> Iterator[list[PlanEntry]]:
    """Yield chunks of `size` pairs, then one chunk per video, because a video takes as long as many pairs."""
    pairs = (entry for entry in entries if not entry.is_film)
    while chunk := list(islice(pairs, size)):
        yield chunk
    yield from ([entry] for entry in entries if entry.is_film)


def _update_part(destination: Store, part: int, found: dict[str, PlanEntry]) -> list[int]:
    """Update the entries of a plan file, and return the sizes of its chunks.

    Entries in `found` replace the file's entries of the same name, and are removed from `found`.
    """
    chunks = _read_plan(destination.place, part)
    updated = [[found.pop(entry.name, entry) for entry in chunk] for chunk in chunks]
    if updated != chunks:
        _write_plan(destination, part, updated)
    return [len(chunk) for chunk in updated]


def _write_plan(destination: Store, part: int, chunks: Sequence[Sequence[PlanEntry]]) -> list[int]:
    """Write a plan file, and return the sizes of its chunks."""
    rows = [{"chunk": number, **asdict(entry)} for number, chunk in enumerate(chunks) for entry in chunk]
    _write_table(destination, _part_path(PLAN, part), rows, _make_plan_schema())
    return [len(chunk) for chunk in chunks]


# Caching one file is enough, because a worker's chunks are mostly consecutive.
@lru_cache(maxsize=1)
def _read_plan(destination: str, part: int) -> list[list[PlanEntry]]:
    """Read a plan file, and return the entries of each of its chunks."""
    chunks: list[list[PlanEntry]] = []
    for row in _read_table(store_at(destination), _part_path(PLAN, part)):
        number = row.pop("chunk")
        chunks += [[] for _ in range(number + 1 - len(chunks))]
        row |= {name: tuple(row[name]) for name in ("files", "versions")}
        chunks[number].append(PlanEntry(**row))
    return chunks


def _part_path(folder: str, number: int) -> str:
    return f"{folder}/part-{number:08d}.parquet"


def _list_parts(destination: Store, folder: str) -> list[int]:
    names = (file.path.rpartition("/")[2] for file in destination.files(folder))
    return sorted(int(match[1]) for name in names if (match := _PART.fullmatch(name)))


def _read_table(destination: Store, path: str) -> list[dict[str, Any]]:
    import pyarrow
    from pyarrow import parquet

    content = destination.read_bytes(path)
    try:
        return parquet.ParquetFile(io.BytesIO(content)).read(use_threads=False).to_pylist()
    except (pyarrow.ArrowException, ValueError) as error:
        raise FormatError(
            f"{destination.at(path)}: expected a readable Parquet file, found a damaged one "
            f"({error}); remove the file, and rerun the same command to write it again"
        ) from error


def _write_table(
    destination: Store, path: str, rows: Sequence[dict[str, Any]], schema: "pyarrow.Schema"
) -> None:
    import pyarrow
    from pyarrow import parquet

    content = io.BytesIO()
    try:
        parquet.write_table(pyarrow.Table.from_pylist(rows, schema=schema), content)
    except UnicodeEncodeError as error:
        raise StereoweaveError(
            f"{destination.place}: expected file names in UTF-8, found {error.object!r}; rename the file"
        ) from error
    destination.write_bytes(path, content.getvalue())
