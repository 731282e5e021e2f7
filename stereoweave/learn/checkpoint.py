"""Checkpoints: the complete state of a run, enough to resume it exactly after an interruption."""

import os
import subprocess
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch

from stereoweave.errors import FormatError, reason
from stereoweave.learn.models import build_network
from stereoweave.learn.recipe import Recipe, parse_recipe

Weights = dict[str, torch.Tensor]


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """The state of a run after `step` steps.

    Attributes:
        weights: The network's current weights.
        averaged: Running average of the weights, which is scored and exported.
        optimiser: The optimiser's state; empty in a checkpoint that only serves to start other runs.
        random_state: PyTorch's random state. All other random numbers depend only on (seed, step).
        scores: Scores of the last validation.
        commit: Commit of the code that trained the network.
        hours: Hours of training so far, over all restarts and including the runs that this run descends from.
        origin: Recipe, step and commit of each checkpoint that the run descends from, oldest first.
        skipped: Steps of the run that were skipped, because the loss or the gradient was not finite.
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
    skipped: tuple[int, ...] = ()

    def as_origin(self) -> tuple[dict[str, Any], ...]:
        """Return the origin of a run that starts from this checkpoint."""
        return *self.origin, {"recipe": asdict(self.recipe), "step": self.step, "commit": self.commit}

    def build_averaged(self) -> Any:
        """Return the network with the averaged weights, in inference mode."""
        network = build_network(self.recipe)
        network.load_state_dict(self.averaged)
        return network.eval()


def make_initial(recipe: Recipe, commit: str) -> Checkpoint:
    """Make the first checkpoint of a new run.

    Weights whose name and shape match take the averaged values of `start_from`; all others are random.

    Raises:
        FormatError: If `start_from` is not a checkpoint, or shares no weights with the network.
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
    """Return the earlier run's averaged weights where name and shape match, else the fresh weights."""
    taken = {
        name: value.to(fresh[name].dtype)  # a stripped checkpoint is in half precision
        for name, value in earlier.averaged.items()
        if name in fresh and value.shape == fresh[name].shape
    }
    if not taken:
        raise FormatError(
            f"{recipe.name}: start_from: expected a checkpoint that shares weights with {recipe.model}, "
            f"found {recipe.start_from!r}, a checkpoint of {earlier.recipe.model}"
        )
    return fresh | taken


def strip_to_average(kept: Checkpoint) -> Checkpoint:
    """Reduce a checkpoint to its averaged weights in half precision, from which other runs can start."""
    weights = {
        name: value.half() if value.is_floating_point() else value for name, value in kept.averaged.items()
    }
    return replace(kept, weights=weights, averaged=weights, optimiser={})


def average(runs: Sequence[Checkpoint]) -> Checkpoint:
    """Average the weights of runs that descend from the same run.

    The mean of networks fine-tuned from the same weights is often better than each of them (Wortsman et al.,
    "Model soups", ICML 2022). Running variances are averaged too. The result has the recipe of the first run,
    the hours of the longest, and the origins of all.

    Raises:
        FormatError: If a run is of another network than the first, or has no ancestor in common with it.
    """
    first = runs[0]
    for run in runs:
        if _list_shapes(run.averaged) != _list_shapes(first.averaged):
            raise FormatError(
                f"{run.recipe.name}: expected a {first.recipe.model} as in {first.recipe.name}, "
                f"found a {run.recipe.model} or other sizes"
            )
        if not {*_list_ids(first.as_origin())} & {*_list_ids(run.as_origin())}:
            raise FormatError(
                f"{run.recipe.name}: expected a run that descends from the same run as {first.recipe.name}, "
                "found a run with a different origin"
            )
    ancestors = [past for run in runs for past in run.as_origin()]
    weights = {name: _mean([run.averaged[name] for run in runs]) for name in first.averaged}
    return replace(
        first,
        weights=weights,
        averaged=weights,
        optimiser={},
        scores={},
        hours=max(run.hours for run in runs),
        origin=tuple(dict(zip(_list_ids(ancestors), ancestors, strict=True)).values()),
    )


def _list_shapes(weights: Weights) -> dict[str, torch.Size]:
    return {name: value.shape for name, value in weights.items()}


def _list_ids(origin: Sequence[dict[str, Any]]) -> list[tuple[str, int, str, int]]:
    # Whole recipes are not compared, because old ones lack keys that were added later.
    return [(past["commit"], past["step"], past["recipe"]["name"], past["recipe"]["seed"]) for past in origin]


def _mean(values: Sequence[torch.Tensor]) -> torch.Tensor:
    # The batch counters of batch norms are integers and cannot be averaged.
    first = values[0]
    return torch.stack(list(values)).double().mean(0).to(first.dtype) if first.is_floating_point() else first


def save(checkpoint: Checkpoint, path: Path) -> None:
    """Write a checkpoint atomically."""
    temporary = path.with_name(path.name + ".part")
    values = {**vars(checkpoint), "recipe": asdict(checkpoint.recipe)}
    with temporary.open("wb") as stream:
        torch.save(values, stream)
        stream.flush()
        os.fsync(stream.fileno())
    temporary.replace(path)


_NOT_ONE = "another kind of file, or a damaged one"


def load(path: Path) -> Checkpoint:
    """Load a checkpoint onto the CPU. Raises FormatError if the file is missing or not a checkpoint."""
    try:
        values = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise FormatError(
            f"{path}: no such checkpoint; `stereoweave train` writes last.pt into the run's folder"
        ) from error
    except Exception as error:  # PyTorch's reader raises any type of error on invalid bytes
        # Its texts advise programmers.
        found = reason(error) if isinstance(error, OSError | EOFError) else _NOT_ONE
        raise FormatError(f"{path}: expected a checkpoint of `stereoweave train`, found {found}") from error
    # Older checkpoints lack these.
    every = {field.name for field in fields(Checkpoint)}
    if not isinstance(values, dict) or {*values, "origin", "skipped"} != every:
        raise FormatError(
            f"{path}: expected a checkpoint of `stereoweave train`, found another kind of PyTorch file"
        )
    return Checkpoint(**{**values, "recipe": parse_recipe(values["recipe"], str(path))})


def find_commit() -> str:
    """Return the code's commit, with a '+' for uncommitted changes; 'unknown' outside a repository."""
    try:
        # Only in this package's own repository: an installed package may lie inside an unrelated one.
        described = subprocess.run(
            ["git", "--git-dir=.git", "describe", "--always", "--dirty=+", "--exclude=*"],
            cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True,
        )  # fmt: skip
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return described.stdout.strip()
