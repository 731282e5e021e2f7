"""Finished trainings: their scores and curves, which are kept after their run folders are gone."""

import json
import platform
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from stereoweave.bench.projected_views import ProjectionRow
from stereoweave.io.files import replacing
from stereoweave.learn import checkpoint
from stereoweave.learn.evaluation import score_run
from stereoweave.learn.training.loop import SCORES_FILE, read_scores

_FILE = "finished.json"


@dataclass(frozen=True, kw_only=True)
class Finished:
    """What a report needs of a finished training, except for its weights.

    Attributes:
        name: Name of its recipe, which spells out its settings.
        commit: Commit of the code that trained it.
        machine: GPU or processor that finished it.
        minutes: Wall time, including that of the run that it started from; runs may share the machine.
        validation: Scores of its last validation.
        row: Scores on all held-out pairs.
        curve: Scores of every validation, with its step.
    """

    name: str
    commit: str
    machine: str
    minutes: float
    validation: dict[str, float]
    row: ProjectionRow
    curve: list[dict[str, float]]


def finish(run: Path, pairs: Path) -> Finished:
    """Score a run that has made all its steps, and keep the result in its folder.

    Args:
        run: Folder of the run, named like its recipe.
        pairs: Cache folder of collage pairs.
    """
    trained = checkpoint.load(run / "last.pt")
    found = Finished(
        name=run.name,
        commit=trained.commit,
        machine=_describe_device(),
        minutes=60 * trained.hours,
        validation=trained.scores,
        row=score_run(trained, run.name, pairs),
        curve=read_scores(run / SCORES_FILE),
    )
    _write_lines(run / _FILE, [found])
    return found


def find_finished(runs: Path, report: Path) -> dict[str, Finished]:
    """Return the finished trainings in a report's file and in a folder of runs, by name; the latter win."""
    files = [report, *sorted(runs.glob(f"*/{_FILE}"))]
    found = [one for file in files if file.exists() for one in _read_lines(file)]
    return {one.name: one for one in found}


def keep_finished(report: Path, finished: Iterable[Finished]) -> None:
    """Write trainings to a report's file, a line of JSON each, in the order of their names."""
    _write_lines(report, sorted(finished, key=lambda one: one.name))


def _write_lines(path: Path, finished: Iterable[Finished]) -> None:
    lines = (json.dumps(asdict(one)) + "\n" for one in finished)
    with replacing(path) as temporary:
        temporary.write_text("".join(lines), encoding="utf-8")


def _read_lines(path: Path) -> list[Finished]:
    lines: list[dict[str, Any]] = [json.loads(line) for line in path.read_text("utf-8").splitlines()]
    return [Finished(**{**line, "row": ProjectionRow(**line["row"])}) for line in lines]


def _describe_device() -> str:
    if torch.cuda.is_available():
        return torch.cuda.get_device_name()
    return f"{platform.machine()} {torch.backends.cpu.get_cpu_capability()}"
