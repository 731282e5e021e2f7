"""Worker processes that paint and crop batches during training and pass them through shared memory.

Each process has two slots for batches and a pipe, but no lock that a killed process could leave held. A
process that exits is noticed immediately.
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

_SLOTS = 2  # per process: one is filled while the other waits to be taken
# Compiling kernels and building textures takes a minute on a slow machine.
_PATIENCE_S = 180.0
# Number of pairs that a process keeps in memory to crop again.
_HELD = 96
_MOST_CUTS = 4.0
# Added to the seed in the cool-down, whose batches have the same numbers but need different pairs.
_OTHER_SEED = 1000


class BatchRequest(NamedTuple):
    """A request for a batch: slot, batch number, recipe index, and how often each pair is cropped."""

    slot: int
    number: int
    recipe: int
    cuts: float


class PainterShare(NamedTuple):
    """One process's share: recipes, folder of the held-out pairs, process index, and number of processes."""

    recipes: tuple[Recipe, ...]
    folder: Path
    place: int
    processes: int


class PaintedBatch(NamedTuple):
    """A finished batch; `problem` holds the traceback if the batch failed and is empty otherwise."""

    request: BatchRequest
    problem: str = ""


class TensorPlace(NamedTuple):
    """A tensor's place in a slot: byte offset, shape and type."""

    offset: int
    shape: tuple[int, ...]
    dtype: torch.dtype


class ReusedPairs:
    """Source that returns each pair `cuts` times on average, because painting takes longer than cropping."""

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
    """Processes that make a recipe's batches; they are stopped when the context exits.

    Args:
        recipes: Recipes of the batches; `switch` selects one.
        folder: Folder of the held-out pairs.
        processes: Number of processes.
        first: Number of the first batch. If the recipe paints fresh pairs, each number has its own pairs.
        pinned: Whether to copy batches to pinned memory, which a GPU can read directly.

    Attributes:
        cuts: How often each new pair is cropped; 1 while painting keeps up with training.
        taken: Number of batches taken.
        late: Number of batches that were not ready when requested.
        failures: Tracebacks of failed batches.
    """

    def __init__(
        self, recipes: Sequence[Recipe], folder: Path, processes: int, first: int = 0, pinned: bool = False
    ) -> None:
        self.recipes, self.pinned, self.number, self.recipe = tuple(recipes), pinned, first, 0
        self.cuts, self.taken, self.late = 1.0, 0, 0
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
                self._request(here, slot)

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
        """Request batches of another recipe from now on; batches already requested come first."""
        self.recipe = recipe

    def adapt(self, late_share: float) -> None:
        """Crop each pair more often if over 10 % of the batches were late, and less often if none were."""
        if late_share > 0.1:
            self.cuts = min(self.cuts * 1.5, _MOST_CUTS)
        elif late_share == 0:
            self.cuts = max(self.cuts / 1.2, 1.0)

    def take(self) -> dict[str, torch.Tensor]:
        """Take the next finished batch, in the format of `collate` but with uint8 images.

        Raises:
            StereoweaveError: All processes have exited, too many batches failed, or none arrived in time.
        """
        self._collect(0)
        self.late += not self._ready
        while True:
            while not self._ready:
                self._collect(_PATIENCE_S)
            here, done = self._ready.popleft()
            if not done.problem:
                break
            self._handle_failure(here, done)
        batch = {
            name: torch.empty(view.shape, dtype=view.dtype, pin_memory=self.pinned).copy_(view)
            for name, view in self._views(here, done.request).items()
        }
        self._request(here, done.request.slot)
        self.taken += 1
        return batch

    def _handle_failure(self, here: Connection, done: PaintedBatch) -> None:
        self.failures.append(done.problem)
        if len(self.failures) > 5 + self.taken // 20:
            raise StereoweaveError(
                f"{len(self.failures)} of {len(self.failures) + self.taken} batches failed; "
                f"the last of them failed with {done.problem}"
            )
        self._request(here, done.request.slot)

    def _collect(self, patience_s: float) -> None:
        """Collect finished batches, and drop processes that have exited."""
        heard = wait(list(self._memory), patience_s)
        if patience_s and not heard:
            raise StereoweaveError(f"no batch arrived for {patience_s:.0f} s; use fewer processes")
        for here in heard:
            assert isinstance(here, Connection)
            try:
                self._ready.append((here, here.recv()))
            except (EOFError, OSError):
                self._drop(here)

    def _drop(self, here: Connection) -> None:
        del self._memory[here]
        self._ready = deque(entry for entry in self._ready if entry[0] is not here)
        if not self._memory:
            raise StereoweaveError(
                "every process that makes batches has exited; check whether memory ran out"
            )

    def _request(self, here: Connection, slot: int) -> None:
        try:
            here.send(BatchRequest(slot, self.number, self.recipe, self.cuts))
        except OSError:
            return  # the process has exited, which the next `_collect` will notice
        self.number += 1

    def _views(self, here: Connection, request: BatchRequest) -> dict[str, torch.Tensor]:
        return _view_tensors(self._memory[here], request.slot, self.recipes[request.recipe])


