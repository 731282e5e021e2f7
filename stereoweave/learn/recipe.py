"""Recipes: TOML files with all settings of a training run."""

import tomllib
from dataclasses import MISSING, dataclass, fields
from operator import gt
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ConfigDict, Field, TypeAdapter, ValidationError

from stereoweave.errors import FormatError
from stereoweave.io.files import read_small, reading

# Maximum number of characters in a recipe. The longest shipped recipe has 1,064. tomllib takes quadratic time
# for a key with many dots.
_LONGEST = 10_000
# Maximum number of characters of a value that an error quotes.
_LONGEST_VALUE = 100
# TOML limits whole numbers to 64 bits, but tomllib also reads larger ones.
_MOST = 2**63 - 1
COLLAGE = "collage"


def _as_pairs(table: object) -> object:
    """Return a TOML table as a tuple of pairs, which is hashable; return any other value unchanged."""
    return tuple(table.items()) if isinstance(table, dict) else table


# Errors quote these descriptions after "expected".
Text = Annotated[str, Field(strict=True, description="text in quotes")]
Switch = Annotated[bool, Field(strict=True, description="true or false")]
Target = Annotated[Literal["disparity", "depth"], Field(description="'disparity' or 'depth'")]
Whole = Annotated[
    int, Field(strict=True, ge=-_MOST, le=_MOST, description="a whole number that fits in 64 bits")
]
CountOrZero = Annotated[Whole, Field(ge=0, description="a whole number of at least 0 that fits in 64 bits")]
Count = Annotated[Whole, Field(ge=1, description="a whole number of at least 1 that fits in 64 bits")]
Size = Annotated[tuple[Count, Count], Field(description="two whole numbers of at least 1")]
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0, description="a number above 0")]
NonNegative = Annotated[Number, Field(ge=0, description="a number of at least 0")]
AtLeastOne = Annotated[Number, Field(ge=1, description="a number of at least 1")]
Share = Annotated[Number, Field(ge=0, le=1, description="a number from 0 to 1")]
Weights = Annotated[
    tuple[tuple[Text, Positive], ...],
    BeforeValidator(_as_pairs),
    Field(description="a table of sets with weights above 0, such as collage = 0.5"),
]
Parts = Annotated[tuple[Text, ...], Field(description='a list of parts, such as ["refinement"]')]
Folders = Annotated[
    tuple[tuple[Text, Text], ...],
    BeforeValidator(_as_pairs),
    Field(description='a table of names and folders, such as rooms = "held_out/rooms"'),
]


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Model, data, loss and schedule of a training run.

    Attributes:
        name: Name of the run and of the network.
        model: Key of MODELS.
        seed: Seed of the initial weights, the pairs and all other random numbers.
        start_from: Checkpoint whose averaged weights initialise all weights of the same name and shape; the
            other weights are random. If it is empty, all weights are random.
        steps: Total number of optimiser steps.
        batch: Pairs per step.
        micro_batch: Pairs per forward pass, over which batch norm computes its statistics. A step uses the
            mean gradient of its micro-batches. 0 means the whole batch.
        learning_rate: Peak learning rate, reached by a linear warm-up and followed by a linear cool-down.
        warm_up_steps: Number of steps at the start in which the learning rate rises.
        cool_down_steps: Number of steps at the end in which the learning rate falls.
        weight_decay: Weight decay of AdamW; 0 selects Adam.
        averaged_steps: Length of the running average of the weights, which validation and export use. A
            longer average lags behind, and a shorter average keeps the noise of single batches. 1 disables
            averaging.
        dataset: "collage" or a key of DATASETS.
        root: Folder of the unpacked dataset; empty for collage.
        mix: Training sets that replace the dataset, with their relative weights. A set is "collage" or a
            folder of rendered pairs (data/shards.py). Validation still uses the dataset.
        split: Key of SPLITS (data/splits.py), which divides frames into training and held-out frames.
        leave_out: Another key of SPLITS, whose held-out frames are left out first: they are neither trained
            on nor validated on, so that one network can be scored on both splits. Empty for none.
        pairs: Number of collage pairs to cache; every step crops them differently.
        fresh: Paint a new collage for each draw, of any kind in docs/training-data.md, instead of caching
            pairs of mixed objects.
        pair_size: Height and width of a collage pair.
        crop_size: Height and width of the crops that a step trains on.
        augment: Also scale, mirror and recolour crops.
        offset_share: Share of pairs whose right crop is shifted to the right, which increases disparity.
        padded_share: Share of augmented crops that end in padding. At inference, pictures whose sides are no
            multiples of the network's are padded.
        validation_pairs: Number of pairs to validate on: collages with another seed, or held-out frames.
        held_out: Further validation sets, each with its name and its folder of rendered pairs.
        validate_every: Steps between validations; each validation is followed by a checkpoint.
        loss: Key of LOSSES: "weave" for WeaveNet, "hinge" for MC-CNN; for all other networks, a loss that
            compares codes.
        target: Quantity that a code encodes, "disparity" or "depth".
        max_disparity_px: Disparity of code 1; larger true disparities count as unknown.
        max_depth_m: Depth of code 0; a larger true depth is an error.
        exponent: The paper's exponent p.
        fit_exponent: Fit p to the histogram of the training pairs' ground truth instead.
        alpha_z: Weight of the loss between codes.
        alpha_p: Weight of the projection loss.
        distribution: Weight of WeaveNet's cross-entropy over disparity levels; 0 for regression only.
        robust: Share of the logarithm in WeaveNet's regression loss, which reduces the effect of large
            errors.
        steadiness: Weight of WeaveNet's loss on upsamplings that amplify rounding errors.
        steadiness_share: Share of the micro-batches that have this loss, which more than doubles their time.
        teacher: Checkpoint of a trained WeaveNet, whose results are targets beside the ground truth; empty
            for none.
        taught: Weight of the losses between the network's results and the teacher's.
        trained: Parts of the network to train, named by the first part of their parameters' names; the others
            keep their weights and statistics. Empty for all.
        vgg16_weights: File with VGG-16 weights for the perceptual loss.
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
    warm_up_steps: CountOrZero
    cool_down_steps: CountOrZero
    weight_decay: NonNegative = 1e-4
    averaged_steps: Count = 500
    dataset: Text = COLLAGE
    root: Text = ""
    mix: Weights = ()
    split: Text = "random"
    leave_out: Text = ""
    pairs: Count = 4000
    fresh: Switch = False
    pair_size: Size = (320, 512)
    crop_size: Size = (256, 384)
    augment: Switch = True
    offset_share: Share = 0.0
    padded_share: Share = 0.0
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
    steadiness: NonNegative = 0.0
    steadiness_share: Share = 1.0
    teacher: Text = ""
    taught: NonNegative = 0.5
    trained: Parts = ()
    vgg16_weights: Text = ""

    @property
    def micro_batches(self) -> int:
        """Number of micro-batches per step."""
        return self.batch // (self.micro_batch or self.batch)

    def learning_rate_at(self, step: int) -> float:
        """Return the learning rate of a step, counted from 0."""
        warm_up = (step + 1) / max(self.warm_up_steps, 1)
        cool_down = (self.steps - step) / max(self.cool_down_steps, 1)
        return self.learning_rate * min(warm_up, cool_down, 1.0)


