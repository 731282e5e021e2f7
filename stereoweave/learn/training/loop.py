"""The training loop from a recipe to a network; an interrupted run resumes where it stopped."""

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

# In the run's folder, beside the checkpoint: the scores of every validation.
SCORES_FILE = "validation.csv"
# Longest time between two checkpoints: a killed run loses no more.
_SAVE_EVERY_S = 600
# Recipe keys that may change when a run resumes.
_RESUMABLE = ("steps", "cool_down_steps", "mix", "pair_size", "crop_size", "validate_every", "held_out")
# The other ranks wait for rank 0 while it makes pairs or scores. If rank 0 dies, torchrun ends them.
_TIMEOUT = timedelta(days=1)

_LOGGER = logging.getLogger(__name__)


def train(recipe_path: Path, out: Path, console: Console | None = None) -> Path:
    """Train the network of a recipe in folder `out`, or resume there. Returns the last checkpoint's path.

    Under torchrun the ranks share each step's micro-batches; only rank 0 writes.

    Raises:
        StereoweaveError: The recipe is invalid, `out` is in use or holds the run of another recipe, or the
            loss is not finite.
    """
    with report_once(), _skip_teardown_on_error():
        return train_recipe(read_recipe(recipe_path), out, console or Console(quiet=read_rank().rank > 0))


def train_recipe(recipe: Recipe, out: Path, console: Console) -> Path:
    """Train a `Recipe`; see `train`."""
    _check_recipe(recipe)
    if read_rank().rank:  # only rank 0 writes and holds the lock
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
    """Open the training and held-out pairs. Rank 0 makes missing ones."""
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
        f"{out}: expected the run that rank 0 sees there, found another on {platform.node()}; "
        "train into a folder that all machines share"
    )


def _validate(run: "TrainingRun", steps: int, held_out: PairSource, last: Path, console: Console) -> None:
    """Score the run after `steps` steps; save checkpoint and scores."""
    network, device = run.averaged.module, run.fabric.device
    scores = run.objective.scores(network, held_out, device)
    for name, pairs in run.by_class.items():
        found = validate_by_class(network, pairs, device)
        scores |= {f"{name}_{key}": value for key, value in found.items()}
    # Before the checkpoint: a run killed in between writes the same row again.
    append_scores(last.with_name(SCORES_FILE), steps, scores)
    run.save(steps, scores, last)
    console.print(f"step {steps}: " + "  ".join(f"{k} {v:.4g}" for k, v in scores.items()))


def append_scores(path: Path, step: int, scores: dict[str, float]) -> None:
    """Append the scores after `step` steps to a CSV file, replacing rows of that step and later ones."""
    rows = [row for row in read_scores(path) if row["step"] < step] + [{"step": step, **scores}]
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[-1]))
        writer.writeheader()
        writer.writerows(rows)