def _run_painter(pipe: Connection, memory: Any, share: PainterShare) -> None:
    """Make requested batches in a worker process until the pipe closes."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    _save_held_out(share)
    batches = [_make_batches(recipe, share.folder) for recipe in share.recipes]
    while True:
        try:
            request: BatchRequest = pipe.recv()
            pipe.send(_paint_batch(request, batches[request.recipe], memory))
        except (EOFError, OSError):
            return


def _save_held_out(share: PainterShare) -> None:
    """Paint and save this process's share of the held-out pairs."""
    held_out = open_sources(share.recipes[0], share.folder)[1]
    if isinstance(held_out, CachedPairs):
        held_out.folder.mkdir(parents=True, exist_ok=True)
        for index in range(share.place, held_out.count, share.processes):
            held_out.keep(index, collage.paint_collage(held_out.seed, 0, index, *held_out.size))


def _make_batches(recipe: Recipe, folder: Path) -> Batches:
    batches = Batches(recipe, open_sources(recipe, folder)[0])
    batches.pairs = ReusedPairs(batches.pairs)
    return batches


def _paint_batch(request: BatchRequest, batches: Batches, memory: Any) -> PaintedBatch:
    """Make the requested batch in its slot of the shared memory."""
    assert isinstance(batches.pairs, ReusedPairs)
    batches.pairs.cuts = request.cuts
    try:
        batch = batches[request.number]
        for name, view in _view_tensors(memory, request.slot, batches.recipe).items():
            values = batch[name]
            view.copy_((values * 255).round() if view.dtype == torch.uint8 else values)
    except Exception:  # an error in one batch must not stop the others
        return PaintedBatch(request, traceback.format_exc())
    return PaintedBatch(request)


def _view_tensors(memory: Any, slot: int, recipe: Recipe) -> dict[str, torch.Tensor]:
    """Return a batch's tensors as views into its slot of the shared memory."""
    layout, _ = _compute_layout(recipe)
    start = slot * (len(memory) // _SLOTS)
    return {
        name: torch.frombuffer(
            memory, dtype=place.dtype, count=prod(place.shape), offset=start + place.offset
        ).view(place.shape)
        for name, place in layout.items()
    }


def _compute_layout(recipe: Recipe) -> tuple[dict[str, TensorPlace], int]:
    """Return the place of each tensor of a batch in a slot, and the slot's size in bytes."""
    height, width = recipe.crop_size
    layout, offset = dict[str, TensorPlace](), 0
    for name, channels, dtype in (
        ("disparity_px", 1, torch.float32),  # first, so that its offset is a multiple of four bytes
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
    """Return the recipe with a different crop size and different pairs.

    The margins around the crops stay the same, and a batch has about as many pixels as before.
    """
    margins = [pair - crop for pair, crop in zip(recipe.pair_size, recipe.crop_size, strict=True)]
    pair_size = (crop_size[0] + margins[0], crop_size[1] + margins[1])
    batch = max(1, round(recipe.batch * prod(recipe.crop_size) / prod(crop_size)))
    return replace(
        recipe, seed=recipe.seed + _OTHER_SEED, pair_size=pair_size, crop_size=crop_size, batch=batch
    )
