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
from stereoweave.learn.checkpoint import Checkpoint
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
        StereoweaveError: If the run has no scores yet, is a timed run, or is the file of a network.
    """
    if run.is_file() or (run / PROGRESS_FILE).exists():
        what = "network" if run.is_file() else "run of recipes/gpu/train.py"
        raise StereoweaveError(
            f"{run}: expected a recipe for a {what}, found none",
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
    _write(out, [*(row for row in _read(out) if row["recipe"] != _name(run)), *rows])
    return _fit_curves(rows)


def record_network(
    source: Path, recipe: Recipe, pairs: Path, out: Path, console: Console
) -> dict[str, float]:
    """Score a network on a recipe's held-out pairs, and write the row to a CSV file. Returns the scores.

    All other rows of the file are kept and come first.

    Args:
        source: Folder of a timed run, or a checkpoint, whose steps and pairs are those of its last recipe.
        recipe: Recipe of the held-out pairs and sets.
        pairs: Folder of the held-out collages; missing ones are painted.
        out: CSV file to write, with the columns of `record_curve`.
        console: Console for the progress of missing held-out collages.

    Raises:
        FormatError: A file of the run or a held-out set is missing or broken.
    """
    kept, steps, seen = _load_network(source)
    _, held_out = open_sources(replace(recipe, mix=()), pairs)  # no training sets are needed
    sets, device = open_held_out_sets(recipe), choose_device()
    cache_pairs(held_out, console)
    network = kept.build_averaged().to(device)
    scores = validate(network, held_out, device) | validate_sets(network, sets, device)
    row = _make_row(source, seen, {"step": steps, **scores}, kept.commit)
    others = [one for one in _read(out) if (one["recipe"], one["step"]) != (_name(source), str(steps))]
    _write(out, [*others, row])
    return scores


def _load_network(source: Path) -> tuple[Checkpoint, int, int]:
    """Return a network, and the steps and pairs of its training."""
    if source.is_file():
        kept = checkpoint.load(source)
        return kept, kept.step, kept.step * kept.recipe.batch
    progress = read_progress(source / PROGRESS_FILE)
    return checkpoint.load(source / NETWORK_FILE), progress.steps, progress.pairs


def _name(source: Path) -> str:
    return source.name.removesuffix(".pt")


def _make_row(run: Path, pairs: int, scores: dict[str, float], commit: str) -> dict[str, Any]:
    return {
        "recipe": _name(run),
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
