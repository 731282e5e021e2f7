"""Training: one loop from a recipe to a network; killed at any moment, it goes on where it was."""

import ctypes
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from lightning_fabric import Fabric
from lightning_fabric.loggers.tensorboard import TensorBoardLogger
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch.optim.swa_utils import AveragedModel
from torch.utils.data import DataLoader, Dataset

from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io import make_folder
from stereoweave.learn import checkpoint
from stereoweave.learn.augment import augment
from stereoweave.learn.checkpoint import Checkpoint
from stereoweave.learn.losses import weave_losses
from stereoweave.learn.models import MODELS
from stereoweave.learn.pairs import KeptPairs
from stereoweave.learn.recipe import Recipe, read_recipe
from stereoweave.learn.validate import validate
from stereoweave.stereo import Sample

# Averaged over about this many steps; longer lags behind, shorter keeps the noise of single batches.
_AVERAGED_STEPS = 500
# Validation pairs come from this seed; a recipe's own is small.
_VALIDATION_SEED = 1_000_003


class Batches(Dataset[dict[str, torch.Tensor]]):
    """The batch of every step, each drawn from (seed, step) alone, whoever asks and in whatever order."""

    def __init__(self, recipe: Recipe, pairs: KeptPairs) -> None:
        self.recipe, self.pairs = recipe, pairs

    def __getitem__(self, step: int) -> dict[str, torch.Tensor]:
        rng = np.random.default_rng((self.recipe.seed, step))
        chosen = self.chosen(step)
        return collated([augment(self.pairs[i], *self.recipe.crop_size, rng) for i in chosen])

    def chosen(self, step: int) -> list[int]:
        """Indices of the pairs of a step: every pair once before any comes again."""
        count = self.pairs.count
        places = range(step * self.recipe.batch, (step + 1) * self.recipe.batch)
        return [int(self._order(place // count)[place % count]) for place in places]

    def _order(self, epoch: int) -> np.ndarray:
        return np.random.default_rng((self.recipe.seed, epoch, 1)).permutation(self.pairs.count)


def collated(samples: list[Sample]) -> dict[str, torch.Tensor]:
    """Images [B, 3, H, W] in 0..1; maps [2B, 1, H, W], of the left views, then of the right ones mirrored."""

    def images(side: str) -> torch.Tensor:
        stacked = np.stack([getattr(sample, side) for sample in samples])
        return torch.from_numpy(stacked).permute(0, 3, 1, 2).float() / 255

    def maps(name: str) -> torch.Tensor:
        lefts = [getattr(sample, name) for sample in samples]
        rights = [getattr(sample, f"right_{name}")[:, ::-1] for sample in samples]
        return torch.from_numpy(np.stack(lefts + rights))[:, None]

    return {
        "left": images("left"),
        "right": images("right"),
        "disparity_px": maps("disparity_px"),
        "occluded": maps("occluded"),
    }


def train(recipe_path: Path, out: Path, console: Console | None = None) -> Path:
    """Train the network of a recipe in folder `out`, or go on there; returns the last checkpoint's path.

    Raises:
        StereoweaveError: for a recipe that is none, where `out` holds the run of another one, or where the
            loss is no longer finite.
    """
    recipe = read_recipe(recipe_path)
    if recipe.model not in MODELS:
        raise FormatError(f"{recipe_path}: model = {recipe.model!r}, expected {' or '.join(MODELS)}")
    multiple = MODELS[recipe.model].multiple_of
    if any(side % multiple for side in recipe.pair_size + recipe.crop_size):
        raise FormatError(
            f"{recipe_path}: pair_size = {list(recipe.pair_size)}, crop_size = {list(recipe.crop_size)}, "
            f"expected multiples of {multiple} for {recipe.model}"
        )
    last = make_folder(out) / "last.pt"
    start = _starting_point(recipe, last)
    console = console or Console()
    pairs = _kept(KeptPairs(out.parent / "pairs", recipe.seed, recipe.pairs, recipe.pair_size), console)
    held_out = _kept(
        KeptPairs(out.parent / "pairs", _VALIDATION_SEED, recipe.validation_pairs, recipe.pair_size), console
    )
    logger = TensorBoardLogger(out, name="", version="")
    run = Run(recipe, start, logger)
    batches = Batches(recipe, pairs)
    with closing_curves(logger), _progress(console) as progress:
        task = progress.add_task(recipe.name, total=recipe.steps, completed=start.step, loss="", rate="")
        began = time.perf_counter()
        for step, batch in _numbered_batches(batches, start.step):
            loss = run.step(step, batch, batches)
            if (step + 1) % recipe.validate_every == 0 or step + 1 == recipe.steps:
                scores = validate(run.averaged.module, held_out, run.fabric.device)
                run.keep(step + 1, scores, last)
                console.print(f"step {step + 1}: " + "  ".join(f"{k} {v:.3f}" for k, v in scores.items()))
            rate, began = recipe.batch / (time.perf_counter() - began), time.perf_counter()
            progress.update(task, completed=step + 1, loss=f"loss {loss:.3f}", rate=f"{rate:.1f} pairs/s")
    return last


@contextmanager
def closing_curves(logger: TensorBoardLogger) -> Iterator[TensorBoardLogger]:
    """The logger, whose last values are in its file when the block is left, after an error too."""
    try:
        yield logger
    finally:
        logger.finalize("left")


class Run:
    """The moving parts of a training: network, average, optimiser, and the machine they are on."""

    def __init__(self, recipe: Recipe, start: Checkpoint, logger: TensorBoardLogger) -> None:
        self.recipe, self.start = recipe, start
        _keep_freed_memory()
        self.fabric = Fabric(accelerator="auto", devices=1, precision=_precision(), loggers=logger)
        network = MODELS[recipe.model]()
        network.load_state_dict(start.weights)
        # What bfloat16 convolutions on the CPU are fast in: three times the other layout.
        network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        optimiser = torch.optim.AdamW(
            network.parameters(), recipe.learning_rate, weight_decay=recipe.weight_decay, fused=True
        )
        self.averaged = AveragedModel(network, multi_avg_fn=_move_average, use_buffers=True)
        self.averaged.module.load_state_dict(start.averaged)
        self.averaged.n_averaged.fill_(start.step)
        self.network, self.optimiser = self.fabric.setup(network, optimiser)
        if start.optimiser:
            # Only now, because its state goes to where the weights are.
            self.optimiser.load_state_dict(start.optimiser)
        self.averaged.to(self.fabric.device)
        torch.set_rng_state(start.random_state)
        self.began = time.monotonic()

    def step(self, step: int, batch: dict[str, torch.Tensor], batches: Batches) -> float:
        """One step down the loss; returns the loss."""
        batch = self.fabric.to_device(batch)
        for group in self.optimiser.param_groups:
            group["lr"] = self.recipe.learning_rate_at(step)
        self.network.train()
        with self.fabric.autocast():
            stages = self.network.module.stages(batch["left"], batch["right"])
        losses = weave_losses(stages, batch["disparity_px"], batch["occluded"])
        loss = torch.stack(list(losses.values())).sum()
        value = float(loss.detach())
        if not np.isfinite(value):
            raise StereoweaveError(
                f"step {step}: the loss is {value}; its pairs are {batches.chosen(step)} "
                f"of seed {self.recipe.seed}"
            )
        self.optimiser.zero_grad()
        self.fabric.backward(loss)
        self.fabric.clip_gradients(self.network, self.optimiser, max_norm=5.0)
        self.optimiser.step()
        self.averaged.update_parameters(self.network.module)
        if step % 20 == 0:
            terms = {f"loss/{name}": float(term.detach()) for name, term in losses.items()}
            self.fabric.log_dict({"loss": value, **terms}, step)
        return value

    def keep(self, step: int, scores: dict[str, float], path: Path) -> None:
        """Write the run as it is after `step` steps, and its scores to the curves."""
        self.fabric.log_dict({f"validation/{name}": score for name, score in scores.items()}, step)
        state = replace(
            self.start,
            step=step,
            weights=self.network.module.state_dict(),
            averaged=self.averaged.module.state_dict(),
            optimiser=self.optimiser.state_dict(),
            random_state=torch.get_rng_state(),
            scores=scores,
            hours=self.start.hours + (time.monotonic() - self.began) / 3600,
        )
        checkpoint.save(state, path)


def _starting_point(recipe: Recipe, last: Path) -> Checkpoint:
    """Where the run stands: its own last checkpoint, the averaged weights of another, or random weights."""
    if last.exists():
        found = checkpoint.load(last)
        if found.recipe != recipe:
            raise StereoweaveError(
                f"{last}: is of another recipe ({found.recipe.name}); "
                "train into a folder of its own, or remove it"
            )
        return replace(found, commit=checkpoint.code_commit())
    torch.manual_seed(recipe.seed)
    weights, hours = MODELS[recipe.model]().state_dict(), 0.0
    origin: tuple[dict[str, Any], ...] = ()
    if recipe.start_from:
        earlier = checkpoint.load(Path(recipe.start_from))
        weights, hours, origin = earlier.averaged, earlier.hours, earlier.as_origin()
    return Checkpoint(
        recipe=recipe,
        step=0,
        weights=weights,
        averaged=weights,
        optimiser={},
        random_state=torch.get_rng_state(),
        scores={},
        commit=checkpoint.code_commit(),
        hours=hours,
        origin=origin,
    )


def _kept(pairs: KeptPairs, console: Console) -> KeptPairs:
    """The pairs, made before if they were not there."""
    if missing := len(pairs.missing()):
        with _progress(console) as progress:
            task = progress.add_task("making pairs", total=missing, loss="", rate="")
            for _ in pairs.make():
                progress.advance(task)
    return pairs


def _numbered_batches(batches: Batches, first: int) -> Iterator[tuple[int, dict[str, torch.Tensor]]]:
    """(step, its batch) from step `first` to the last, cut and recoloured in a process beside."""
    steps = range(first, batches.recipe.steps)
    loader = DataLoader(
        batches,
        sampler=steps,
        batch_size=None,
        num_workers=1,
        prefetch_factor=4,
        multiprocessing_context="spawn",
        # Its own, because a loader draws a number when it starts, and a restart would draw once more.
        generator=torch.Generator(),
    )
    return zip(steps, loader, strict=True)


def _keep_freed_memory() -> None:
    """Have glibc keep large blocks that are freed: getting them anew from the kernel slows every step."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        m_trim_threshold, m_top_pad, m_mmap_max = -1, -2, -4
        mallopt(m_mmap_max, 0)
        mallopt(m_trim_threshold, 2**31 - 1)
        mallopt(m_top_pad, 2**28)


@torch.no_grad()
def _move_average(
    averaged: Sequence[torch.Tensor], current: Sequence[torch.Tensor], steps: torch.Tensor | int
) -> None:
    """Move the average towards the current weights: fast at first, so that random ones are soon forgotten."""
    share = max(1 / _AVERAGED_STEPS, 9 / (9 + float(steps)))
    for average, value in zip(averaged, current, strict=True):
        if average.is_floating_point():
            average.lerp_(value.to(average), share)
        else:
            average.copy_(value)


def _precision() -> Literal["bf16-mixed", "32-true"]:
    """bfloat16 where the device computes in it, float32 elsewhere."""
    if torch.accelerator.is_available():
        computes = torch.cuda.is_bf16_supported()
    else:
        one_dnn = torch.backends.mkldnn.is_available()  # type: ignore[no-untyped-call]
        computes = one_dnn and torch.cpu.get_capabilities().get("avx512_bf16", False)
    return "bf16-mixed" if computes else "32-true"


def _progress(console: Console) -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, TextColumn("{task.fields[loss]} {task.fields[rate]}"), console=console)
