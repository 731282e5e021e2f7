"""The state of a run of `train`: its starting point, its steps and its checkpoints."""

import logging
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from lightning_fabric import Fabric
from torch import nn

from stereoweave.errors import StereoweaveError
from stereoweave.learn import checkpoint
from stereoweave.learn.checkpoint import Checkpoint
from stereoweave.learn.data.batches import Batches, split_batch
from stereoweave.learn.data.sources import open_held_out_sets
from stereoweave.learn.recipe import Recipe
from stereoweave.learn.training.accumulation import StepSums
from stereoweave.learn.training.model_state import STEPS_BETWEEN_SKIPS, ModelState
from stereoweave.learn.training.objective import name_in_errors
from stereoweave.learn.training.step_graph import StepGraph

# Longest time between two checkpoints, which is the most that a killed run loses.
_SAVE_EVERY_S = 600
# Recipe keys that may change when a run resumes.
_RESUMABLE = ("steps", "cool_down_steps", "mix", "pair_size", "crop_size", "validate_every", "held_out")

_LOGGER = logging.getLogger(__name__)


class TrainingRun(ModelState):
    """The state of a run of `train`, with its device and ranks."""

    def __init__(self, recipe: Recipe, start: Checkpoint, fabric: Fabric) -> None:
        self.recipe, self.fabric, self.by_class = recipe, fabric, open_held_out_sets(recipe)
        update_average = partial(_update_average, recipe.averaged_steps)
        super().__init__(start, fabric.device, update_average, start.optimiser)
        self.averaged.n_averaged.fill_(start.step - len(start.skipped))
        if self.fabric.world_size > 1 and self.fabric.device.type == "cuda":
            nn.SyncBatchNorm.convert_sync_batchnorm(self.network)  # type: ignore[no-untyped-call]
        torch.set_rng_state(start.random_state)
        # With several ranks, graphs have never been tried.
        recorded = self.objective.recordable and fabric.device.type == "cuda" and fabric.world_size == 1
        self.compute = StepGraph(self._compute) if recorded else self._compute
        self.began_s = self.saved_s = time.monotonic()
        self.scores = start.scores
        self.skipped = list(start.skipped)

    def step(self, step: int, batch: dict[str, torch.Tensor], batches: Batches) -> float:
        """Take one optimiser step. Returns the loss.

        A step whose loss or gradient is not finite changes no weights; it is counted and logged.

        Raises:
            StereoweaveError: If two such steps are less than 500 steps apart.
        """
        for group in self.optimiser.param_groups:
            group["lr"] = self.recipe.learning_rate_at(step)
        with name_in_errors(f"step {step}: one of {', '.join(batches.names(step))}"):
            self.objective.check(batch)
        self.prepare_to_train()
        sums = StepSums(self.network)
        terms = self._gradient(step, self.fabric.to_device(batch), batches, sums)
        value = terms.pop("loss")
        norm = self.clip_gradient()
        if not (np.isfinite(value) and norm.isfinite()):
            sums.undo()
            found = f"the loss is {value}"
            if np.isfinite(value):
                found = f"the norm of the gradient is {norm}"
            self._skip(step, found, batches)
            return value
        self.optimiser.step()
        self.averaged.update_parameters(self.network)
        if step % 20 == 0:
            self.fabric.log_dict({"loss": value, **{f"loss/{k}": term for k, term in terms.items()}}, step)
        return value

    def _gradient(
        self, step: int, batch: dict[str, torch.Tensor], batches: Batches, sums: StepSums
    ) -> dict[str, float]:
        """Compute the gradient of a step over all ranks. Returns the loss and its terms."""
        for part, values in zip(batches.parts, split_batch(batch, len(batches.parts)), strict=True):
            # Seeded per micro-batch, so that dropout depends neither on the number of ranks nor on resuming.
            torch.manual_seed(int(np.random.SeedSequence(batches.key(step, part)).generate_state(1)[0]))
            losses = self.compute(values)
            sums.add([*losses.values()])
        means = sums.finish(self.fabric, self.recipe.micro_batches)
        return dict(zip(losses, means, strict=True))

    def _compute(self, batch: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Compute the gradient of a micro-batch. Returns its loss and the loss's terms."""
        with self.fabric.autocast():
            predicted = self.objective.predict(self.network, batch)
        terms = self.objective.losses(predicted, batch)
        loss = torch.stack(list(terms.values())).sum()
        self.optimiser.zero_grad()
        self.fabric.backward(loss)
        return {"loss": loss.detach(), **{name: term.detach() for name, term in terms.items()}}

    def _skip(self, step: int, found: str, batches: Batches) -> None:
        found = f"step {step}: {found}; the pairs are {', '.join(batches.names(step))}"
        if self.skipped and step - self.skipped[-1] < STEPS_BETWEEN_SKIPS:
            raise StereoweaveError(f"{found}; step {self.skipped[-1]} was skipped for the same reason")
        self.skipped.append(step)
        self.fabric.log_dict({"skipped_steps": float(len(self.skipped))}, step)
        _LOGGER.warning("%s; skipped", found)

    def save_periodically(self, step: int, path: Path) -> None:
        """Save a checkpoint after `step` steps if the last checkpoint is over ten minutes old."""
        if self.fabric.is_global_zero and time.monotonic() - self.saved_s > _SAVE_EVERY_S:
            self._write(step, self.scores, path)

    def save(self, step: int, scores: dict[str, float], path: Path) -> None:
        """Save a checkpoint after `step` steps, and log the scores."""
        self.fabric.log_dict({f"validation/{name}": score for name, score in scores.items()}, step)
        self._write(step, scores, path)

    def _write(self, step: int, scores: dict[str, float], path: Path) -> None:
        self.saved_s, self.scores = time.monotonic(), scores
        state = replace(
            self.start,
            step=step,
            weights=self.network.state_dict(),
            averaged=self.averaged.module.state_dict(),
            optimiser=self.optimiser.state_dict(),
            random_state=torch.get_rng_state(),
            scores=scores,
            hours=self.start.hours + (time.monotonic() - self.began_s) / 3600,
            skipped=tuple(self.skipped),
        )
        checkpoint.save(state, path)


def load_start(recipe: Recipe, last: Path) -> Checkpoint:
    """Return the state to start from: the run's last checkpoint, else `start_from` or random weights."""
    if last.exists():
        found = checkpoint.load(last)
        if replace(found.recipe, **{name: getattr(recipe, name) for name in _RESUMABLE}) != recipe:
            raise StereoweaveError(
                f"{last}: expected a run of this recipe, found a run of recipe {found.recipe.name} with "
                "other settings; train into a new folder, or remove the file"
            )
        return replace(found, recipe=recipe, commit=checkpoint.find_commit())
    return checkpoint.make_initial(recipe, checkpoint.find_commit())


@torch.no_grad()
def _update_average(
    averaged_steps: int,
    averaged: Sequence[torch.Tensor],
    current: Sequence[torch.Tensor],
    steps: torch.Tensor | int,
) -> None:
    """Move the average towards the current weights, faster at first to shed the initial weights quickly."""
    share = max(1 / averaged_steps, 9 / (9 + float(steps)))
    for average, value in zip(averaged, current, strict=True):
        if average.is_floating_point():
            average.lerp_(value.to(average), share)
        else:
            average.copy_(value)
