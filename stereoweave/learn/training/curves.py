"""Learning curves: validation scores against the number of pairs seen, with fitted power laws."""

import csv
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

from stereoweave.errors import Remedy, StereoweaveError
from stereoweave.io.files import replacing
from stereoweave.learn import checkpoint
from stereoweave.learn.data.sources import cache_pairs, open_held_out_sets, open_sources
from stereoweave.learn.devices import choose_device, describe_device
from stereoweave.learn.recipe import Recipe
from stereoweave.learn.training.loop import SCORES_FILE, read_scores
from stereoweave.learn.training.scores import validate, validate_sets
from stereoweave.learn.training.timed_run import NETWORK_FILE, PROGRESS_FILE, read_progress

# The first scores show how a run recovers from its initial weights, not how it learns.
_LEAST_PAIRS_SHARE = 0.1
_LEAST_POINTS = 4
_KEYS = ("recipe", "step", "pairs")


class PowerLaw(NamedTuple):
    """The power law score = at_10000_pairs * (pairs / 10,000) ** -exponent."""

    at_10000_pairs: float
    exponent: float


def fit_power_law(pairs: Sequence[float], scores: Sequence[float]) -> PowerLaw:
    """Fit a power law to positive scores by least squares on their logarithms."""
    slope, offset = np.polyfit(np.log(np.divide(pairs, 10_000)), np.log(scores), 1)
    return PowerLaw(at_10000_pairs=float(np.exp(offset)), exponent=float(-slope))


def record_curve(run: Path, out: Path) -> dict[str, PowerLaw]:
    """Write a run's scores to a CSV file. Returns a power law for each bad-1 and end-point error.

    Rows of other runs in the file are kept and come first.

    Args:
        run: Folder of the run.
        out: CSV file to write, with recipe, step, pairs seen, scores, commit and machine.

    Raises:
        StereoweaveError: If the run has no scores yet, or is a timed run.
    """
    if (run / PROGRESS_FILE).exists():
        raise StereoweaveError(
            f"{run}: expected a recipe for a run of recipes/gpu/train.py, found none",
            remedy=Remedy("give the recipe of its held-out pairs", ("recipe",)),
        )
    kept, record = checkpoint.load(run / "last.pt"), read_scores(run / SCORES_FILE)
    if not record:
        raise StereoweaveError(
            f"{run / SCORES_FILE}: expected scores of a run, found none; train until the first validation"
        )
    rows = [
        _make_row(run, round(scores["step"] * kept.recipe.batch), scores, kept.commit) for scores in record
    ]
    _write(out, [*(row for row in _read(out) if row["recipe"] != run.name), *rows])
    return _fit_curves(rows)


def record_timed_run(run: Path, recipe: Recipe, out: Path, console: Console) -> dict[str, float]:
    """Score a timed run on a recipe's held-out pairs, and write the row to a CSV file. Returns the scores.

    All other rows of the file are kept and come first. Missing held-out collages are painted into the folder
    `pairs` beside the run's.

    Args:
        run: Folder with the network and the progress of a timed run.
        recipe: Recipe of the held-out pairs and sets.
        out: CSV file to write, with the columns of `record_curve`.
        console: Console for the progress of missing held-out collages.

    Raises:
        FormatError: A file of the run or a held-out set is missing or broken.
    """
    kept, progress = checkpoint.load(run / NETWORK_FILE), read_progress(run / PROGRESS_FILE)
    _, held_out = open_sources(replace(recipe, mix=()), run.parent / "pairs")  # no training sets are needed
    sets, device = open_held_out_sets(recipe), choose_device()
    cache_pairs(held_out, console)
    network = kept.build_averaged().to(device)
    scores = validate(network, held_out, device) | validate_sets(network, sets, device)
    row = _make_row(run, progress.pairs, {"step": progress.steps, **scores}, kept.commit)
    others = [one for one in _read(out) if (one["recipe"], one["step"]) != (run.name, str(progress.steps))]
    _write(out, [*others, row])
    return scores


def _make_row(run: Path, pairs: int, scores: dict[str, float], commit: str) -> dict[str, Any]:
    return {
        "recipe": run.name,
        "pairs": pairs,
        **{name: round(value, 5) for name, value in scores.items()},
        "step": round(scores["step"]),
        "commit": commit,
        "machine": describe_device(choose_device()),
    }


def _fit_curves(rows: Sequence[dict[str, Any]]) -> dict[str, PowerLaw]:
    late = [row for row in rows if row["pairs"] >= _LEAST_PAIRS_SHARE * rows[-1]["pairs"]]
    names = [name for name in rows[-1] if name.endswith(("epe_px", "bad1_percent")) and rows[-1][name] > 0]
    known = {name: [row for row in late if row.get(name, 0) > 0] for name in names}
    return {
        name: fit_power_law([row["pairs"] for row in points], [row[name] for row in points])
        for name, points in known.items()
        if len(points) >= _LEAST_POINTS
    }


def _read(path: Path) -> list[dict[str, Any]]:
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _write(path: Path, rows: Iterable[dict[str, Any]]) -> None:
    rows = list(rows)
    columns = list(dict.fromkeys([*_KEYS, *(name for row in rows for name in row)]))
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
