"""Command-line interface of the fuzzer: `python -m fuzz`."""

import csv
import os
import platform
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from random import SystemRandom
from typing import Annotated

import typer

from fuzz.findings import keep
from fuzz.running import Outcome, fuzz
from fuzz.targets import NAMES
from stereoweave.system.threads import usable_cores

CORPUS = Path(__file__).parent.parent / "tests" / "corpus"


def main(
    seconds: Annotated[float, typer.Option(help="Total time, shared evenly among the targets.")] = 60.0,
    seed: Annotated[int | None, typer.Option(help="Random seed; default: a new one each time.")] = None,
    target: Annotated[
        list[str] | None, typer.Option(help=f"One of {', '.join(NAMES)}; default: all.")
    ] = None,
    corpus: Annotated[Path, typer.Option(help="Folder for findings, with a subfolder per target.")] = CORPUS,
    out: Annotated[Path | None, typer.Option(help="CSV file to which one row per target is added.")] = None,
) -> None:
    """Read damaged files of every kind; exit with status 1 if there are findings."""
    seed = SystemRandom().randrange(10**6) if seed is None else seed
    targets, jobs = target or list(NAMES), usable_cores()
    typer.echo(f"seed {seed}")
    outcomes = []
    with ThreadPoolExecutor(min(jobs, len(targets))) as pool:
        share_s = seconds * min(jobs, len(targets)) / len(targets)
        for outcome in pool.map(partial(_fuzz_target, seed=seed, seconds=share_s, corpus=corpus), targets):
            typer.echo("\n".join(_lines(outcome, corpus)))
            outcomes.append(outcome)
    if out:
        _append(out, [_row(outcome, seed) for outcome in outcomes])
    sys.exit(any(outcome.findings for outcome in outcomes))


def _fuzz_target(target: str, seed: int, seconds: float, corpus: Path) -> Outcome:
    return fuzz(target, seed, seconds, corpus / target)


def _lines(outcome: Outcome, corpus: Path) -> Iterator[str]:
    """Store the findings; yield a line for the target, then one for each finding."""
    per_s = outcome.cases / outcome.seconds
    yield f"{outcome.target:<13} {outcome.cases:>9,} cases, {per_s:7,.0f}/s, {len(outcome.findings)} findings"
    for finding in outcome.findings.values():
        yield f"  {finding.key}: {finding.detail}  -> {keep(finding, corpus / outcome.target)}"


def _row(outcome: Outcome, seed: int) -> dict[str, object]:
    command = ["git", "describe", "--always", "--dirty=+", "--exclude=*"]
    described = subprocess.run(command, capture_output=True, text=True, check=False)
    return {
        "commit": described.stdout.strip() or "unknown",
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "seed": seed,
        "target": outcome.target,
        "seconds": round(outcome.seconds),
        "cases": outcome.cases,
        "findings": len(outcome.findings),
    }


def _append(path: Path, rows: Sequence[dict[str, object]]) -> None:
    is_new = not path.exists()
    with path.open("a", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0], lineterminator="\n")
        if is_new:
            writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(main)
    app()
