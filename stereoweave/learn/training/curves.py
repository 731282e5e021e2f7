"""Learning curves: validation scores against the number of pairs seen, with fitted power laws."""

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stereoweave.errors import StereoweaveError
from stereoweave.io.files import replacing
from stereoweave.learn import checkpoint
from stereoweave.learn.devices import choose_device, describe_device
from stereoweave.learn.training.loop import SCORES_FILE, read_scores

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
        StereoweaveError: If the run has no scores yet.
    """
    kept, record = checkpoint.load(run / "last.pt"), read_scores(run / SCORES_FILE)
    if not record:
        raise StereoweaveError(
            f"{run / SCORES_FILE}: expected scores of a run, found none; train until the first validation"
        )
    recipe = kept.recipe
    machine = describe_device(choose_device())
    rows = [
        {
            "recipe": run.name,
            "pairs": round(scores["step"] * recipe.batch),
            **{name: round(value, 5) for name, value in scores.items()},
            "step": round(scores["step"]),
            "commit": kept.commit,
            "machine": machine,
        }
        for scores in record
    ]
    _write(out, [*(row for row in _read(out) if row["recipe"] != run.name), *rows])
    return _fit_curves(rows)


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
