"""How many steps the trainings of `trials` take to the same validation loss, and where they end."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, median

from experiments.paper.figures import draw_validation
from experiments.paper_transfer.trials import SCRATCH, TUNED
from experiments.trial import Trial
from stereoweave.learn import checkpoint
from stereoweave.learn.training.loop import SCORES_FILE, read_scores

Curve = list[dict[str, float]]


@dataclass(frozen=True, kw_only=True)
class TransferRow:
    """One training.

    Attributes:
        scene, start, seed: The set, the weights that it started from, and the seed of order and crops.
        steps: Number of training steps.
        first_loss, last_loss: Validation loss at the first validation and at the end.
        scratch_best_step: Step of the lowest validation loss of the same scene and seed from random weights.
        reached_step: First validated step of this training whose loss is as low; NaN if there is none.
        epe_cm: End-point error of the depth at the end, on the validation pairs.
        epe_px: End-point error of the disparity at the end.
        minutes: Time of this training.
        commit: Commit of the code.
    """

    scene: str
    start: str
    seed: int
    steps: int
    first_loss: float
    last_loss: float
    scratch_best_step: float
    reached_step: float
    epe_cm: float
    epe_px: float
    minutes: float
    commit: str


@dataclass(frozen=True, kw_only=True)
class SceneSummary:
    """Medians of steps, and mean errors, over the seeds of one scene.

    Attributes:
        scene: Name of the scene.
        scratch_steps: Steps from random weights to their lowest validation loss.
        tuned_steps: Steps from the source's weights to the same loss; infinite if half of the
            trainings or more did not reach it.
        scratch_cm, tuned_cm: End-point error at the end.
    """

    scene: str
    scratch_steps: float
    tuned_steps: float
    scratch_cm: float
    tuned_cm: float


def find_reached_step(curve: Curve, loss: float) -> float:
    """Return the first step of a curve whose validation loss is at most `loss`; NaN if there is none."""
    return next((point["step"] for point in curve if point["loss"] <= loss), math.nan)


def read_rows(trials: Sequence[Trial], runs: Path) -> list[TransferRow]:
    """Return one row per training, in order."""
    curves = _read_curves(trials, runs)
    rows = []
    for trial in trials:
        kept = checkpoint.load(runs / trial.recipe.name / "last.pt")
        curve = curves[trial.claim, trial.setting, trial.recipe.seed]
        best = min(curves[trial.claim, SCRATCH, trial.recipe.seed], key=lambda point: point["loss"])
        earlier_hours = checkpoint.load(Path(trial.recipe.start_from)).hours if trial.recipe.start_from else 0
        rows.append(
            TransferRow(
                scene=trial.claim,
                start=trial.setting,
                seed=trial.recipe.seed,
                steps=kept.step,
                first_loss=curve[0]["loss"],
                last_loss=curve[-1]["loss"],
                scratch_best_step=best["step"],
                reached_step=find_reached_step(curve, best["loss"]),
                epe_cm=100 * curve[-1]["depth_error_m"],
                epe_px=curve[-1]["epe_px"],
                minutes=60 * (kept.hours - earlier_hours),
                commit=kept.commit,
            )
        )
    return rows


def summarise(rows: Sequence[TransferRow]) -> list[SceneSummary]:
    """Summarise the seeds of each scene."""
    return [
        SceneSummary(
            scene=scene,
            scratch_steps=median(_values(rows, scene, SCRATCH, "scratch_best_step")),
            tuned_steps=median(
                math.inf if math.isnan(step) else step for step in _values(rows, scene, TUNED, "reached_step")
            ),
            scratch_cm=fmean(_values(rows, scene, SCRATCH, "epe_cm")),
            tuned_cm=fmean(_values(rows, scene, TUNED, "epe_cm")),
        )
        for scene in dict.fromkeys(row.scene for row in rows)
    ]


def draw_curves(trials: Sequence[Trial], runs: Path, picture: Path) -> None:
    """Draw the squared error against steps, as means over the scenes: thin lines for seeds, bold for all."""
    curves = _read_curves(trials, runs)
    drawn: dict[str, list[list[tuple[int, float]]]] = {SCRATCH: [], TUNED: []}
    for setting, lines in drawn.items():
        for seed in dict.fromkeys(trial.recipe.seed for trial in trials):
            of_scenes = [curve for key, curve in curves.items() if key[1:] == (setting, seed)]
            points = zip(*of_scenes, strict=True)
            lines.append([(int(at[0]["step"]), fmean(one["squared_error"] for one in at)) for at in points])
    draw_validation(picture, drawn)


def _read_curves(trials: Sequence[Trial], runs: Path) -> dict[tuple[str, str, int], Curve]:
    return {
        (trial.claim, trial.setting, trial.recipe.seed): read_scores(runs / trial.recipe.name / SCORES_FILE)
        for trial in trials
    }


def _values(rows: Sequence[TransferRow], scene: str, start: str, column: str) -> list[float]:
    return [getattr(row, column) for row in rows if (row.scene, row.start) == (scene, start)]
