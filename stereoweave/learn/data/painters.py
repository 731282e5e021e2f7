"""Batches that other processes paint and cut beside a training, handed over in shared memory.

Each process has two places for batches and a pipe: no lock that a killed process could keep, and its end is
noticed at once.
"""

import multiprocessing
import traceback
from collections import deque
from collections.abc import Sequence
from ctypes import c_uint8
from dataclasses import replace
from math import prod
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch

from stereoweave.errors import StereoweaveError
from stereoweave.learn.data import collage
from stereoweave.learn.data.batches import Batches
from stereoweave.learn.data.pair_cache import CachedPairs
from stereoweave.learn.data.sources import PairSource, open_sources
from stereoweave.learn.recipe import Recipe
from stereoweave.stereo import Sample

_SLOTS = 2  # of a process: it fills one while the other waits to be taken
# Compiling the kernels and building the textures takes a minute on a slow machine.
_PATIENCE_S = 180.0
# Pairs that a process holds to cut them again.
_HELD = 96
_MOST_CUTS = 4.0
# What the seed of other crops is greater by: their batches have the same numbers, and need other pairs.
_OTHER_SEED = 1000


class PaintJob(NamedTuple):
    """A batch to make: where to, its number, by which of the recipes, and how often a pair is cut."""

    slot: int
    number: int
    recipe: int
    cuts: float


class PainterShare(NamedTuple):
    """The work of one process: the recipes, the folder of the held-out pairs, and which process it is."""

    recipes: tuple[Recipe, ...]
    folder: Path
    place: int
    processes: int


class PaintedBatch(NamedTuple):
    """A batch that is there; `problem` is the traceback where it could not be made."""

    job: PaintJob
    problem: str = ""


class TensorPlace(NamedTuple):
    """Where a tensor is in a slot: its first byte, its shape and its type."""

    offset: int
    shape: tuple[int, ...]
    dtype: torch.dtype


class ReusedPairs:
    """A source whose pairs come `cuts` times on average, among others: painting takes longer than cutting."""

    def __init__(self, pairs: PairSource, held: int = _HELD) -> None:
        self.pairs, self.cuts = pairs, 1.0
        self.count = pairs.count
        self._held: deque[Sample] = deque(maxlen=held)

    def __getitem__(self, index: int) -> Sample:
        rng = np.random.default_rng(index)
        if len(self._held) == self._held.maxlen and rng.random() * self.cuts >= 1:
            return self._held[rng.integers(len(self._held))]
        self._held.append(self.pairs[index])
        return self._held[-1]

    def name(self, index: int) -> str:
        return self.pairs.name(index)


class Painters:
    """Processes that make the batches of a recipe; a context that ends them.

    Args:
        recipes: Of the batches; `switch` changes between them.
        folder: Where the held-out pairs are kept.
        processes: How many.
        first: Number of the first batch. Each number has pairs of its own where the recipe paints fresh ones.
        pinned: Batches are copied to memory that a GPU reads by itself.

    Attributes:
        cuts: How often each pair is cut from now on: 1 where painting keeps up with the training.
        taken: Batches taken.
        starved: Those of them that were not ready when they were asked for.
        failures: Batches that could not be made, each with its traceback.
    """

    def __init__(
        self, recipes: Sequence[Recipe], folder: Path, processes: int, first: int = 0, pinned: bool = False
    ) -> None:
        self.recipes, self.pinned, self.number, self.recipe = tuple(recipes), pinned, first, 0
        self.cuts, self.taken, self.starved = 1.0, 0, 0
        self.failures: list[str] = []
        self._ready: deque[tuple[Connection, PaintedBatch]] = deque()
        self._memory: dict[Connection, Any] = {}
        context = multiprocessing.get_context("spawn")
        size = max(_compute_layout(recipe)[1] for recipe in self.recipes)
        self._processes = []
        for place in range(processes):
            here, there = context.Pipe()
            memory = context.RawArray(c_uint8, _SLOTS * size)
            process = context.Process(
                target=_run_painter,
                args=(there, memory, PainterShare(self.recipes, folder, place, processes)),
                daemon=True,
            )
            process.start()
            there.close()
            self._processes.append(process)
            self._memory[here] = memory
        for slot in range(_SLOTS):
            for here in self._memory:
                self._order(here, slot)

    def __enter__(self) -> "Painters":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            process.join()

    def switch(self, recipe: int) -> None:
        """Order batches of another of the recipes from now on; those under way come first."""
        self.recipe = recipe

    def adapt(self, starved_share: float) -> None:
        """Cut each pair more often where batches came late, and less often where none did."""
        if starved_share > 0.1:
            self.cuts = min(self.cuts * 1.5, _MOST_CUTS)
        elif starved_share == 0:
            self.cuts = max(self.cuts / 1.2, 1.0)

    def take(self) -> dict[str, torch.Tensor]:
        """The next batch that is ready, as `collated` gives it but with images uint8.

        Raises:
            StereoweaveError: All processes have ended, most batches fail, or none comes for minutes.
        """
        self._listen(0)
        self.starved += not self._ready
        while True:
            while not self._ready:
                self._listen(_PATIENCE_S)
            here, done = self._ready.popleft()
            if not done.problem:
                break
            self._failed(here, done)
        batch = {
            name: torch.empty(view.shape, dtype=view.dtype, pin_memory=self.pinned).copy_(view)
            for name, view in self._views(here, done.job).items()
        }
        self._order(here, done.job.slot)
        self.taken += 1
        return batch

    def _failed(self, here: Connection, done: PaintedBatch) -> None:
        self.failures.append(done.problem)
        if len(self.failures) > 5 + self.taken // 20:
            raise StereoweaveError(
                f"{len(self.failures)} of {len(self.failures) + self.taken} batches could not be made; "
                f"the last: {done.problem}"
            )
        self._order(here, done.job.slot)

    def _listen(self, patience_s: float) -> None:
        """Note the batches that are done; at the end of a process go on with the others."""
        heard = wait(list(self._memory), patience_s)
        if patience_s and not heard:
            raise StereoweaveError(f"no batch came for {patience_s:.0f} s; try fewer processes")
        for here in heard:
            assert isinstance(here, Connection)
            try:
                self._ready.append((here, here.recv()))
            except (EOFError, OSError):
                self._lose(here)

    def _lose(self, here: Connection) -> None:
        del self._memory[here]
        self._ready = deque(entry for entry in self._ready if entry[0] is not here)
        if not self._memory:
            raise StereoweaveError("every process that makes batches has ended; is there memory enough?")

    def _order(self, here: Connection, slot: int) -> None:
        try:
            here.send(PaintJob(slot, self.number, self.recipe, self.cuts))
        except OSError:
            return  # it has ended, which the next `_listen` finds
        self.number += 1

    def _views(self, here: Connection, job: PaintJob) -> dict[str, torch.Tensor]:
        return _view_tensors(self._memory[here], job.slot, self.recipes[job.recipe])


