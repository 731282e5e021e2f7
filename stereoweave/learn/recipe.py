"""A recipe: everything that a training run depends on, in one TOML file."""

import tomllib
from dataclasses import MISSING, dataclass, fields
from operator import gt
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ConfigDict, Field, TypeAdapter, ValidationError

from stereoweave.errors import FormatError
from stereoweave.io.files import read_small, reading

# In characters; our longest recipe has 1,064. Python's time for a key grows with the square of its dots.
_LONGEST = 10_000
# In an error.
_LONGEST_VALUE = 100
# TOML's whole numbers; Python's may have any number of digits.
_MOST = 2**63 - 1
COLLAGE = "collage"


def _as_pairs(table: object) -> object:
    """A TOML table as pairs of name and value, which is how recipes and checkpoints hold it."""
    return tuple(table.items()) if isinstance(table, dict) else table


# A description is what errors say was expected.
Text = Annotated[str, Field(strict=True, description="a text in quotes")]
Switch = Annotated[bool, Field(strict=True, description="true or false")]
Target = Annotated[Literal["disparity", "depth"], Field(description="'disparity' or 'depth'")]
Whole = Annotated[
    int, Field(strict=True, ge=-_MOST, le=_MOST, description="a whole number of at most 64 bits")
]
CountOrZero = Annotated[Whole, Field(ge=0, description="a whole number of at least 0 and at most 64 bits")]
Count = Annotated[Whole, Field(ge=1, description="a whole number of at least 1 and at most 64 bits")]
Size = Annotated[tuple[Count, Count], Field(description="two whole numbers of at least 1")]
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0, description="a number above 0")]
NonNegative = Annotated[Number, Field(ge=0, description="a number of at least 0")]
AtLeastOne = Annotated[Number, Field(ge=1, description="a number of at least 1")]
Share = Annotated[Number, Field(ge=0, le=1, description="a number from 0 to 1")]
Weights = Annotated[
    tuple[tuple[Text, Positive], ...],
    BeforeValidator(_as_pairs),
    Field(description="a table of sets and their weights above 0, such as collage = 0.5"),
]
Folders = Annotated[
    tuple[tuple[Text, Text], ...],
    BeforeValidator(_as_pairs),
    Field(description='a table of names and folders, such as rooms = "held_out/rooms"'),
]


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """What to train, on what, for how long.

    Attributes:
        model: a name in MODELS or, for ablations, in VARIANTS.
        seed: of the first weights, the pairs and every draw.
        start_from: checkpoint whose averaged weights are the first ones where the network has such, of the
            same name and shape; the others, and all if empty, are random.
        steps: optimiser steps in all.
        batch: pairs a step.
        micro_batch: pairs that go through the network at once, which batch norms take their statistics from;
            a step goes along the mean gradient of its micro-batches. 0 is the whole batch.
        learning_rate: between warm-up and cool-down, along which it rises and falls linearly.
        weight_decay: AdamW's; with 0 it is Adam.
        averaged_steps: length of the running average of the weights, which is what scores and ships; longer
            lags behind, shorter keeps the noise of single batches, and 1 is the weights themselves.
        dataset: "collage", or a name in DATASETS.
        root: folder of the dataset as its authors unpack it; empty for collage.
        mix: what to train on instead of the dataset alone: sets, which are "collage" or folders of rendered
            pairs (data/shards.py), and their weights, of which the ratios count. Scores stay the dataset's.
        split: how the frames of a dataset are parted, a name in SPLITS (data/splits.py).
        pairs: collage pairs made once and kept; later steps cut them differently.
        fresh: whether a collage is painted each time one is drawn, and none is kept.
        pair_size: height and width of a kept collage pair.
        crop_size: height and width of what a step sees of a pair.
        augment: whether cuts are also scaled, mirrored and recoloured.
        offset_share: share of the pairs whose right crop is moved to the right, so that the disparity grows.
        validation_pairs: pairs to score on, never trained on: of another seed, or from the held-out frames.
        held_out: names of further sets to score on, and their folders of rendered pairs.
        validate_every: steps between two validations, each followed by a checkpoint.
        loss: a name in LOSSES: "weave" for WeaveNet, and the others, between codes, for the other networks.
        target: what a code stands for, "disparity" or "depth".
        max_disparity_px: code 1 as a disparity; truth above it counts as unknown.
        max_depth_m: code 0 as a depth; truth beyond it is an error.
        exponent: the paper's p.
        fit_exponent: p is fitted to the histogram of the training truth instead.
        alpha_z, alpha_p: weights of the loss between codes and of the projection loss.
        distribution: weight of WeaveNet's cross-entropies between levels; 0 leaves regression alone.
        robust: share of the logarithm in WeaveNet's regression, which counts large errors less.
        vgg16_weights: file of the VGG-16 behind the perceptual loss.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    name: Text
    model: Text
    seed: Whole = 0
    start_from: Text = ""
    steps: Count
    batch: Count
    micro_batch: CountOrZero = 0
    learning_rate: Positive
    warm_up_steps: Whole
    cool_down_steps: Whole
    weight_decay: NonNegative = 1e-4
    averaged_steps: Count = 500
    dataset: Text = COLLAGE
    root: Text = ""
    mix: Weights = ()
    split: Text = "random"
    pairs: Count = 4000
    fresh: Switch = False
    pair_size: Size = (320, 512)
    crop_size: Size = (256, 384)
    augment: Switch = True
    offset_share: Share = 0.0
    validation_pairs: Count = 64
    held_out: Folders = ()
    validate_every: Count = 500
    loss: Text = "weave"
    target: Target = "disparity"
    max_disparity_px: Positive = 192.0
    max_depth_m: Positive = 15.0
    exponent: AtLeastOne = 1.0
    fit_exponent: Switch = False
    alpha_z: NonNegative = 1.0
    alpha_p: NonNegative = 0.0
    distribution: NonNegative = 1.0
    robust: Share = 0.0
    vgg16_weights: Text = ""

    @property
    def micro_batches(self) -> int:
        """How many of them a step has."""
        return self.batch // (self.micro_batch or self.batch)

    def learning_rate_at(self, step: int) -> float:
        """The learning rate of a step, counted from 0."""
        warm_up = (step + 1) / max(self.warm_up_steps, 1)
        cool_down = (self.steps - step) / max(self.cool_down_steps, 1)
        return self.learning_rate * min(warm_up, cool_down, 1.0)


_RECIPES = TypeAdapter(Recipe)


def read_recipe(path: Path) -> Recipe:
    """The recipe of a TOML file; FormatError for a key that is unknown, missing, mistyped or out of range."""
    with reading(path, "a recipe in TOML"):
        text = read_small(path).decode()
        if len(text) > _LONGEST:
            raise ValueError(f"more than {_LONGEST} characters")
        values = tomllib.loads(text)
    return recipe_from(values, str(path))


def recipe_from(values: dict[str, Any], source: str) -> Recipe:
    """The recipe with these values; FormatError, which names their `source`, if they make none."""
    try:
        recipe = _RECIPES.validate_python(values)
    except ValidationError as error:
        raise FormatError(f"{source}: {_first_mistake(error, values)}") from error
    if contradiction := _contradiction(recipe):
        raise FormatError(f"{source}: {contradiction}")
    return recipe


def _first_mistake(error: ValidationError, values: dict[str, Any]) -> str:
    known: dict[str, Any] = {field.name: field.type for field in fields(Recipe)}
    if unknown := sorted(values.keys() - known.keys()):
        return f"unknown key {unknown[0]!r}; a recipe has {', '.join(known)}"
    first = min(error.errors(), key=lambda mistake: mistake["type"] == "missing")
    name = str(first["loc"][0])
    if name not in values:
        needed = [field.name for field in fields(Recipe) if field.default is MISSING]
        return f"missing key {name!r}; a recipe needs {', '.join(needed)}"
    expected = known[name].__metadata__[-1].description
    return f"{name}: expected {expected}, found {_written(values[name])}"


def _contradiction(recipe: Recipe) -> str | None:
    """The first two settings that exclude each other, in one line."""
    collage = recipe.dataset == COLLAGE
    if recipe.batch % (recipe.micro_batch or recipe.batch):
        return f"micro_batch: expected a divisor of batch = {recipe.batch}, found {recipe.micro_batch}"
    if collage and any(map(gt, recipe.crop_size, recipe.pair_size)):
        limit, found = list(recipe.pair_size), list(recipe.crop_size)
        return f"crop_size: expected at most pair_size = {limit}, found {found}"
    if recipe.mix and not collage:
        return f"mix: expected dataset = {COLLAGE!r}, which a mix is scored on, found {recipe.dataset!r}"
    if collage == bool(recipe.root):
        expected = "none for collage" if collage else "the dataset's folder"
        return f"root: expected {expected}, found {recipe.root!r} with dataset = {recipe.dataset!r}"
    return None


def _written(value: object) -> str:
    """The value as Python writes it, or its beginning."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # of a number of more than 4,300 digits, of nested arrays
        return "a value too long to be written"
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}..."
