"""Checkpoints: everything that a killed run needs to go on as if nothing had happened."""

import os
import subprocess
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch

from stereoweave.errors import FormatError, reason
from stereoweave.learn.models import build_network
from stereoweave.learn.recipe import Recipe, recipe_from

Weights = dict[str, torch.Tensor]


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """The state of a run after `step` steps.

    Attributes:
        weights: of the network as it is trained.
        averaged: their running average, which is what scores and ships.
        optimiser: the optimiser's state; empty in a checkpoint that only starts other runs.
        random_state: PyTorch's; every other draw depends on (seed, step) alone.
        scores: of the last validation.
        commit: of the code that trained.
        hours: of training so far, over all restarts and the run it started from.
        origin: recipe, step and commit of the checkpoints it came from, the first one first.
    """

    recipe: Recipe
    step: int
    weights: Weights
    averaged: Weights
    optimiser: dict[str, Any]
    random_state: torch.Tensor
    scores: dict[str, float]
    commit: str
    hours: float
    origin: tuple[dict[str, Any], ...] = ()

    def as_origin(self) -> tuple[dict[str, Any], ...]:
        """The origin of a run that starts from this one."""
        return *self.origin, {"recipe": asdict(self.recipe), "step": self.step, "commit": self.commit}


def make_initial(recipe: Recipe, commit: str) -> Checkpoint:
    """The start of a run: the averaged weights of `start_from` where the network has such, else random ones.

    Raises:
        FormatError: `start_from` is no checkpoint, or shares no weights with the network.
    """
    torch.manual_seed(recipe.seed)
    weights: Weights = build_network(recipe).state_dict()
    hours = 0.0
    origin: tuple[dict[str, Any], ...] = ()
    if recipe.start_from:
        earlier = load(Path(recipe.start_from))
        weights, hours, origin = _take_weights(weights, earlier, recipe), earlier.hours, earlier.as_origin()
    return Checkpoint(
        recipe=recipe,
        step=0,
        weights=weights,
        averaged=weights,
        optimiser={},
        random_state=torch.get_rng_state(),
        scores={},
        commit=commit,
        hours=hours,
        origin=origin,
    )


def _take_weights(fresh: Weights, earlier: Checkpoint, recipe: Recipe) -> Weights:
    """An earlier network's averaged weights where this one has such of the same shape, else fresh ones."""
    taken = {
        name: value.to(fresh[name].dtype)  # kept in half precision, perhaps
        for name, value in earlier.averaged.items()
        if name in fresh and value.shape == fresh[name].shape
    }
    if not taken:
        raise FormatError(
            f"{recipe.name}: start_from = {recipe.start_from!r}, expected a checkpoint that shares weights "
            f"with {recipe.model}, found one of {earlier.recipe.model}"
        )
    return fresh | taken


def strip_to_average(kept: Checkpoint) -> Checkpoint:
    """The checkpoint with nothing but its averaged weights, in half precision: to start other runs from."""
    weights = {
        name: value.half() if value.is_floating_point() else value for name, value in kept.averaged.items()
    }
    return replace(kept, weights=weights, averaged=weights, optimiser={})


def average(first: Checkpoint, second: Checkpoint, start: Checkpoint) -> Checkpoint:
    """What lies half-way between two runs that went on from `start`, to start a further run from.

    The mean of two networks that were trained on from one is often better than either (Wortsman et al.,
    "Model soups", ICML 2022); running variances are means too.

    Raises:
        FormatError: One of the two did not go on from `start`.
    """
    for run in (first, second):
        if _list_origins(run.origin) != _list_origins(start.as_origin()):
            raise FormatError(
                f"{run.recipe.name}: expected a run that started from {start.recipe.name} after {start.step} "
                "steps, found one that did not"
            )
    weights = {name: _midpoint(value, second.averaged[name]) for name, value in first.averaged.items()}
    return replace(
        first,
        weights=weights,
        averaged=weights,
        optimiser={},
        scores={},
        hours=first.hours + second.hours - start.hours,
        origin=first.as_origin() + second.as_origin()[len(start.as_origin()) :],
    )


def _list_origins(origin: tuple[dict[str, Any], ...]) -> list[tuple[str, int]]:
    # Not the recipes, which have had more keys since.
    return [(past["commit"], past["step"]) for past in origin]


def _midpoint(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    # A batch norm counts its batches in whole numbers.
    return (first + second) / 2 if first.is_floating_point() else first


def save(checkpoint: Checkpoint, path: Path) -> None:
    """Write a checkpoint whole or not at all."""
    temporary = path.with_name(path.name + ".part")
    values = {**vars(checkpoint), "recipe": asdict(checkpoint.recipe)}
    with temporary.open("wb") as stream:
        torch.save(values, stream)
        stream.flush()
        os.fsync(stream.fileno())
    temporary.replace(path)


def load(path: Path) -> Checkpoint:
    """The checkpoint of a file, on the CPU; FormatError if it is none."""
    try:
        values = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise FormatError(
            f"{path}: no such checkpoint; `stereoweave train` writes last.pt into its run"
        ) from error
    except Exception as error:  # other bytes lead PyTorch's reader to any error whatever
        raise FormatError(
            f"{path}: expected a checkpoint of `stereoweave train`, found {reason(error)}"
        ) from error
    # Checkpoints written before there was an origin have none.
    if not isinstance(values, dict) or {*values, "origin"} != {field.name for field in fields(Checkpoint)}:
        raise FormatError(
            f"{path}: expected a checkpoint of `stereoweave train`, found something else that PyTorch saved"
        )
    return Checkpoint(**{**values, "recipe": recipe_from(values["recipe"], str(path))})


def find_commit() -> str:
    """The commit of the code that runs, '+' behind it where files were changed; 'unknown' outside git."""
    try:
        # Of the package's own repository alone: an installed package may lie in somebody else's.
        described = subprocess.run(
            ["git", "--git-dir=.git", "describe", "--always", "--dirty=+", "--exclude=*"],
            cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True,
        )  # fmt: skip
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return described.stdout.strip()
