"""A recipe: everything that a training run depends on, in one TOML file."""

import math
import tomllib
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

from stereoweave.errors import FormatError

_KINDS: dict[object, str] = {int: "a whole number", float: "a number", str: "a text in quotes"}
_POSITIVE = ("steps", "batch", "learning_rate", "pairs", "validation_pairs", "validate_every")


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """What to train, on what, for how long.

    Attributes:
        model: a name in MODELS.
        seed: of the first weights, the pairs and every draw.
        start_from: checkpoint whose averaged weights are the first ones; empty for random ones.
        steps: optimiser steps in all.
        batch: pairs a step; both views of each are predicted.
        learning_rate: between warm-up and cool-down, along which it rises and falls linearly.
        weight_decay: AdamW's.
        pairs: collage pairs made once and kept; later steps cut them differently.
        pair_size, crop_size: height and width of a kept pair and of what a step sees of it.
        validation_pairs: collage pairs of another seed, never trained on.
        validate_every: steps between two validations, each followed by a checkpoint.
    """

    name: str
    model: str
    seed: int = 0
    start_from: str = ""
    steps: int
    batch: int
    learning_rate: float
    warm_up_steps: int
    cool_down_steps: int
    weight_decay: float = 1e-4
    pairs: int
    pair_size: tuple[int, int] = (320, 512)
    crop_size: tuple[int, int] = (256, 384)
    validation_pairs: int = 64
    validate_every: int = 500

    def learning_rate_at(self, step: int) -> float:
        """The learning rate of a step, counted from 0."""
        warm_up = (step + 1) / max(self.warm_up_steps, 1)
        cool_down = (self.steps - step) / max(self.cool_down_steps, 1)
        return self.learning_rate * min(warm_up, cool_down, 1.0)


def read_recipe(path: Path) -> Recipe:
    """The recipe of a TOML file; FormatError for a key that is unknown, missing, mistyped or out of range."""
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise FormatError(f"{path}: expected a recipe in TOML, found: {error}") from error
    return recipe_from(values, str(path))


def recipe_from(values: dict[str, Any], source: str) -> Recipe:
    """The recipe with these values; FormatError, which names their `source`, if they make none."""
    known = {field.name: field.type for field in fields(Recipe)}
    if unknown := sorted(values.keys() - known.keys()):
        raise FormatError(f"{source}: unknown key {unknown[0]!r}; a recipe has {', '.join(known)}")
    for name, value in values.items():
        if not _fits(value, known[name]):
            kind = _KINDS.get(known[name], "two whole numbers")
            raise FormatError(f"{source}: {name} = {value!r}, expected {kind}")
    needed = [field.name for field in fields(Recipe) if field.default is MISSING]
    if missing := [name for name in needed if name not in values]:
        raise FormatError(f"{source}: missing key {missing[0]!r}; a recipe needs {', '.join(needed)}")
    settings: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    recipe = Recipe(**settings)
    for name in _POSITIVE:
        if not 0 < getattr(recipe, name) < math.inf:
            raise FormatError(f"{source}: {name} = {getattr(recipe, name)}, expected more than 0")
    if not all(0 < crop <= side for crop, side in zip(recipe.crop_size, recipe.pair_size, strict=True)):
        raise FormatError(
            f"{source}: crop_size = {list(recipe.crop_size)}, expected more than 0 and "
            f"at most pair_size = {list(recipe.pair_size)}"
        )
    return recipe


def _fits(value: object, expected: Any) -> bool:
    if expected is float:
        return isinstance(value, float | int) and not isinstance(value, bool)
    if expected in (int, str):
        return type(value) is expected
    return isinstance(value, list | tuple) and len(value) == 2 and all(type(v) is int for v in value)