def _run_painter(pipe: Connection, memory: Any, share: PainterShare) -> None:
    """Make the batches that are ordered, in a process of its own, until the pipe's other end is gone."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    _save_held_out(share)
    batches = [_make_batches(recipe, share.folder) for recipe in share.recipes]
    while True:
        try:
            job: PaintJob = pipe.recv()
            pipe.send(_paint_batch(job, batches[job.recipe], memory))
        except (EOFError, OSError):
            return


def _save_held_out(share: PainterShare) -> None:
    """Make this process's part of the held-out pairs."""
    held_out = open_sources(share.recipes[0], share.folder)[1]
    if isinstance(held_out, CachedPairs):
        held_out.folder.mkdir(parents=True, exist_ok=True)
        for index in range(share.place, held_out.count, share.processes):
            held_out.keep(index, collage.paint_collage(held_out.seed, 0, index, *held_out.size))


def _make_batches(recipe: Recipe, folder: Path) -> Batches:
    batches = Batches(recipe, open_sources(recipe, folder)[0])
    batches.pairs = ReusedPairs(batches.pairs)
    return batches


def _paint_batch(job: PaintJob, batches: Batches, memory: Any) -> PaintedBatch:
    """Make a batch in its slot."""
    assert isinstance(batches.pairs, ReusedPairs)
    batches.pairs.cuts = job.cuts
    try:
        batch = batches[job.number]
        for name, view in _view_tensors(memory, job.slot, batches.recipe).items():
            values = batch[name]
            view.copy_((values * 255).round() if view.dtype == torch.uint8 else values)
    except Exception:  # whatever one batch ends in, the others may be made
        return PaintedBatch(job, traceback.format_exc())
    return PaintedBatch(job)


def _view_tensors(memory: Any, slot: int, recipe: Recipe) -> dict[str, torch.Tensor]:
    """The tensors of a batch in a slot of the memory."""
    layout, _ = _compute_layout(recipe)
    start = slot * (len(memory) // _SLOTS)
    return {
        name: torch.frombuffer(
            memory, dtype=place.dtype, count=prod(place.shape), offset=start + place.offset
        ).view(place.shape)
        for name, place in layout.items()
    }


def _compute_layout(recipe: Recipe) -> tuple[dict[str, TensorPlace], int]:
    """Place of each tensor of a batch in a slot, and how many bytes they take."""
    height, width = recipe.crop_size
    layout, offset = dict[str, TensorPlace](), 0
    for name, channels, dtype in (
        ("disparity_px", 1, torch.float32),  # first, so that it begins at a multiple of four bytes
        ("left", 3, torch.uint8),
        ("right", 3, torch.uint8),
        ("occluded", 1, torch.bool),
    ):
        count = recipe.batch if channels == 3 else 2 * recipe.batch
        shape = (count, channels, height, width)
        layout[name] = TensorPlace(offset, shape, dtype)
        offset += prod(shape) * dtype.itemsize
    return layout, -(-offset // 64) * 64


def make_cool_down_recipe(recipe: Recipe, crop_size: tuple[int, int]) -> Recipe:
    """The recipe with other crops of other pairs: margins as before, and about as many pixels a batch."""
    margins = [pair - crop for pair, crop in zip(recipe.pair_size, recipe.crop_size, strict=True)]
    pair_size = (crop_size[0] + margins[0], crop_size[1] + margins[1])
    batch = max(1, round(recipe.batch * prod(recipe.crop_size) / prod(crop_size)))
    return replace(
        recipe, seed=recipe.seed + _OTHER_SEED, pair_size=pair_size, crop_size=crop_size, batch=batch
    )
