"""Training: one loop from a recipe to a network; killed at any moment, it goes on where it was."""

import atexit
import csv
import ctypes
import logging
import os
import platform
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from lightning_fabric import Fabric
from lightning_fabric.loggers.tensorboard import TensorBoardLogger
from lightning_fabric.strategies.ddp import DDPStrategy
from lightning_fabric.utilities.distributed import _destroy_dist_connection
from rich.console import Console
from torch import nn
from torch.distributed.distributed_c10d import PrefixStore
from torch.distributed.rendezvous import rendezvous
from torch.utils.data import DataLoader

from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.files import make_folder, replacing
from stereoweave.io.output_lock import lock_output
from stereoweave.learn import checkpoint
from stereoweave.learn.checkpoint import Checkpoint
from stereoweave.learn.data.batches import Batches, CaughtBatches, split_batch
from stereoweave.learn.data.sources import PairSource, cache_pairs, open_held_out_sets, open_sources
from stereoweave.learn.distributed import ProcessRank, choose_thread_count, read_rank, report_once
from stereoweave.learn.models import build_network
from stereoweave.learn.recipe import COLLAGE, Recipe, read_recipe
from stereoweave.learn.training.accumulation import StepSums
from stereoweave.learn.training.model_state import STEPS_BETWEEN_SKIPS, ModelState
from stereoweave.learn.training.objective import build_objective, fit_recipe, name_in_errors
from stereoweave.learn.training.scores import validate_by_class
from stereoweave.system.progress import progress

# Beside a run's checkpoint: its scores after each validation.
SCORES_FILE = "validation.csv"
# A killed run loses no more than this, beside what it lost since its last validation.
_SAVE_EVERY_S = 600
# What a run may go on with where its recipe says otherwise than its last checkpoint's.
_RESUMABLE = ("steps", "cool_down_steps", "mix", "pair_size", "crop_size", "validate_every", "held_out")
# The others wait for the first one however long it makes pairs or scores: should it die, torchrun ends them.
_TIMEOUT = timedelta(days=1)

_LOGGER = logging.getLogger(__name__)


def train(recipe_path: Path, out: Path, console: Console | None = None) -> Path:
    """Train the network of a recipe in folder `out`, or go on there; returns the last checkpoint's path.

    Started by torchrun, its processes share each step's micro-batches, and the first of them alone writes.

    Raises:
        StereoweaveError: for a recipe that is none, where `out` is in use or holds the run of another one, or
            where the loss is no longer finite.
    """
    with report_once(), _skip_teardown_on_error():
        return train_recipe(read_recipe(recipe_path), out, console or Console(quiet=read_rank().rank > 0))


def train_recipe(recipe: Recipe, out: Path, console: Console) -> Path:
    """As `train`, of a recipe at hand."""
    _check_recipe(recipe)
    if read_rank().rank:  # the first process writes, and locks, for all
        return _train(recipe, out, console)
    with lock_output(make_folder(out)):
        return _train(recipe, out, console)


def _train(recipe: Recipe, out: Path, console: Console) -> Path:
    _keep_freed_memory()
    last = out / "last.pt"
    logger = TensorBoardLogger(out, name="", version="")
    fabric = _make_fabric(logger)
    pairs, held_out = _prepare_pairs(recipe, out, console, fabric)
    recipe = fit_recipe(recipe, pairs)
    start = _load_start(recipe, last)
    if start.step != fabric.broadcast(start.step):
        raise _folder_not_shared(out)
    if start.step == recipe.steps:
        return last
    run = TrainingRun(recipe, start, fabric)
    batches = Batches(recipe, pairs, read_rank())
    with close_curves(logger), progress(console) as bar:
        task = bar.add_task(recipe.name, total=recipe.steps, completed=run.start.step, loss="", rate="")
        began = time.perf_counter()
        for step, batch in _load_batches(batches, run.start.step):
            loss = run.step(step, batch, batches)
            run.save_periodically(step + 1, last)
            if (step + 1) % recipe.validate_every == 0 or step + 1 == recipe.steps:
                if run.fabric.is_global_zero:
                    _validate(run, step + 1, held_out, last, console)
                run.fabric.barrier()
            rate, began = recipe.batch / (time.perf_counter() - began), time.perf_counter()
            bar.update(task, completed=step + 1, loss=f"loss {loss:.4g}", rate=f"{rate:.1f} pairs/s")
    return last


