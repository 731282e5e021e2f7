"""Large sets stored as tar files in webdataset's format and read by index or almost sequentially.

A set is a folder of shards, each named SET-FIRST-LAST.tar after its first and last pair, such as
ship-000050-000099.tar. In this shard, pair 57 consists of the files that packing.py makes, such as
ship-000057.left.webp, and of their checksums, ship-000057.sha256. Identical pairs give identical bytes. A
shard is written atomically and never changed.
"""

import os
import re
import tarfile
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from io import BufferedReader, BytesIO
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Int, UInt8

from stereoweave.data.checksums import make_checksums, verify_checksums
from stereoweave.data.frames import Frame
from stereoweave.data.packing import unpack, unpack_views
from stereoweave.errors import FormatError
from stereoweave.io.files import reading, replacing
from stereoweave.stereo import Sample

Unpacked = TypeVar("Unpacked")

_SUMS = "sha256"
_DELETE = "delete it, and rerun the same `stereoweave synth make` command"
_NAME = re.compile(r"(.+)-(\d{6,})-(\d{6,})\.tar")
# Number of shards among which `Shards.order` mixes pairs; they contain 400 pairs if written by `synth make`.
_WINDOW = 8


class Shard(NamedTuple):
    """A file in a set, and the numbers of its first and last pair."""

    path: Path
    set_name: str
    first: int
    last: int

    def pair_name(self, number: int) -> str:
        """Return the common prefix of a pair's file names."""
        return f"{self.set_name}-{number:06d}"


def write_shard(folder: Path, set_name: str, first: int, pairs: Sequence[Mapping[str, bytes]]) -> None:
    """Write a shard of pairs packed by `packing.pack` and numbered from `first`.

    Raises:
        StereoweaveError: The folder is full or not writable; no partial shard remains.
    """
    last = first + len(pairs) - 1
    shard = Shard(folder / f"{set_name}-{first:06d}-{last:06d}.tar", set_name, first, last)
    with replacing(shard.path) as temporary, temporary.open("wb") as stream:
        with tarfile.open(fileobj=stream, mode="w", format=tarfile.USTAR_FORMAT) as tar:
            for number, pair in enumerate(pairs, first):
                _add_pair(tar, shard.pair_name(number), pair)
        # Without the sync, a power failure could preserve the new name but lose the content.
        stream.flush()
        os.fsync(stream.fileno())


def list_shards(folder: Path, set_name: str | None = None) -> list[Shard]:
    """List the shards of a set, sorted by first pair.

    Args:
        folder: Folder of the set.
        set_name: Name of the set; by default, the set name of the first shard.

    Raises:
        FormatError: A shard belongs to another set, or overlaps the previous one.
    """
    names = ((path, _NAME.fullmatch(path.name)) for path in folder.glob("[!.]*.tar"))
    shards = [Shard(path, found[1], int(found[2]), int(found[3])) for path, found in names if found]
    shards.sort(key=lambda shard: (shard.first, shard.last, shard.path.name))
    for shard in shards:
        if shard.set_name != (expected := set_name or shards[0].set_name):
            raise FormatError(
                f"{shard.path}: expected a shard of {expected}, found a shard of {shard.set_name}; "
                "move or delete it"
            )
    for before, shard in pairwise(shards):
        if shard.first <= before.last:
            raise FormatError(
                f"{shard.path}: expected no overlap with {before.path.name}, found pairs in both; {_DELETE}"
            )
    return shards


