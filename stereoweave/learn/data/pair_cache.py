"""Cache of collage pairs on disk, so that a training step only crops and recolours them."""

import hashlib
import multiprocessing
import os
from collections.abc import Iterable
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from stereoweave.io.output_lock import lock_output
from stereoweave.learn.data.collage import paint_collage as make_sample
from stereoweave.stereo import Sample

# Disparity is stored as 16-bit fixed point in KITTI's 1/256 px, which is precise enough and takes half the
# memory of float32.
_DISPARITY_SCALE = 256
# A collage has no camera.
_MAPS = [field.name for field in fields(Sample) if field.name != "camera"]
_SOURCES = (
    *(f"learn/data/collage{part}.py" for part in ("", "_kinds", "_layers", "_scene")),
    "learn/data/paint_kernels.py",
    "learn/data/silhouettes.py",
    "learn/data/textures.py",
)


class CachedPairs:
    """The first `count` collage pairs of epoch 0 with the given seed, cached in a subfolder of `folder`."""

    def __init__(self, folder: Path, seed: int, count: int, size: tuple[int, int]) -> None:
        self.folder = folder / f"seed{seed}-{size[0]}x{size[1]}-{generator_version()}"
        self.seed, self.count, self.size = seed, count, size

    def missing(self) -> list[int]:
        """Return the indices of the pairs that are not yet cached."""
        return [i for i in range(self.count) if not self._file(i).exists()]

    def make(self, console: Console) -> Iterable[int]:
        """Make the missing pairs in parallel. Yields the index of each finished pair.

        Training runs with the same folder share their pairs. If another run is making the pairs, this one
        prints a note and waits for it.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        note = f"{self.folder}: another training is making these pairs; waiting for it"
        print_note = partial(console.print, note, markup=False, highlight=False, soft_wrap=True)
        # Spawned, because a forked child inherits PyTorch's threads in an unknown state.
        spawn = multiprocessing.get_context("spawn")
        with lock_output(self.folder, before_waiting=print_note), spawn.Pool(os.cpu_count()) as workers:
            yield from workers.imap_unordered(partial(_make_pair, self), self.missing(), chunksize=8)

    def keep(self, index: int, sample: Sample) -> None:
        """Write a pair atomically."""
        file = self._file(index)
        temporary = file.with_suffix(".part")
        arrays: dict[str, Any] = {name: _pack(getattr(sample, name)) for name in _MAPS}
        with temporary.open("wb") as stream:
            np.savez(stream, **arrays)
        temporary.replace(file)

    def __getitem__(self, index: int) -> Sample:
        with np.load(self._file(index)) as arrays:
            maps: dict[str, Any] = {name: _unpack(arrays[name]) for name in _MAPS}
        return Sample(**maps)

    def name(self, index: int) -> str:
        return str(self._file(index))

    def _file(self, index: int) -> Path:
        return self.folder / f"{index:06d}.npz"


def generator_version() -> str:
    """Return 8 hexadecimal digits that change with the code that paints collages."""
    package = Path(__file__).parents[2]
    return hashlib.sha256(b"".join((package / source).read_bytes() for source in _SOURCES)).hexdigest()[:8]


def _make_pair(pairs: CachedPairs, index: int) -> int:
    pairs.keep(index, make_sample(pairs.seed, 0, index, *pairs.size))
    return index


def _pack(values: np.ndarray) -> np.ndarray:
    if values.dtype == np.float32:
        assert np.isfinite(values).all() and values.max() < 65536 / _DISPARITY_SCALE
        return np.round(values * _DISPARITY_SCALE).astype(np.uint16)
    return values


def _unpack(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32) / _DISPARITY_SCALE if values.dtype == np.uint16 else values