def _prepare_pairs(
    recipe: Recipe, out: Path, console: Console, fabric: Fabric
) -> tuple[PairSource, PairSource]:
    """The pairs to train on and to score on, made by the first process where they were not there."""
    found = open_sources(recipe, out.parent / "pairs")
    if fabric.is_global_zero:
        for pairs in found:
            cache_pairs(pairs, console)
    fabric.barrier()
    if not out.is_dir():
        raise _folder_not_shared(out)
    return found


def _folder_not_shared(out: Path) -> StereoweaveError:
    return StereoweaveError(
        f"{out}: expected what the first process sees there, found something else on {platform.node()}; "
        "train into a folder that all machines share"
    )


def _validate(run: "TrainingRun", steps: int, held_out: PairSource, last: Path, console: Console) -> None:
    """Score the run as it is after so many steps, and keep it and its scores."""
    network, device = run.averaged.module, run.fabric.device
    scores = run.objective.scores(network, held_out, device)
    for name, pairs in run.by_class.items():
        found = validate_by_class(network, pairs, device)
        scores |= {f"{name}_{key}": value for key, value in found.items()}
    # First, because what is killed between the two then writes the same row again.
    append_scores(last.with_name(SCORES_FILE), steps, scores)
    run.save(steps, scores, last)
    console.print(f"step {steps}: " + "  ".join(f"{k} {v:.4g}" for k, v in scores.items()))


def append_scores(path: Path, step: int, scores: dict[str, float]) -> None:
    """Add the scores after `step` steps to a CSV file; rows of that step and later ones are replaced."""
    rows = [row for row in read_scores(path) if row["step"] < step] + [{"step": step, **scores}]
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[-1]))
        writer.writeheader()
        writer.writerows(rows)


