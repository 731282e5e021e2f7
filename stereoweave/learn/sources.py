"""Where a recipe's pairs come from: collages that are kept, or the frames of a dataset on disk."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

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


def sources(recipe: Recipe, kept: Path) -> tuple[Source, Source]:
    """What a recipe trains on, and what it is scored on; collages are kept in folders below `kept`.

    Of the held-out frames of a dataset `validation_pairs` are taken, evenly spread.
    """
    if recipe.dataset == COLLAGE:
        return (
            KeptPairs(kept, recipe.seed, recipe.pairs, recipe.pair_size),
            KeptPairs(kept, VALIDATION_SEED, recipe.validation_pairs, recipe.pair_size),
        )
    if recipe.dataset not in DATASETS:
        raise FormatError(
            f"{recipe.name}: dataset = {recipe.dataset!r}, expected {COLLAGE} or {', '.join(DATASETS)}"
        )
    frames = open_dataset(recipe.dataset, recipe.root)
    training, held_out = split_frames(frames, recipe.dataset, recipe.split)
    stride = max(1, len(held_out) // recipe.validation_pairs)
    return Frames(training), Frames(held_out[::stride][: recipe.validation_pairs])
