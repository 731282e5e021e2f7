"""Training loop: trains the network of a recipe, and resumes interrupted runs."""

import csv
import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from lightning_fabric import Fabric
from lightning_fabric.loggers.tensorboard import TensorBoardLogger
from rich.console import Console
from torch.utils.data import DataLoader

from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.files import make_folder, replacing
from stereoweave.io.output_lock import lock_output
from stereoweave.learn.data.batches import Batches, CaughtBatches
from stereoweave.learn.data.sources import PairSource, cache_pairs, open_sources
from stereoweave.learn.distributed import read_rank, report_once
from stereoweave.learn.models import build_network
from stereoweave.learn.recipe import COLLAGE, Recipe, read_recipe
from stereoweave.learn.training.fabric import keep_freed_memory, make_fabric, skip_teardown_on_error
from stereoweave.learn.training.model_state import find_fixed_parts
from stereoweave.learn.training.objective import build_objective, fit_recipe
from stereoweave.learn.training.run import TrainingRun, load_start
from stereoweave.learn.training.scores import validate_sets
from stereoweave.system.progress import progress

# Scores of every validation, in the run's folder.
SCORES_FILE = "validation.csv"


def train(recipe_path: Path, out: Path, console: Console | None = None) -> Path:
    """Train a recipe's network in the folder `out`, or resume its run. Returns the last checkpoint's path.

    Under torchrun, the ranks share each step's micro-batches, and only rank 0 writes files.

    Raises:
        StereoweaveError: If the recipe is invalid, if `out` is in use or holds the run of another recipe, or
            if the loss is not finite.
    """
    with report_once(), skip_teardown_on_error():
        return train_recipe(read_recipe(recipe_path), out, console or Console(quiet=read_rank().rank > 0))


def train_recipe(recipe: Recipe, out: Path, console: Console) -> Path:
    """Train the network of a `Recipe`; see `train`."""
    _check_recipe(recipe)
    if read_rank().rank:  # only rank 0 writes files and holds the lock
        return _train(recipe, out, console)
    with lock_output(make_folder(out)):
        return _train(recipe, out, console)


def _train(recipe: Recipe, out: Path, console: Console) -> Path:
    keep_freed_memory()
    last = out / "last.pt"
    logger = TensorBoardLogger(out, name="", version="")
    fabric = make_fabric(logger)
    pairs, held_out = _prepare_pairs(recipe, out, console, fabric)
    recipe = fit_recipe(recipe, pairs)
    start = load_start(recipe, last)
    if start.step != fabric.broadcast(start.step):
        raise _folder_not_shared(out)
    if start.step > recipe.steps:
        raise StereoweaveError(
            f"{last}: expected at most {recipe.steps} steps, as the recipe has, found {start.step}; "
            "give the recipe more steps"
        )
    if start.step == recipe.steps:
        return last
    run = TrainingRun(recipe, start, fabric)
    batches = Batches(recipe, pairs, read_rank())
    with close_curves(logger), progress(console) as bar:
        task = bar.add_task(recipe.name, total=recipe.steps, completed=run.start.step, loss="", rate="")
        began = time.perf_counter()
        for step, batch in _load_batches(batches, run.start.step):
            loss = run.step(step, batch, batches)
            rate = recipe.batch / (time.perf_counter() - began)
            if (step + 1) % recipe.validate_every == 0 or step + 1 == recipe.steps:
                if run.fabric.is_global_zero:
                    _validate(run, step + 1, held_out, last, console)
                run.fabric.barrier()
            else:  # a checkpoint before the validation would let a killed run resume without it
                run.save_periodically(step + 1, last)
            bar.update(task, completed=step + 1, loss=f"loss {loss:.4g}", rate=f"{rate:.1f} pairs/s")
            began = time.perf_counter()
    return last


def _prepare_pairs(
    recipe: Recipe, out: Path, console: Console, fabric: Fabric
) -> tuple[PairSource, PairSource]:
    """Open the training pairs and the held-out pairs. Rank 0 makes the missing pairs."""
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
        f"{out}: expected the run that rank 0 sees in this folder, found other contents on "
        f"{platform.node()}; train into a folder that all machines share"
    )


def _validate(run: TrainingRun, steps: int, held_out: PairSource, last: Path, console: Console) -> None:
    """Score the run after `steps` steps, and save its checkpoint and scores."""
    network, device = run.averaged.module, run.fabric.device
    scores = run.objective.scores(network, held_out, device)
    scores |= validate_sets(network, run.by_class, device)
    # Scores are saved before the checkpoint: a run killed in between writes the same row again.
    append_scores(last.with_name(SCORES_FILE), steps, scores)
    run.save(steps, scores, last)
    console.print(f"step {steps}: " + "  ".join(f"{k} {v:.4g}" for k, v in scores.items()))


def append_scores(path: Path, step: int, scores: dict[str, float]) -> None:
    """Append the scores after `step` steps to a CSV file, replacing the rows of that and later steps."""
    rows = [row for row in read_scores(path) if row["step"] < step] + [{"step": step, **scores}]
    # Held-out sets may change when a run resumes.
    columns = dict.fromkeys(name for row in rows for name in row)
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(columns), restval="")
        writer.writeheader()
        writer.writerows(rows)


def read_scores(path: Path) -> list[dict[str, float]]:
    """Read a run's scores in the order of steps, without those of sets that a step was not scored on.

    The list is empty if the file does not exist yet.
    """
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [{name: float(value) for name, value in row.items() if value} for row in csv.DictReader(file)]


@contextmanager
def close_curves(logger: TensorBoardLogger) -> Iterator[TensorBoardLogger]:
    """Yield the logger, and flush it when the block ends, even after an error."""
    try:
        yield logger
    finally:
        logger.finalize("left")


def _check_recipe(recipe: Recipe) -> None:
    """Raise FormatError if a network or loss is unknown, or if a size or the number of ranks is invalid."""
    with torch.device("meta"):
        network = build_network(recipe)
        build_objective(recipe, network)
        find_fixed_parts(network, recipe)
    multiple = network.multiple_of
    sizes = recipe.crop_size + (recipe.pair_size if recipe.dataset == COLLAGE else ())
    if any(side % multiple for side in sizes):
        raise FormatError(
            f"{recipe.name}: pair_size and crop_size: expected multiples of {multiple} for {recipe.model}, "
            f"found {list(recipe.pair_size)} and {list(recipe.crop_size)}"
        )
    if recipe.micro_batches % read_rank().world_size:
        raise FormatError(
            f"{recipe.name}: micro-batches per step: expected a multiple of {read_rank().world_size}, "
            f"the number of processes, found {recipe.micro_batches}; set micro_batch or --nproc-per-node"
        )


def _load_batches(batches: Batches, first: int) -> Iterator[tuple[int, dict[str, torch.Tensor]]]:
    """Yield the number and the batch of each step from `first` on.

    Another process crops and recolours the pairs.
    """
    steps = range(first, batches.recipe.steps)
    loader = DataLoader(
        CaughtBatches(batches),
        sampler=steps,
        batch_size=None,
        num_workers=1,
        prefetch_factor=4,
        multiprocessing_context="spawn",
        # With its own generator, because a loader draws a seed whenever it starts, also when a run resumes.
        generator=torch.Generator(),
    )
    for step, batch in zip(steps, loader, strict=True):
        if isinstance(batch, StereoweaveError):
            raise batch
        yield step, batch
