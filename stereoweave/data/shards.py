"""Large sets on disk: tar files in the form of the library webdataset, read by index or nearly as a stream.

A set is a folder of shards SET-FIRST-LAST.tar, named after the pairs in them: ship-000050-000099.tar. Pair 57
in it is the files ship-000057.left.webp and so on (packing.py) and their checksums, ship-000057.sha256. The
same pairs give the same bytes. A shard appears whole, under a name of its own, and is never changed.
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
_DELETE = "delete it, and the same stereoweave synth make makes its pairs again"
_NAME = re.compile(r"(.+)-(\d{6,})-(\d{6,})\.tar")
# Shards whose pairs are mixed in `Shards.order`: 400 pairs, as `stereoweave synth make` writes them.
_WINDOW = 8


class Shard(NamedTuple):
    """A file of a set, and the numbers of the first and the last pair in it."""

    path: Path
    set_name: str
    first: int
    last: int

    def pair_name(self, number: int) -> str:
        """What the names of a pair's files begin with."""
        return f"{self.set_name}-{number:06d}"


def write_shard(folder: Path, set_name: str, first: int, pairs: Sequence[Mapping[str, bytes]]) -> None:
    """Writes pairs, each as `packing.packed` gives it and numbered from `first`, as one shard.

    Raises:
        StereoweaveError: The folder cannot be written, or is full; nothing is left of the shard.
    """
    last = first + len(pairs) - 1
    shard = Shard(folder / f"{set_name}-{first:06d}-{last:06d}.tar", set_name, first, last)
    with replacing(shard.path) as temporary, temporary.open("wb") as stream:
        with tarfile.open(fileobj=stream, mode="w", format=tarfile.USTAR_FORMAT) as tar:
            for number, pair in enumerate(pairs, first):
                _add_pair(tar, shard.pair_name(number), pair)
        # Renamed before its bytes are on the disk, it could outlive them where the power fails.
        stream.flush()
        os.fsync(stream.fileno())


def list_shards(folder: Path, set_name: str | None = None) -> list[Shard]:
    """The shards of one set in a folder, by their first pair.

    Args:
        folder: Of a set.
        set_name: The set's; that of the first shard if None.

    Raises:
        FormatError: A shard is another set's, or has a pair that is in the one before it too.
    """
    names = ((path, _NAME.fullmatch(path.name)) for path in folder.glob("[!.]*.tar"))
    shards = [Shard(path, found[1], int(found[2]), int(found[3])) for path, found in names if found]
    shards.sort(key=lambda shard: (shard.first, shard.last, shard.path.name))
    for shard in shards:
        if shard.set_name != (expected := set_name or shards[0].set_name):
            raise FormatError(
                f"{shard.path}: expected a shard of {expected}, found another set's; move or delete it"
            )
    for before, shard in pairwise(shards):
        if shard.first <= before.last:
            raise FormatError(
                f"{shard.path}: expected no pair of {before.path.name}, found some in both; {_DELETE}"
            )
    return shards


class Shards:
    """The pairs of a set by index; it may travel to other processes, and opens files only while it reads."""

    def __init__(self, folder: Path, set_name: str | None = None) -> None:
        """Lists the shards of a folder.

        Raises:
            FormatError: There is none, one is missing before another one, or as in `list_shards`.
        """
        self.shards = list_shards(folder, set_name)
        if not self.shards:
            raise FormatError(f"{folder}: expected shards like ship-000000-000049.tar, found none")
        self._starts = [0]
        for shard in self.shards:
            if shard.first != self._starts[-1]:
                raise FormatError(
                    f"{folder}: expected pair {self._starts[-1]} in the next shard, found {shard.path.name}; "
                    "start the same stereoweave synth make again"
                )
            self._starts.append(shard.last + 1)
        self.count = self._starts[-1]
        self._contents: dict[Path, dict[str, dict[str, tuple[int, int]]]] = {}

    def __getitem__(self, index: int) -> Sample:
        return self._unpacked(index, unpack)

    def name(self, index: int) -> str:
        """What the names of the pair's files begin with."""
        return self._shard(index).pair_name(index)

    def views(self, index: int) -> dict[float, UInt8[np.ndarray, "h w 3"]]:
        """The further pictures of a pair, by their position between the cameras."""
        return self._unpacked(index, unpack_views)

    def files(self, index: int) -> dict[str, bytes]:
        """The files of a pair by the ends of their names, checked; FormatError where one is damaged."""
        path, name = self._shard(index).path, self.name(index)
        with reading(path, "a shard"), path.open("rb") as stream:
            places = self._places(path).get(name, {})
            files = {f"{name}.{end}": _read_at(stream, *place) for end, place in places.items()}
            sums = files.pop(f"{name}.{_SUMS}", f"  {name}.{_SUMS}".encode())
            verify_checksums(files, sums, path, _DELETE)
        return {end.removeprefix(f"{name}."): content for end, content in files.items()}

    def order(self, rng: np.random.Generator) -> Int[np.ndarray, " n"]:
        """All indices, shuffled so that who reads them goes through a few shards at a time, each once."""
        sizes = np.diff(self._starts)
        window = rng.permutation(len(sizes)) // _WINDOW
        return np.lexsort((rng.random(self.count), window.repeat(sizes)))

    def _unpacked(self, index: int, unpack: Callable[[Mapping[str, bytes]], Unpacked]) -> Unpacked:
        files = self.files(index)
        try:
            return unpack(files)
        except (ValueError, KeyError, TypeError) as error:  # checksums are no proof of who wrote the files
            raise FormatError(
                f"{self._shard(index).path}: expected the files of a pair, found {self.name(index)} without "
                f"or with damaged ones ({error}); {_DELETE}"
            ) from error

    def _shard(self, index: int) -> Shard:
        if not 0 <= index < self.count:
            raise IndexError(f"pair {index} of {self.count}")
        return self.shards[bisect_right(self._starts, index) - 1]

    def _places(self, path: Path) -> dict[str, dict[str, tuple[int, int]]]:
        """Where the files of each pair begin in a shard, and their sizes; read once, as it takes a while."""
        if path not in self._contents:
            self._contents[path] = _list_contents(path)
        return self._contents[path]


def list_frames(root: Path) -> list[Frame]:
    """The pairs of all sets in a folder and below it, named SUBFOLDER/ship-000057."""
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
        header = tarfile.TarInfo(file)  # of no owner and 1970, so that the bytes depend on the pair alone
        header.size = len(content)
        tar.addfile(header, BytesIO(content))


def _list_contents(path: Path) -> dict[str, dict[str, tuple[int, int]]]:
    contents: defaultdict[str, dict[str, tuple[int, int]]] = defaultdict(dict)
    try:
        with tarfile.open(path, "r:") as tar:
            for member in tar:
                if member.size < 0:  # the same head would come again without end
                    raise tarfile.ReadError(f"a size of {member.size} bytes")
                name, _, end = member.name.partition(".")
                contents[name][end] = member.offset_data, member.size
    except tarfile.TarError as error:
        raise FormatError(
            f"{path}: expected a shard, a tar file, found a damaged one ({error}); {_DELETE}"
        ) from error
    return dict(contents)


def _read_at(stream: BufferedReader, start: int, size: int) -> bytes:
    stream.seek(start)
    return stream.read(size)