_RECIPES = TypeAdapter(Recipe)


def read_recipe(path: Path) -> Recipe:
    """Read a recipe from a TOML file.

    Raises:
        FormatError: If the file is unreadable, or if a key is unknown, missing, of the wrong type or out of
            range.
    """
    with reading(path, "a recipe in TOML"):
        text = read_small(path).decode()
        if len(text) > _LONGEST:
            raise ValueError(f"more than {_LONGEST} characters")
        values = tomllib.loads(text)
    return parse_recipe(values, str(path))


def parse_recipe(values: dict[str, Any], source: str) -> Recipe:
    """Make a recipe from a dictionary of its values.

    Raises:
        FormatError: If the values are invalid; the message begins with `source`.
    """
    try:
        recipe = _RECIPES.validate_python(values)
    except ValidationError as error:
        raise FormatError(f"{source}: {_describe_mistake(error, values)}") from error
    if contradiction := _find_contradiction(recipe):
        raise FormatError(f"{source}: {contradiction}")
    return recipe


def _describe_mistake(error: ValidationError, values: dict[str, Any]) -> str:
    """Describe one mistake in a single line: an unknown key, else an invalid value, else a missing key."""
    known: dict[str, Any] = {field.name: field.type for field in fields(Recipe)}
    if unknown := sorted(values.keys() - known.keys()):
        return f"unknown key {unknown[0]!r}; a recipe has {', '.join(known)}"
    first = min(error.errors(), key=lambda mistake: mistake["type"] == "missing")
    name = str(first["loc"][0])
    if name not in values:
        needed = [field.name for field in fields(Recipe) if field.default is MISSING]
        return f"missing key {name!r}; a recipe needs {', '.join(needed)}"
    expected = known[name].__metadata__[-1].description
    return f"{name}: expected {expected}, found {_shorten(values[name])}"


def _find_contradiction(recipe: Recipe) -> str | None:
    """Describe the first contradiction between settings in one line, or return None."""
    collage = recipe.dataset == COLLAGE
    if recipe.batch % (recipe.micro_batch or recipe.batch):
        return f"micro_batch: expected a divisor of batch = {recipe.batch}, found {recipe.micro_batch}"
    if collage and any(map(gt, recipe.crop_size, recipe.pair_size)):
        limit, found = list(recipe.pair_size), list(recipe.crop_size)
        return f"crop_size: expected at most pair_size = {limit}, found {found}"
    if recipe.mix and not collage:
        return f"mix: expected dataset = {COLLAGE!r} to validate the mix on, found {recipe.dataset!r}"
    if recipe.leave_out and (collage or recipe.leave_out == recipe.split):
        expected = "none for collages" if collage else f"a split other than split = {recipe.split!r}"
        return f"leave_out: expected {expected}, found {recipe.leave_out!r}"
    if collage == bool(recipe.root):
        expected = "no folder" if collage else "the dataset's folder"
        return f"root: expected {expected}, found {recipe.root!r} with dataset = {recipe.dataset!r}"
    return None


def _shorten(value: object) -> str:
    """Return the repr of a value, shortened for an error message."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # over 4,300 digits; deeply nested arrays
        return "a value too long to show"
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}..."