def read_scores(path: Path) -> list[dict[str, float]]:
    """The scores of a run by step, the first ones first; none where there is no file yet."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


@contextmanager
def close_curves(logger: TensorBoardLogger) -> Iterator[TensorBoardLogger]:
    """The logger, whose last values are in its file when the block is left, after an error too."""
    try:
        yield logger
    finally:
        logger.finalize("left")


class TrainingRun(ModelState):
    """The state of a run of `train`, and the processes and devices that train it."""

    def __init__(self, recipe: Recipe, start: Checkpoint, fabric: Fabric) -> None:
        self.recipe, self.fabric, self.by_class = recipe, fabric, open_held_out_sets(recipe)
        update_average = partial(_update_average, recipe.averaged_steps)
        super().__init__(start, fabric.device, update_average, start.optimiser)
        self.averaged.n_averaged.fill_(start.step)
        if self.fabric.world_size > 1 and self.fabric.device.type == "cuda":
            nn.SyncBatchNorm.convert_sync_batchnorm(self.network)  # type: ignore[no-untyped-call]
        torch.set_rng_state(start.random_state)
        self.began_s = self.saved_s = time.monotonic()
        self.scores = start.scores
        self.skipped: list[int] = []

    def step(self, step: int, batch: dict[str, torch.Tensor], batches: Batches) -> float:
        """Take one step down the loss and return the loss.

        A step whose loss or gradient is not finite changes nothing, and is counted and logged.

        Raises:
            StereoweaveError: Two such steps are closer than 500 steps.
        """
        for group in self.optimiser.param_groups:
            group["lr"] = self.recipe.learning_rate_at(step)
        self.network.train()
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
        """Give the weights the gradient of a step, of whichever process; returns the loss and its terms."""
        what = f"step {step}: one of {', '.join(batches.names(step))}"
        for part, values in zip(batches.parts, split_batch(batch, len(batches.parts)), strict=True):
            if self.recipe.micro_batches > 1:
                # Whichever process it is, dropout is the micro-batch's own.
                torch.manual_seed(int(np.random.SeedSequence(batches.key(step, part)).generate_state(1)[0]))
            with self.fabric.autocast():
                predicted = self.objective.predict(self.network, values)
            with name_in_errors(what):
                terms = self.objective.losses(predicted, values)
            loss = torch.stack(list(terms.values())).sum()
            self.optimiser.zero_grad()
            self.fabric.backward(loss)
            sums.add([loss, *terms.values()])
        means = sums.finish(self.fabric, self.recipe.micro_batches)
        return dict(zip(["loss", *terms], means, strict=True))

    def _skip(self, step: int, found: str, batches: Batches) -> None:
        found = f"step {step}: {found}; its pairs are {', '.join(batches.names(step))}"
        if self.skipped and step - self.skipped[-1] < STEPS_BETWEEN_SKIPS:
            raise StereoweaveError(f"{found}; step {self.skipped[-1]} was skipped for the like")
        self.skipped.append(step)
        self.fabric.log_dict({"skipped_steps": float(len(self.skipped))}, step)
        _LOGGER.warning("%s; skipped", found)

    def save_periodically(self, step: int, path: Path) -> None:
        """Write the run as it is after `step` steps, if that is ten minutes after it was written last."""
        if self.fabric.is_global_zero and time.monotonic() - self.saved_s > _SAVE_EVERY_S:
            self._write(step, self.scores, path)

    def save(self, step: int, scores: dict[str, float], path: Path) -> None:
        """Write the run as it is after `step` steps, and its scores to the curves."""
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
        )
        checkpoint.save(state, path)


def _load_start(recipe: Recipe, last: Path) -> Checkpoint:
    """Where the run stands: its own last checkpoint, the averaged weights of another, or random weights."""
    if last.exists():
        found = checkpoint.load(last)
        if replace(found.recipe, **{name: getattr(recipe, name) for name in _RESUMABLE}) != recipe:
            raise StereoweaveError(
                f"{last}: is of another recipe ({found.recipe.name}); "
                "train into a folder of its own, or remove it"
            )
        return replace(found, recipe=recipe, commit=checkpoint.find_commit())
    return checkpoint.make_initial(recipe, checkpoint.find_commit())


def _check_recipe(recipe: Recipe) -> None:
    """FormatError where the recipe names an unknown network or loss, or sizes or processes it cannot take."""
    with torch.device("meta"):
        network = build_network(recipe)
        build_objective(recipe, network)
    multiple = network.multiple_of
    sizes = recipe.crop_size + (recipe.pair_size if recipe.dataset == COLLAGE else ())
    if any(side % multiple for side in sizes):
        raise FormatError(
            f"{recipe.name}: pair_size = {list(recipe.pair_size)}, crop_size = {list(recipe.crop_size)}, "
            f"expected multiples of {multiple} for {recipe.model}"
        )
    if recipe.micro_batches % read_rank().world_size:
        raise FormatError(
            f"{recipe.name}: {recipe.micro_batches} micro-batches a step, expected a multiple of the "
            f"{read_rank().world_size} processes; set micro_batch, or --nproc-per-node"
        )


def _load_batches(batches: Batches, first: int) -> Iterator[tuple[int, dict[str, torch.Tensor]]]:
    """(step, its batch) from step `first` to the last, cut and recoloured in a process beside."""
    steps = range(first, batches.recipe.steps)
    loader = DataLoader(
        CaughtBatches(batches),
        sampler=steps,
        batch_size=None,
        num_workers=1,
        prefetch_factor=4,
        multiprocessing_context="spawn",
        # Its own, because a loader draws a number when it starts, and a restart would draw once more.
        generator=torch.Generator(),
    )
    for step, batch in zip(steps, loader, strict=True):
        if isinstance(batch, StereoweaveError):
            raise batch
        yield step, batch


def _make_fabric(logger: TensorBoardLogger) -> Fabric:
    """This process's device, among torchrun's processes where it has some."""
    own = read_rank()
    if own.world_size == 1:
        return Fabric(accelerator="auto", devices=1, precision=_choose_precision(), loggers=logger)
    cuda = torch.cuda.is_available()
    if cuda and own.local_world_size > torch.cuda.device_count():
        raise StereoweaveError(
            f"torchrun: expected at most a process for each of {torch.cuda.device_count()} GPUs, found "
            f"{own.local_world_size}; start fewer with --nproc-per-node"
        )
    if (threads := choose_thread_count()) and not cuda:
        torch.set_num_threads(threads)
    if own.rank > 0:
        logging.getLogger("lightning_fabric").setLevel(logging.WARNING)
    fabric = Fabric(
        accelerator="cuda" if cuda else "cpu",
        devices=own.local_world_size,
        num_nodes=own.world_size // own.local_world_size,
        strategy=DDPStrategy(timeout=_TIMEOUT),
        precision=_choose_precision(),
        loggers=logger,
    )
    if own.world_size == own.local_world_size > 1:
        _join_ranks(own, "nccl" if cuda else "gloo")
    fabric.launch()
    return fabric


def _join_ranks(own: ProcessRank, backend: str) -> None:
    """Joins the processes that torchrun started together on this machine.

    It keeps one store for all its starts: without a place of their own there, those that are started again
    find the addresses of their killed predecessors, and wait for them (PyTorch's issue 135712).
    """
    store, rank, count = next(rendezvous("env://", own.rank, own.world_size))
    place = f"start {os.environ['TORCHELASTIC_RESTART_COUNT']}"
    torch.distributed.init_process_group(
        backend,
        store=PrefixStore(place, store),
        rank=rank,
        world_size=count,
        timeout=_TIMEOUT,
    )


@contextmanager
def _skip_teardown_on_error() -> Iterator[None]:
    """An error in the block ends this process, although others wait for it on their GPUs.

    NCCL is left at exit by all processes together: who leaves it alone waits for the others, and they for it.
    """
    try:
        yield
    except BaseException:
        atexit.unregister(_destroy_dist_connection)
        raise


def _keep_freed_memory() -> None:
    """Have glibc keep large blocks that are freed: getting them anew from the kernel slows every step."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        m_trim_threshold, m_top_pad, m_mmap_max = -1, -2, -4
        mallopt(m_mmap_max, 0)
        mallopt(m_trim_threshold, 2**31 - 1)
        mallopt(m_top_pad, 2**28)


@torch.no_grad()
def _update_average(
    averaged_steps: int,
    averaged: Sequence[torch.Tensor],
    current: Sequence[torch.Tensor],
    steps: torch.Tensor | int,
) -> None:
    """Move the average towards the current weights: fast at first, so that random ones are soon forgotten."""
    share = max(1 / averaged_steps, 9 / (9 + float(steps)))
    for average, value in zip(averaged, current, strict=True):
        if average.is_floating_point():
            average.lerp_(value.to(average), share)
        else:
            average.copy_(value)


def _choose_precision() -> Literal["bf16-mixed", "32-true"]:
    """bfloat16 where the device computes in it, float32 elsewhere."""
    if torch.accelerator.is_available():
        computes = torch.cuda.is_bf16_supported()
    else:
        one_dnn = torch.backends.mkldnn.is_available()  # type: ignore[no-untyped-call]
        computes = one_dnn and torch.cpu.get_capabilities().get("avx512_bf16", False)
    return "bf16-mixed" if computes else "32-true"
