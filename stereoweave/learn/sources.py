"""Where a recipe's pairs come from: collages that are kept, or the frames of a dataset on disk."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from stereoweave.data.readers import DATASETS, Frame, open_dataset, split_frames
from stereoweave.errors import FormatError
from stereoweave.learn.pairs import KeptPairs
from stereoweave.learn.recipe import COLLAGE, Recipe
from stereoweave.stereo import Sample

# Validation pairs come from this seed; a recipe's own is small.
VALIDATION_SEED = 1_000_003


@runtime_checkable
class Source(Protocol):
    """Samples by their index."""

    @property
    def count(self) -> int: ...

    def __getitem__(self, index: int) -> Sample: ...

    def name(self, index: int) -> str:
        """What an error calls the sample."""
        ...


@dataclass(frozen=True)
class Frames:
    """Frames of a dataset on disk, read when they are asked for."""

    frames: list[Frame]

    @property
    def count(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Sample:
        return self.frames[index].read()

    def name(self, index: int) -> str:
        return self.frames[index].name


def sources(recipe: Recipe, folder: Path, whole: bool = False) -> tuple[Source, Source]:
    """What a recipe trains on, and what it is scored on; collages are kept in folders below `folder`.

    Of the held-out frames of a dataset `validation_pairs` are taken, evenly spread, or all if `whole`.
    """
    if recipe.dataset == COLLAGE:
        return (
            KeptPairs(folder, recipe.seed, recipe.pairs, recipe.pair_size),
            KeptPairs(folder, VALIDATION_SEED, recipe.validation_pairs, recipe.pair_size),
        )
    if recipe.dataset not in DATASETS:
        raise FormatError(
            f"{recipe.name}: dataset = {recipe.dataset!r}, expected {COLLAGE} or {', '.join(DATASETS)}"
        )
    frames = open_dataset(recipe.dataset, recipe.root)
    training, held_out = split_frames(frames, recipe.dataset, recipe.split)
    count = len(held_out) if whole else min(recipe.validation_pairs, len(held_out))
    spread = np.linspace(0, len(held_out) - 1, count).round().astype(int)
    return Frames(training), Frames([held_out[i] for i in spread])


def kept(pairs: Source, console: Console) -> Source:
    """The pairs; collages are made before if they were not there."""
    if isinstance(pairs, KeptPairs) and (missing := len(pairs.missing())):
        with progress(console) as bar:
            task = bar.add_task("making pairs", total=missing, loss="", rate="")
            for _ in pairs.make():
                bar.advance(task)
    return pairs


def progress(console: Console) -> Progress:
    """A bar for long work; its tasks have the fields loss and rate."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, TextColumn("{task.fields[loss]} {task.fields[rate]}"), console=console)
