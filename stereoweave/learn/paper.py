"""The paper's experiment, run for real: every training of trials.py, on the same pairs in the same order."""

import multiprocessing
import os
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path

import torch
from rich.console import Console

from stereoweave.learn.objective import fitted
from stereoweave.learn.recipe import Recipe
from stereoweave.learn.sources import sources
from stereoweave.learn.train import kept, train_recipe
from stereoweave.learn.trials import Trial, trials


def run_trials(base: Recipe, runs: Path, seeds: int, jobs: int, console: Console) -> list[Trial]:
    """The trials, each trained in a folder of its own in `runs`; what was trained before stays as it is.

    Args:
        base: The paper's recipe for the data at hand.
        runs: The folder; killed and started again, the experiment goes on where it was.
        seeds: How often each training is repeated.
        jobs: Trainings at a time, which share the processor's cores.
        console: Where progress is told.
    """
    training, _ = (kept(pairs, console) for pairs in sources(base, runs / "pairs"))
    exponent = fitted(replace(base, fit_exponent=True), training).exponent
    planned = [_below(trial, runs) for trial in trials(base, seeds, exponent)]
    recipes = {trial.recipe.name: trial.recipe for trial in planned}.values()
    # Made before, so that no two trainings make the same ones.
    for pairs in (pairs for recipe in recipes for pairs in sources(recipe, runs / "pairs")):
        kept(pairs, console)
    # What starts from another training comes when that one is there.
    for group in (
        [recipe for recipe in recipes if not recipe.start_from],
        [recipe for recipe in recipes if recipe.start_from],
    ):
        _train_all(group, runs, jobs, console)
    return planned


def _below(trial: Trial, runs: Path) -> Trial:
    start = trial.recipe.start_from
    return replace(trial, recipe=replace(trial.recipe, start_from=str(runs / start) if start else ""))


def _train_all(recipes: Iterable[Recipe], runs: Path, jobs: int, console: Console) -> None:
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as workers:
        started = {
            workers.submit(_train, recipe, runs / recipe.name, jobs): recipe.name for recipe in recipes
        }
        for done in as_completed(started):
            done.result()
            console.print(started[done])


def _train(recipe: Recipe, folder: Path, jobs: int) -> None:
    torch.set_num_threads(max(1, (os.cpu_count() or 1) // jobs))
    train_recipe(recipe, folder, Console(quiet=True))
