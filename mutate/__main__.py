"""Draw mutants and report which of them the tests detect: python -m mutate."""

import argparse
import csv
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mutate.drawing import draw
from mutate.session import KILLED, SURVIVED, TIMEOUT, Session, Trial
from mutate.targets import TARGETS

_LEAST_PERCENT = 85
_RUNS, _TABLE = Path("runs/mutate"), Path("results/mutants.csv")
_COLUMNS = ("commit", "seed", "module", "drawn", "killed", "survived", "timeouts", "killed_percent")


def main() -> int:
    """Try the mutants and write the results. Return 1 if fewer than 85 % of them are killed, else 0."""
    parser = argparse.ArgumentParser(prog="python -m mutate", description=__doc__)
    parser.add_argument("--count", type=_positive, default=400, help="number of mutants")
    parser.add_argument("--seed", type=int, default=1, help="random seed of the draw")
    parser.add_argument("--jobs", type=_positive, default=2, help="number of mutants tried at the same time")
    options = parser.parse_args()
    root = Path.cwd()
    trials = _try_all(Session(root, root / _RUNS, options.jobs), options.count, options.seed)
    rows = _rows(trials, options.seed)
    with (root / _TABLE).open("w", newline="", encoding="utf-8") as out:
        writer = csv.DictWriter(out, _COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    survivors = _RUNS / f"survivors-{options.seed}.diff"
    survived = [trial.mutant for trial in trials if trial.outcome == SURVIVED]
    survivors.write_text(
        "".join(f"# {each.operator}\n{each.diff()}\n" for each in survived), encoding="utf-8"
    )
    for row in rows:
        print("{module}: {killed} of {drawn} killed, {killed_percent} %".format(**row))
    print(f"survivors: {survivors}")
    return int(rows[-1]["killed_percent"] < _LEAST_PERCENT)


def _positive(text: str) -> int:
    if (number := int(text)) < 1:
        raise argparse.ArgumentTypeError(f"expected 1 or more, found {text}")
    return number


def _try_all(session: Session, count: int, seed: int) -> list[Trial]:
    mutants = draw(session.root, count, seed)
    covered = session.measure(print)
    for test in covered.failed:
        print(f"fails on the unchanged sources and is skipped: {test}")
    trials = []
    for trial in session.try_all(mutants, covered, seed):
        trials.append(trial)
        made = f"{trial.mutant.path}:{trial.mutant.line} {trial.mutant.operator}"
        print(f"{len(trials)}/{len(mutants)} {trial.outcome}: {made}, {trial.seconds} s", flush=True)
    return trials


def _rows(trials: Sequence[Trial], seed: int) -> list[dict[str, Any]]:
    """Return one row per part of the package and one for the total."""
    git = ["git", "describe", "--always", "--dirty=+", "--exclude=*"]
    commit = subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    rows: list[dict[str, Any]] = []
    for module in (*TARGETS, "all"):
        found = Counter(trial.outcome for trial in trials if module in (trial.mutant.target, "all"))
        if drawn := found.total():
            killed = found[KILLED] + found[TIMEOUT]
            numbers = (drawn, killed, found[SURVIVED], found[TIMEOUT], round(100 * killed / drawn, 1))
            rows.append(dict(zip(_COLUMNS, (commit, seed, module, *numbers), strict=True)))
    return rows


if __name__ == "__main__":
    sys.exit(main())