def read_scores(path: Path) -> list[dict[str, float]]:
    """Read a run's scores in the order of steps; [] if the file does not exist yet."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


@contextmanager
def close_curves(logger: TensorBoardLogger) -> Iterator[TensorBoardLogger]:
    """Yield the logger, and flush it when the block ends, also after an error."""
    try:
        yield logger
    finally:
        logger.finalize("left")


class TrainingRun(ModelState):
    """The state of a run of `train`, and the device and ranks that train it."""

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
        """Take one optimiser step. Returns the loss.

        A step whose loss or gradient is not finite changes nothing; it is counted and logged.

        Raises:
            StereoweaveError: Two such steps are less than 500 steps apart.
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
        """Set the gradient of a step, summed over all ranks. Returns the loss and its terms."""
        what = f"step {step}: one of {', '.join(batches.names(step))}"
        for part, values in zip(batches.parts, split_batch(batch, len(batches.parts)), strict=True):
            if self.recipe.micro_batches > 1:
                # Dropout depends on the micro-batch, not on the rank.
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
            raise StereoweaveError(f"{found}; step {self.skipped[-1]} was skipped for the same reason")
        self.skipped.append(step)
        self.fabric.log_dict({"skipped_steps": float(len(self.skipped))}, step)
        _LOGGER.warning("%s; skipped", found)

    def save_periodically(self, step: int, path: Path) -> None:
        """Save a checkpoint after `step` steps if the last one is ten minutes old."""
        if self.fabric.is_global_zero and time.monotonic() - self.saved_s > _SAVE_EVERY_S:
            self._write(step, self.scores, path)

    def save(self, step: int, scores: dict[str, float], path: Path) -> None:
        """Save a checkpoint after `step` steps and log its scores."""
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
    """Load the state to start from: the run's last checkpoint, else `start_from` or random weights."""
    if last.exists():
        found = checkpoint.load(last)
        if replace(found.recipe, **{name: getattr(recipe, name) for name in _RESUMABLE}) != recipe:
            raise StereoweaveError(
                f"{last}: expected a run of this recipe, found one of another ({found.recipe.name}); "
                "train into a new folder, or remove the file"
            )
        return replace(found, recipe=recipe, commit=checkpoint.find_commit())
    return checkpoint.make_initial(recipe, checkpoint.find_commit())


def _check_recipe(recipe: Recipe) -> None:
    """Raise FormatError for an unknown network or loss, or for sizes or rank counts that do not fit."""
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
    """Yield (step, batch) from step `first` to the last; another process crops and recolours."""
    steps = range(first, batches.recipe.steps)
    loader = DataLoader(
        CaughtBatches(batches),
        sampler=steps,
        batch_size=None,
        num_workers=1,
        prefetch_factor=4,
        multiprocessing_context="spawn",
        # Its own generator: a loader draws a seed when it starts, and a restart would draw again.
        generator=torch.Generator(),
    )
    for step, batch in zip(steps, loader, strict=True):
        if isinstance(batch, StereoweaveError):
            raise batch
        yield step, batch


def _make_fabric(logger: TensorBoardLogger) -> Fabric:
    """Set up this rank's device, and its process group under torchrun."""
    own = read_rank()
    if own.world_size == 1:
        return Fabric(accelerator="auto", devices=1, precision=_choose_precision(), loggers=logger)
    cuda = torch.cuda.is_available()
    if cuda and own.local_world_size > torch.cuda.device_count():
        raise StereoweaveError(
            f"torchrun: expected at most one process for each of {torch.cuda.device_count()} GPUs, found "
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
    """Join the ranks that torchrun started together on this machine.

    torchrun reuses one store for all restarts. Without a prefix per restart, new ranks find the addresses of
    killed ones and wait for them (PyTorch's issue 135712).
    """
    store, rank, count = next(rendezvous("env://", own.rank, own.world_size))
    prefix = f"start {os.environ['TORCHELASTIC_RESTART_COUNT']}"
    torch.distributed.init_process_group(
        backend,
        store=PrefixStore(prefix, store),
        rank=rank,
        world_size=count,
        timeout=_TIMEOUT,
    )


@contextmanager
def _skip_teardown_on_error() -> Iterator[None]:
    """Skip the teardown of the process group after an error, so that this process exits at once.

    NCCL's teardown waits for all ranks, which in turn wait for this one on their GPUs.
    """
    try:
        yield
    except BaseException:
        atexit.unregister(_destroy_dist_connection)
        raise


def _keep_freed_memory() -> None:
    """Make glibc keep large freed blocks: new ones from the kernel slow down every step."""
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
    """bfloat16 if the device has native support, else float32."""
    if torch.accelerator.is_available():
        computes = torch.cuda.is_bf16_supported()
    else:
        one_dnn = torch.backends.mkldnn.is_available()  # type: ignore[no-untyped-call]
        computes = one_dnn and torch.cpu.get_capabilities().get("avx512_bf16", False)
    return "bf16-mixed" if computes else "32-true"
