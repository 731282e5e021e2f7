"""Sources of a recipe's pairs: collages, rendered sets, or a dataset on disk."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int
from rich.console import Console

from stereoweave.data.readers import DATASETS, Frame, open_dataset, split_frames
from stereoweave.data.shards import Shards, list_shards
from stereoweave.errors import FormatError
from stereoweave.learn.data import collage
from stereoweave.learn.data.pair_cache import CachedPairs
from stereoweave.learn.recipe import COLLAGE, Recipe
from stereoweave.stereo import Sample
from stereoweave.system.progress import progress

# Seed of validation pairs; the seeds of recipes are small.
VALIDATION_SEED = 1_000_003
# Memory in which training keeps decoded pairs: all 2,250 of a set by world at 320x240, a few of Sintel. The
# pairs that it validates on have as much of their own.
_KEPT_BYTES = 4 * 2**30


@runtime_checkable
class PairSource(Protocol):
    """Interface of a source that returns samples by index."""

    @property
    def count(self) -> int: ...

    def __getitem__(self, index: int) -> Sample: ...

    def name(self, index: int) -> str:
        """Return the sample's name for error messages."""
        ...


@runtime_checkable
class OrderedSource(Protocol):
    """Interface of a source that is faster to read in some orders than in others."""

    def order(self, rng: np.random.Generator) -> Int[np.ndarray, " n"] | range:
        """Return all indices, in an order that is fast to read."""
        ...


@dataclass(frozen=True)
class MixedSource:
    """Sets concatenated into one source, and the weights with which training draws from each set."""

    sets: tuple[PairSource, ...]
    weights: tuple[float, ...]

    @property
    def count(self) -> int:
        return sum(one.count for one in self.sets)

    def __getitem__(self, index: int) -> Sample:
        source, place = self._locate(index)
        return source[place]

    def name(self, index: int) -> str:
        source, place = self._locate(index)
        return source.name(place)

    def first_index(self, which: int) -> int:
        """Return the index of the first pair in set `which`."""
        return sum(one.count for one in self.sets[:which])

    def draw_sets(self, places: int, rng: np.random.Generator) -> Int[np.ndarray, " n"]:
        """Draw `places` sets at random, by weight.

        With the same seed, a longer sequence begins with the shorter one.
        """
        bounds = np.cumsum(self.weights) / np.sum(self.weights)
        return np.searchsorted(bounds[:-1], rng.random(places), side="right")

    def _locate(self, index: int) -> tuple[PairSource, int]:
        for one in self.sets:
            if index < one.count:
                return one, index
            index -= one.count
        raise IndexError(index)


@dataclass(frozen=True)
class FreshCollages:
    """Training collages that are painted on demand and never cached."""

    seed: int
    size: tuple[int, int]
    count: int = 10**9

    def __getitem__(self, index: int) -> Sample:
        return collage.paint_training_collage(self.seed, 0, index, *self.size)

    def name(self, index: int) -> str:
        return f"collage {index} of seed {self.seed}"

    def order(self, rng: np.random.Generator) -> range:
        """Return all indices in sequence, because collages are random in any order."""
        return range(self.count)


@dataclass(frozen=True)
class RenderedSet:
    """Rendered set with simulated camera imperfections, which are the same each time a pair is read."""

    shards: Shards

    @property
    def count(self) -> int:
        return self.shards.count

    def __getitem__(self, index: int) -> Sample:
        sample = self.shards[index]
        # As for collages, matching would be too easy without noise, blur and tone differences.
        left, right = collage.simulate_cameras(
            np.random.default_rng(index), sample.left.astype(np.float32), sample.right.astype(np.float32)
        )
        return replace(sample, left=left, right=right)

    def name(self, index: int) -> str:
        return self.shards.name(index)

    def order(self, rng: np.random.Generator) -> Int[np.ndarray, " n"]:
        return self.shards.order(rng)


