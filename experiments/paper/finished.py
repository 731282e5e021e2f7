"""Scores and curves of finished trainings, which a report keeps after the folders of the runs are gone."""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from experiments.trial import fingerprint
from stereoweave.bench.projected_views import ProjectionRow
from stereoweave.errors import FormatError
from stereoweave.io.files import replacing
from stereoweave.learn import checkpoint
from stereoweave.learn.devices import choose_device, describe_device
from stereoweave.learn.evaluation import score_run
from stereoweave.learn.training.loop import SCORES_FILE, read_scores

_FILE = "finished.json"


@dataclass(frozen=True, kw_only=True)
class FinishedTraining:
    """What a report needs of a finished training, except for its weights.

    Attributes:
        name: Name of its recipe.
        fingerprint: Hash of its recipe, by which a trial finds it.
        commit: Commit of the code that trained it.
        machine: GPU or processor on which it ended and was scored.
        minutes: Wall time, including that of the run that it started from; None if unknown. Runs may share
            the machine.
        validation: Scores of its last validation.
        scores: Scores on all held-out pairs.
        curve: Scores of every validation, with its step.
    """

    name: str
    fingerprint: str
    commit: str
    machine: str
    minutes: float | None
    validation: dict[str, float]
    scores: ProjectionRow
    curve: list[dict[str, float]]


def score_training(run: Path, pairs: Path) -> FinishedTraining:
    """Score a run that has taken all its steps, and keep the result in its folder.

    Args:
        run: Folder of the run, named like its recipe.
        pairs: Cache folder of collage pairs.
    """
    trained = checkpoint.load(run / "last.pt")
    training = FinishedTraining(
        name=run.name,
        fingerprint=fingerprint(trained.recipe),
        commit=trained.commit,
        machine=describe_device(choose_device()),
        minutes=60 * trained.hours,
        validation=trained.scores,
        scores=score_run(trained, run.name, pairs),
        curve=read_scores(run / SCORES_FILE),
    )
    keep_finished(run / _FILE, [training])
    return training


def find_finished(runs: Path, report: Path) -> dict[str, FinishedTraining]:
    """Return the trainings in a report's file and in a folder of runs, by fingerprint; the latter win.

    Raises:
        FormatError: If a file is damaged.
    """
    files = [report, *sorted(runs.glob(f"*/{_FILE}"))]
    found = [training for file in files if file.exists() for training in _read(file)]
    return {training.fingerprint: training for training in found}


def keep_finished(file: Path, trainings: Iterable[FinishedTraining]) -> None:
    """Write trainings to a file, a line of JSON each, in the order of their names."""
    lines = (
        json.dumps(asdict(training)) + "\n" for training in sorted(trainings, key=lambda each: each.name)
    )
    with replacing(file) as temporary:
        temporary.write_text("".join(lines), encoding="utf-8")


def _read(file: Path) -> list[FinishedTraining]:
    try:
        lines = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
        return [FinishedTraining(**{**line, "scores": ProjectionRow(**line["scores"])}) for line in lines]
    except (ValueError, TypeError, KeyError) as error:
        raise FormatError(
            f"{file}: expected finished trainings, found unexpected contents ({error}); remove the file to "
            "train again"
        ) from error
