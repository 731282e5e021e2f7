"""The paper's experiment: runs every training of trials.py on the same pairs in the same order."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from rich.console import Console

from experiments.paper.finished import score_training
from experiments.paper.trials import CLAIMS, SLOW_SHARE, Extent, list_trials
from experiments.trial import Trial
from stereoweave.errors import StereoweaveError
from stereoweave.learn.data.sources import cache_pairs, open_sources
from stereoweave.learn.recipe import COLLAGE, Recipe
from stereoweave.learn.training.loop import train_recipe
from stereoweave.learn.training.objective import fit_recipe
from stereoweave.synth.sets.workers import count_step, run_in_workers
from stereoweave.system.threads import usable_cores


def plan(base: Recipe, runs: Path, extent: Extent, console: Console) -> list[Trial]:
    """Plan the trials, create their missing pairs, and fit the exponent.

    Args:
        base: The paper's recipe for the data at hand; the exponent is fitted to its training pairs.
        runs: Folder of the runs, with cached pairs in the subfolder `pairs`.
        extent: Which claims are tested, and how often.
        console: Console that shows the progress.

    Raises:
        StereoweaveError: If a claim is unknown, if the base has another network, too few steps or fewer than
            the slow networks, or if its target is depth and its pairs have no camera.
    """
    _check_base(base, extent)
    training, _ = (cache_pairs(pairs, console) for pairs in open_sources(base, runs / "pairs"))
    exponent = fit_recipe(replace(base, fit_exponent=True), training).exponent
    planned = [_resolve_start(trial, runs) for trial in list_trials(base, extent, exponent)]
    for trial in planned:
        for pairs in open_sources(trial.recipe, runs / "pairs"):
            cache_pairs(pairs, console)
    return planned


def run_trials(
    planned: Iterable[Trial], runs: Path, jobs: int, console: Console, scored: bool = False
) -> None:
    """Train each trial in its own folder of `runs`. Interrupted training runs resume.

    Args:
        planned: Trials whose training pairs all exist, so that no two training runs create the same ones.
        runs: Folder of the runs.
        jobs: Number of training runs in parallel, which share the processor's cores.
        console: Console that shows the progress.
        scored: Whether to score each training on all its held-out pairs, for a report.
    """
    recipes = {trial.recipe.name: trial.recipe for trial in planned}.values()
    # A training that starts from another one must wait for its checkpoint.
    train = partial(_train, runs, jobs, scored)
    _train_all([recipe for recipe in recipes if not recipe.start_from], train, jobs, console)
    _train_all([recipe for recipe in recipes if recipe.start_from], train, jobs, console)


def _check_base(base: Recipe, extent: Extent) -> None:
    # Collages have no camera, which depth as a target would need.
    target = {"target": "disparity"} if base.dataset == COLLAGE else {}
    for key, expected in {"model": "fast_depth", **target}.items():
        if (found := getattr(base, key)) != expected:
            raise StereoweaveError(
                f"{base.name}: {key}: expected {expected!r}, from which the experiment starts, "
                f"found {found!r}"
            )
    if unknown := [claim for claim in extent.claims if claim not in CLAIMS]:
        raise StereoweaveError(f"only: expected some of {', '.join(CLAIMS)}, found {unknown[0]!r}")
    least = extent.slow_steps or SLOW_SHARE
    if base.steps < least:
        raise StereoweaveError(
            f"{base.name}: steps: expected at least {least}, because the slow networks train for fewer steps "
            f"than the others, found {base.steps}"
        )


def _resolve_start(trial: Trial, runs: Path) -> Trial:
    start = trial.recipe.start_from
    # Absolute, so that a resumed experiment may spell the folder differently.
    start_from = str((runs / start).resolve()) if start else ""
    return replace(trial, recipe=replace(trial.recipe, start_from=start_from))


def _train_all(
    recipes: Sequence[Recipe], train: Callable[[Recipe], str], jobs: int, console: Console
) -> None:
    for name in run_in_workers(train, recipes, jobs, console, "training", len(recipes)):
        console.print(name)


def _train(runs: Path, jobs: int, scored: bool, recipe: Recipe) -> str:
    torch.set_num_threads(max(1, usable_cores() // jobs))
    train_recipe(recipe, runs / recipe.name, Console(quiet=True))
    if scored:
        score_training(runs / recipe.name, runs / "pairs")
    count_step()
    return recipe.name
