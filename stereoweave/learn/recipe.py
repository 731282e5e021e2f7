"""A recipe: everything that a training run depends on, in one TOML file."""

import math
import tomllib
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

from stereoweave.errors import FormatError
from stereoweave.io.files import read_small, reading

# In characters; our longest recipe has 1,064. Python's time for a key grows with the square of its dots.
_LONGEST = 10_000
# In an error.
_LONGEST_VALUE = 100
# TOML's whole numbers; Python's may have any number of digits.
_WHOLE_BITS = 64
_POSITIVE = (
    "steps",
    "batch",
    "learning_rate",
    "pairs",
    "validation_pairs",
    "validate_every",
    "averaged_steps",
    "max_disparity_px",
    "max_depth_m",
)
_AT_LEAST = {"micro_batch": 0, "exponent": 1, "alpha_z": 0, "alpha_p": 0, "distribution": 0}
_SHARES = ("offset_share", "robust")
COLLAGE = "collage"
Weights = tuple[tuple[str, float], ...]
Folders = tuple[tuple[str, str], ...]
TARGETS = ("disparity", "depth")
_KINDS: dict[object, str] = {
    int: f"a whole number of at most {_WHOLE_BITS} bits",
    float: "a number",
    str: "a text in quotes",
    bool: "true or false",
    Weights: "a table of sets and their weights, such as collage = 0.5",
    Folders: 'a table of names and folders, such as rooms = "held_out/rooms"',
}


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

    name: str
    model: str
    seed: int = 0
    start_from: str = ""
    steps: int
    batch: int
    micro_batch: int = 0
    learning_rate: float
    warm_up_steps: int
    cool_down_steps: int
    weight_decay: float = 1e-4
    averaged_steps: int = 500
    dataset: str = COLLAGE
    root: str = ""
    mix: Weights = ()
    split: str = "random"
    pairs: int = 4000
    fresh: bool = False
    pair_size: tuple[int, int] = (320, 512)
    crop_size: tuple[int, int] = (256, 384)
    augment: bool = True
    offset_share: float = 0.0
    validation_pairs: int = 64
    held_out: Folders = ()
    validate_every: int = 500
    loss: str = "weave"
    target: str = "disparity"
    max_disparity_px: float = 192.0
    max_depth_m: float = 15.0
    exponent: float = 1.0
    fit_exponent: bool = False
    alpha_z: float = 1.0
    alpha_p: float = 0.0
    distribution: float = 1.0
    robust: float = 0.0
    vgg16_weights: str = ""

    @property
    def micro_batches(self) -> int:
        """How many of them a step has."""
        return self.batch // (self.micro_batch or self.batch)

    def learning_rate_at(self, step: int) -> float:
        """The learning rate of a step, counted from 0."""
        warm_up = (step + 1) / max(self.warm_up_steps, 1)
        cool_down = (self.steps - step) / max(self.cool_down_steps, 1)
        return self.learning_rate * min(warm_up, cool_down, 1.0)


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
    known = {field.name: field.type for field in fields(Recipe)}
    if unknown := sorted(values.keys() - known.keys()):
        raise FormatError(f"{source}: unknown key {unknown[0]!r}; a recipe has {', '.join(known)}")
    for name, value in values.items():
        if not _fits(value, known[name]):
            kind = _KINDS.get(known[name], "two whole numbers")
            raise FormatError(f"{source}: {name} = {_written(value)}, expected {kind}")
    needed = [field.name for field in fields(Recipe) if field.default is MISSING]
    if missing := [name for name in needed if name not in values]:
        raise FormatError(f"{source}: missing key {missing[0]!r}; a recipe needs {', '.join(needed)}")
    settings: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    # A table in TOML, pairs of set and weight in a checkpoint.
    tables = {name: tuple(dict(settings.get(name, ())).items()) for name in ("mix", "held_out")}
    recipe = Recipe(**{**settings, **tables})
    _check_numbers(recipe, source)
    _check_sizes(recipe, source)
    _check_mix(recipe, source)
    if recipe.target not in TARGETS:
        raise FormatError(f"{source}: target = {recipe.target!r}, expected {' or '.join(TARGETS)}")
    if (recipe.dataset == COLLAGE) == bool(recipe.root):
        raise FormatError(
            f"{source}: dataset = {recipe.dataset!r} with root = {recipe.root!r}, expected a root for a "
            "dataset on disk and none for collage"
        )
    return recipe


def _check_numbers(recipe: Recipe, source: str) -> None:
    for name in _POSITIVE:
        if not 0 < getattr(recipe, name) < math.inf:
            raise FormatError(f"{source}: {name} = {getattr(recipe, name)}, expected more than 0")
    for name, least in _AT_LEAST.items():
        if not least <= getattr(recipe, name) < math.inf:
            raise FormatError(f"{source}: {name} = {getattr(recipe, name)}, expected at least {least}")
    for name in _SHARES:
        if not 0 <= getattr(recipe, name) <= 1:
            raise FormatError(f"{source}: {name} = {getattr(recipe, name)}, expected 0 to 1")
    if recipe.batch % (recipe.micro_batch or recipe.batch):
        raise FormatError(
            f"{source}: micro_batch = {recipe.micro_batch}, expected a divisor of batch = {recipe.batch}"
        )


def _check_sizes(recipe: Recipe, source: str) -> None:
    limits = recipe.pair_size if recipe.dataset == COLLAGE else (math.inf, math.inf)
    if not all(0 < crop <= side for crop, side in zip(recipe.crop_size, limits, strict=True)):
        raise FormatError(
            f"{source}: crop_size = {list(recipe.crop_size)}, expected more than 0 and "
            f"at most pair_size = {list(recipe.pair_size)}"
        )


def _check_mix(recipe: Recipe, source: str) -> None:
    for name, weight in recipe.mix:
        if not 0 < weight < math.inf:
            raise FormatError(f"{source}: mix: weight {weight} of {name!r}, expected more than 0")
    if recipe.mix and recipe.dataset != COLLAGE:
        raise FormatError(
            f"{source}: mix with dataset = {recipe.dataset!r}, expected {COLLAGE!r}, which a mix is scored on"
        )


def _written(value: object) -> str:
    """The value as Python writes it, or its beginning."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # of a number of more than 4,300 digits, of nested arrays
        return "a value too long to be written"
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}..."


def _fits(value: object, expected: Any) -> bool:
    if type(value) is int:
        return expected in (int, float) and value.bit_length() < _WHOLE_BITS
    if expected is float:
        return isinstance(value, float)
    if expected in (int, str, bool):
        return type(value) is expected
    if expected in (Weights, Folders):
        pairs = list(value.items()) if isinstance(value, dict) else value
        of = float if expected is Weights else str
        return isinstance(pairs, list | tuple) and all(_is_named(pair, of) for pair in pairs)
    return isinstance(value, list | tuple) and len(value) == 2 and all(_fits(v, int) for v in value)


def _is_named(pair: object, kind: type) -> bool:
    """Whether it is a name and a value of that kind."""
    return isinstance(pair, list | tuple) and len(pair) == 2 and _fits(pair[0], str) and _fits(pair[1], kind)