@dataclass(frozen=True)
class DatasetFrames:
    """Frames of a dataset on disk, read on demand."""

    frames: list[Frame]

    @property
    def count(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Sample:
        return self.frames[index].read()

    def name(self, index: int) -> str:
        return self.frames[index].name


class KeptPairs:
    """Pairs of a source, each decoded once while they fit in memory.

    Decoding takes a quarter of a training step of the paper's network. Pairs beyond the limit are read every
    time: training reads all pairs in turn, so that dropping old ones would keep none until its turn.
    """

    def __init__(self, pairs: PairSource, most_bytes: int = _KEPT_BYTES) -> None:
        self.pairs = pairs
        self._kept: dict[int, Sample] = {}
        self._left_bytes = most_bytes

    @property
    def count(self) -> int:
        return self.pairs.count

    def __getitem__(self, index: int) -> Sample:
        if index in self._kept:
            return self._kept[index]
        sample = self.pairs[index]
        size = sum(value.nbytes for value in vars(sample).values() if isinstance(value, np.ndarray))
        if size <= self._left_bytes:
            self._kept[index] = sample
            self._left_bytes -= size
        return sample

    def name(self, index: int) -> str:
        return self.pairs.name(index)


def open_sources(recipe: Recipe, folder: Path, whole: bool = False) -> tuple[PairSource, PairSource]:
    """Open a recipe's training and held-out pairs; collages are cached in folders below `folder`.

    If `whole`, all held-out frames of a dataset are used; otherwise, `validation_pairs` evenly spread frames.
    """
    if recipe.dataset == COLLAGE:
        collages = _open_collages(recipe, folder)
        return (
            _mix_sets(recipe, collages) if recipe.mix else collages,
            CachedPairs(folder, VALIDATION_SEED, recipe.validation_pairs, recipe.pair_size),
        )
    training, held_out, _ = divide_frames(recipe)
    if whole:
        return KeptPairs(DatasetFrames(training)), DatasetFrames(held_out)
    spread = spread_evenly(held_out, recipe.validation_pairs)
    return KeptPairs(DatasetFrames(training)), KeptPairs(DatasetFrames(spread))


def spread_evenly(frames: Sequence[Frame], most: int | None) -> list[Frame]:
    """Return at most that many of the frames, evenly spread from the first to the last; None for all."""
    count = len(frames) if most is None else min(most, len(frames))
    return [frames[i] for i in np.linspace(0, len(frames) - 1, count).round().astype(int)]


class FrameParts(NamedTuple):
    """Frames of a dataset that a recipe trains on, holds out, and leaves out of both, each sorted by name."""

    training: list[Frame]
    held_out: list[Frame]
    left_out: list[Frame]


def divide_frames(recipe: Recipe) -> FrameParts:
    """Divide the frames of a recipe's dataset on disk.

    Raises:
        StereoweaveError: The dataset or a split is unknown, the dataset is incomplete, or a part is empty.
    """
    if recipe.dataset not in DATASETS:
        raise FormatError(
            f"{recipe.name}: dataset = {recipe.dataset!r}, expected one of {COLLAGE}, {', '.join(DATASETS)}"
        )
    frames, left_out = open_dataset(recipe.dataset, recipe.root), list[Frame]()
    if recipe.leave_out:
        frames, left_out = split_frames(frames, recipe.dataset, recipe.leave_out)
    return FrameParts(*split_frames(frames, recipe.dataset, recipe.split), left_out)


def _open_collages(recipe: Recipe, folder: Path) -> PairSource:
    if recipe.fresh:
        return FreshCollages(recipe.seed, recipe.pair_size)
    return CachedPairs(folder, recipe.seed, recipe.pairs, recipe.pair_size)


def _mix_sets(recipe: Recipe, collages: PairSource) -> MixedSource:
    sets: list[PairSource] = []
    weights: list[float] = []
    for name, weight in recipe.mix:
        found = [collages] if name == COLLAGE else _open_rendered_sets(recipe, Path(name))
        count = sum(one.count for one in found)
        sets += found
        weights += [weight * one.count / count for one in found]
    return MixedSource(tuple(sets), tuple(weights))


def open_held_out_sets(recipe: Recipe) -> dict[str, PairSource]:
    """Open a recipe's additional validation sets, keyed by name. Raises FormatError if one is missing."""
    sets: dict[str, PairSource] = {}
    for name, folder in recipe.held_out:
        found = tuple(
            RenderedSet(Shards(path)) for path in _find_set_folders(recipe, "held_out", Path(folder))
        )
        sets[name] = MixedSource(found, (1.0,) * len(found))
    return sets


def _find_set_folders(recipe: Recipe, key: str, folder: Path) -> list[Path]:
    """Return the rendered sets among the folder and its subfolders. Raises FormatError if there are none."""
    folders = [path for path in (folder, *sorted(folder.glob("*/"))) if list_shards(path)]
    if not folders:
        raise FormatError(
            f"{recipe.name}: {key}: {folder}: expected pairs made by `stereoweave synth make` or "
            "folders of such pairs, found none; render them first"
        )
    return folders


def _open_rendered_sets(recipe: Recipe, folder: Path) -> list[PairSource]:
    """Open the rendered sets in a folder. Raises FormatError if there are none or a pair is too small."""
    folders = _find_set_folders(recipe, "mix", folder)
    sets: list[PairSource] = [RenderedSet(Shards(path)) for path in folders]
    for path, one in zip(folders, sets, strict=True):
        rows, columns = one[0].disparity_px.shape
        if recipe.crop_size[0] > rows or recipe.crop_size[1] > columns:
            raise FormatError(
                f"{recipe.name}: crop_size = {list(recipe.crop_size)}, expected at most {[rows, columns]}, "
                f"the size of the pairs in {path}; use a smaller crop"
            )
    return sets


def cache_pairs(pairs: PairSource, console: Console) -> PairSource:
    """Make the missing collages of a source, and return the source."""
    if isinstance(pairs, MixedSource):
        for one in pairs.sets:
            cache_pairs(one, console)
    if isinstance(pairs, CachedPairs) and (missing := len(pairs.missing())):
        with progress(console) as bar:
            task = bar.add_task("making pairs", total=missing, loss="", rate="")
            for _ in pairs.make(console):
                bar.advance(task)
            # Another training may have made some of the pairs.
            bar.update(task, completed=missing)
    return pairs