class Shards:
    """The pairs of a set, accessed by index. Instances can be pickled and keep no files open."""

    def __init__(self, folder: Path, set_name: str | None = None) -> None:
        """List the shards of a folder.

        Raises:
            FormatError: There are no shards, there is a gap between shards, or `list_shards` fails.
        """
        self.shards = list_shards(folder, set_name)
        if not self.shards:
            raise FormatError(f"{folder}: expected shards such as ship-000000-000049.tar, found none")
        self._starts = [0]
        for shard in self.shards:
            if shard.first != self._starts[-1]:
                raise FormatError(
                    f"{folder}: expected the next shard to start at pair {self._starts[-1]}, "
                    f"found {shard.path.name}; rerun the same `stereoweave synth make` command"
                )
            self._starts.append(shard.last + 1)
        self.count = self._starts[-1]
        self._contents: dict[Path, dict[str, dict[str, tuple[int, int]]]] = {}

    def __getitem__(self, index: int) -> Sample:
        return self._unpack_pair(index, unpack)

    def name(self, index: int) -> str:
        """Return the common prefix of a pair's file names."""
        return self._find_shard(index).pair_name(index)

    def views(self, index: int) -> dict[float, UInt8[np.ndarray, "h w 3"]]:
        """Return the additional views of a pair, by position."""
        return self._unpack_pair(index, unpack_views)

    def files(self, index: int) -> dict[str, bytes]:
        """Return the verified contents of a pair's files by suffix.

        Raises:
            FormatError: A file is damaged or missing.
        """
        path, name = self._find_shard(index).path, self.name(index)
        with reading(path, "a shard"), path.open("rb") as stream:
            places = self._locate_files(path).get(name, {})
            files = {f"{name}.{end}": _read_at(stream, *place) for end, place in places.items()}
            sums = files.pop(f"{name}.{_SUMS}", f"  {name}.{_SUMS}".encode())
            verify_checksums(files, sums, path, _DELETE)
        return {end.removeprefix(f"{name}."): content for end, content in files.items()}

    def order(self, rng: np.random.Generator) -> Int[np.ndarray, " n"]:
        """Return all indices in a random order that mixes the pairs of only a few shards at a time."""
        sizes = np.diff(self._starts)
        window = rng.permutation(len(sizes)) // _WINDOW
        return np.lexsort((rng.random(self.count), window.repeat(sizes)))

    def _unpack_pair(self, index: int, unpack: Callable[[Mapping[str, bytes]], Unpacked]) -> Unpacked:
        files = self.files(index)
        try:
            return unpack(files)
        except (ValueError, KeyError, TypeError) as error:  # valid checksums do not prove who wrote the files
            raise FormatError(
                f"{self._find_shard(index).path}: expected all files of a pair to be intact, "
                f"found missing or damaged files in {self.name(index)} ({error}); {_DELETE}"
            ) from error

    def _find_shard(self, index: int) -> Shard:
        if not 0 <= index < self.count:
            raise IndexError(f"expected a pair index from 0 to {self.count - 1}, found {index}")
        return self.shards[bisect_right(self._starts, index) - 1]

    def _locate_files(self, path: Path) -> dict[str, dict[str, tuple[int, int]]]:
        """Return the offset and the size of each pair's files in a shard, cached because reading is slow."""
        if path not in self._contents:
            self._contents[path] = _list_contents(path)
        return self._contents[path]


def list_frames(root: Path) -> list[Frame]:
    """List the pairs of all sets in a folder and its subfolders, such as SUBFOLDER/ship-000057."""
    frames = []
    for folder in sorted({path.parent for path in root.rglob("[!.]*.tar") if _NAME.fullmatch(path.name)}):
        pairs = Shards(folder)
        frames += [
            Frame(
                name=(folder.relative_to(root) / pairs.name(index)).as_posix(),
                read=partial(pairs.__getitem__, index),
            )
            for index in range(pairs.count)
        ]
    return frames


def _add_pair(tar: tarfile.TarFile, name: str, pair: Mapping[str, bytes]) -> None:
    files = {f"{name}.{end}": content for end, content in sorted(pair.items())}
    for file, content in [*files.items(), (f"{name}.{_SUMS}", make_checksums(files))]:
        # TarInfo's defaults, no owner and the year 1970, let the bytes depend on the pair alone.
        header = tarfile.TarInfo(file)
        header.size = len(content)
        tar.addfile(header, BytesIO(content))


def _list_contents(path: Path) -> dict[str, dict[str, tuple[int, int]]]:
    contents: defaultdict[str, dict[str, tuple[int, int]]] = defaultdict(dict)
    try:
        with tarfile.open(path, "r:") as tar:
            for member in tar:
                if member.size < 0:  # otherwise, the same header would be read forever
                    raise tarfile.ReadError(f"a file has {member.size} bytes")
                name, _, end = member.name.partition(".")
                contents[name][end] = member.offset_data, member.size
    except tarfile.TarError as error:
        raise FormatError(
            f"{path}: expected a shard, which is a tar file, found a damaged file ({error}); {_DELETE}"
        ) from error
    return dict(contents)


def _read_at(stream: BufferedReader, start: int, size: int) -> bytes:
    stream.seek(start)
    return stream.read(size)
