"""Report of the paper's experiment: rows as CSV, tables as Markdown, and the paper's figures."""

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from rich.console import Console

from experiments.paper.claims import (
    PaperRow,
    claims_table,
    propeller_table,
    run_time_table,
    settings_table,
)
from experiments.paper.figures import draw_exponent_curves, draw_iterations, draw_validation, draw_views
from experiments.paper.finished import FinishedTraining, find_finished, keep_finished
from experiments.paper.trials import (
    ADJUSTMENT,
    FITTED,
    ITERATIONS,
    NETWORKS,
    NETWORKS_SHORT,
    OTHER_SEED,
    PROJECTION,
    SCRATCH,
    TRANSFER,
    TUNED,
)
from experiments.trial import Trial, fingerprint
from stereoweave.bench.projected_views import DisparityMethod, ProjectionRow
from stereoweave.bench.tables import write_csv
from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.files import make_folder, replacing
from stereoweave.learn import checkpoint
from stereoweave.learn.data.sources import PairSource, open_sources
from stereoweave.learn.evaluation import make_method, score_with_baselines
from stereoweave.learn.recipe import COLLAGE, Recipe
from stereoweave.learn.training.objective import count_truth

# Indices of the held-out pairs that the figures show, modulo the number of pairs.
SHOWN = (3, 11, 24)
# Finished trainings, in the report's folder.
FINISHED = "trainings.jsonl"
# Optional input in the report's folder, from `python -m experiments.speed`.
SPEED = "speed.csv"


@dataclass(frozen=True, kw_only=True)
class Report:
    """Data behind the tables and figures.

    Attributes:
        base: Recipe that the trials start from.
        training, held_out: Pairs of the base recipe.
        planned: All trials.
        trained: Trials that are fully trained.
        missing: Recipe names of the unfinished trials.
        runs: Folder of the runs, from which figures take the networks.
        finished: Finished trainings, by fingerprint; some may be none of the trials'.
        rows: One row per trained trial.
        common: Scores of untrained methods on the base's held-out pairs.
    """

    base: Recipe
    training: PairSource
    held_out: PairSource
    planned: list[Trial]
    trained: list[Trial]
    missing: list[str]
    runs: Path
    finished: dict[str, FinishedTraining]
    rows: list[PaperRow]
    common: list[ProjectionRow]

    @property
    def depth(self) -> bool:
        """Whether the target is depth, which is scored in cm."""
        return self.base.target == "depth"


def write_report(base: Recipe, planned: Sequence[Trial], runs: Path, out: Path) -> None:
    """Write trainings.jsonl, paper.csv, paper.md and the figures of the trained trials to a folder.

    A figure of networks whose run folders are gone is left as it is.

    Args:
        base: Recipe that the trials start from.
        planned: All trials; paper.md lists the unfinished ones.
        runs: Folder of the runs.
        out: Folder to write to. If it contains trainings.jsonl, the trainings there count as finished; if it
            contains speed.csv, paper.md includes these run times.

    Raises:
        StereoweaveError: If no trial is finished.
        FormatError: If speed.csv is damaged.
    """
    run_time = _read_run_times(out / SPEED)
    report = _gather(base, planned, runs, out)
    make_folder(out)
    keep_finished(out / FINISHED, report.finished.values())
    write_csv(out / "paper.csv", report.rows, machine={})
    with replacing(out / "paper.md") as temporary:
        temporary.write_text(_format_report(report, run_time), encoding="utf-8")
    _draw(report, out)


def list_unfinished(planned: Sequence[Trial], runs: Path, out: Path) -> list[Trial]:
    """Return the trials to train: those that neither the runs nor the report's folder holds as finished.

    A finished trial is trained again if an unfinished one starts from it, and its checkpoint is gone.
    """
    finished = find_finished(runs, out / FINISHED)
    missing = [trial for trial in planned if fingerprint(trial.recipe) not in finished]
    starts = {
        Path(trial.recipe.start_from).parent.name
        for trial in missing
        if trial.recipe.start_from and not Path(trial.recipe.start_from).exists()
    }
    return [trial for trial in planned if trial in missing or trial.recipe.name in starts]


def _gather(base: Recipe, planned: Sequence[Trial], runs: Path, out: Path) -> Report:
    finished = find_finished(runs, out / FINISHED)
    trained = [trial for trial in planned if fingerprint(trial.recipe) in finished]
    missing = {trial.recipe.name for trial in planned} - {trial.recipe.name for trial in trained}
    if not trained:
        raise StereoweaveError(
            f"{runs}: expected at least one finished trial, found none of {len(missing)}; "
            "run `python -m experiments.paper`"
        )
    training, held_out = open_sources(base, runs / "pairs", whole=True)
    return Report(
        base=base,
        training=training,
        held_out=held_out,
        planned=list(planned),
        trained=trained,
        missing=sorted(missing),
        runs=runs,
        finished=finished,
        rows=[_make_row(trial, finished[fingerprint(trial.recipe)]) for trial in trained],
        common=score_with_baselines(base, {}, runs / "pairs", Console(quiet=True)),
    )


def _make_row(trial: Trial, finished: FinishedTraining) -> PaperRow:
    recipe, score = trial.recipe, finished.scores
    return PaperRow(
        claim=trial.claim,
        setting=trial.setting,
        seed=recipe.seed,
        model=recipe.model,
        loss=recipe.loss,
        exponent=recipe.exponent,
        alpha_p=recipe.alpha_p,
        steps=recipe.steps,
        batch=recipe.batch,
        crop=f"{recipe.crop_size[1]}x{recipe.crop_size[0]}",
        prediction=finished.validation["prediction"],
        squared_error=finished.validation["squared_error"],
        epe_px=score.epe_px,
        epe_cm=score.epe_cm,
        mae_sourced=score.mae_sourced,
        sourced_percent=score.sourced_percent,
        mae_filled=score.mae_filled,
        psnr_db=score.psnr_db,
        ssim=score.ssim,
        minutes=math.nan if finished.minutes is None else finished.minutes,
        commit=finished.commit,
        machine=finished.machine,
    )


def _format_report(report: Report, run_time: str) -> str:
    """Return the whole report: setup, tables, and trials that were not run."""
    parts = [
        "# The paper's experiment: results",
        *_describe_setup(report),
        "## The claims",
        claims_table(report.rows, report.depth),
    ]
    if report.depth and any(row.claim in (NETWORKS, NETWORKS_SHORT) for row in report.rows):
        parts += ["## Table I, Propeller", propeller_table(report.rows)]
    for claim in dict.fromkeys(row.claim for row in report.rows):
        parts += [f"## {claim.capitalize()}", settings_table(report.rows, claim, report.depth)]
        if claim == ADJUSTMENT and (fitted := _describe_fit(report.planned)):
            parts.append(fitted)
    parts += ["## Methods without training", _format_common_table(report.common, report.depth)]
    if reached := _describe_transfer(report):
        parts += ["## Transfer: steps to the same validation loss", reached]
    if run_time:
        parts += ["## Run time", run_time]
    if report.missing:
        parts += ["## Not run", "\n".join(f"- {name}" for name in report.missing)]
    return "\n\n".join(parts) + "\n"


def _describe_setup(report: Report) -> list[str]:
    """Describe the settings of all training runs, deviations from the paper, and how to read the tables."""
    base = report.base
    transfer_seed = f" (the transfer: seed {OTHER_SEED})" if base.dataset == COLLAGE else ""
    unknown = (
        f" Ground truth beyond {base.max_depth_m:g} m is unknown; the row ground truth does not project it."
        if report.depth
        else ""
    )
    return [
        f"Written by `python -m experiments.paper`. Training: {_describe_pairs(report)}, batch {base.batch}, "
        f"{base.steps} steps unless a table states another number, Adam at a learning rate of "
        f"{base.learning_rate:g}. Scores are means over {report.held_out.count} held-out pairs. The right "
        "view is the left image projected with the estimated disparity. MAE is its mean absolute error, 0 to "
        "255, after pixels without a source are filled along their rows. MAE of sourced is the error over "
        f"the pixels that have a source, and sourced % is their share.{unknown}",
        "Differences from the paper: the scores are those of weights averaged over about "
        f"{base.averaged_steps} steps, gradients are clipped to a norm of 5, the precision is bf16-mixed "
        "where the processor supports it and float32 elsewhere, and the framework is PyTorch "
        f"{torch.__version__}. The rivals train with the losses of their own papers (DispNet also with its "
        "learning rate), without this paper's depth adjustment and projection loss.",
        "± is the standard deviation over the seeds. Rows with one seed used seed "
        f"{base.seed}{transfer_seed}. They come after the means over several seeds and are not ranked "
        "against them.",
    ]


def _describe_pairs(report: Report) -> str:
    """Describe the training pairs."""
    base = report.base
    size = f"{base.crop_size[1]}x{base.crop_size[0]}"
    if base.dataset == COLLAGE:
        return f"{base.pairs} collage pairs of {size} per seed"
    target = f"depth up to {base.max_depth_m:g} m" if report.depth else "disparity"
    return (
        f"{report.training.count} pairs of {base.root}, the same for every seed, cropped to {size}, "
        f"split {base.split}, target {target}"
    )


def _describe_fit(planned: Sequence[Trial]) -> str:
    """Describe the fitted exponent, and name the planned exponent that it equals, if any."""
    settings = {trial.setting: trial.recipe for trial in reversed(planned) if trial.claim == ADJUSTMENT}
    for setting, recipe in settings.items():
        if setting.endswith(FITTED):
            same = [name for name in settings if name != setting and settings[name].name == recipe.name]
            also = f", the same as {same[0]}: both rows show the same trainings" if same else ""
            return (
                "The exponent fitted to the histogram of the training pairs' ground truth is "
                f"{recipe.exponent:.4g}{also}."
            )
    return ""


def _read_run_times(path: Path) -> str:
    """Return a Markdown table of the run times in a file; an empty string if there is no file."""
    if not path.exists():
        return ""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            table = run_time_table(csv.DictReader(file))
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"{path}: expected the rows of `python -m experiments.speed`, found rows that cannot be "
            f"parsed ({error}); write the file again or remove it"
        ) from error
    return f"One pair of 640x480 on all cores of a CPU; the paper's times are from GPUs.\n\n{table}"


def _format_common_table(rows: Sequence[ProjectionRow], depth: bool) -> str:
    columns = ["method", *(["EPE cm"] if depth else []), "EPE px", "MAE", "MAE of sourced", "sourced %"]
    lines = [f"| {' | '.join((*columns, 'PSNR dB', 'SSIM'))} |", "|---" * (len(columns) + 2) + "|"]
    for row in rows:
        in_cm = f" {row.epe_cm:.1f} |" if depth else ""
        lines.append(
            f"| {row.method} |{in_cm} {row.epe_px:.2f} | {row.mae_filled:.2f} | {row.mae_sourced:.2f} "
            f"| {row.sourced_percent:.1f} | {row.psnr_db:.2f} | {row.ssim:.3f} |"
        )
    return "\n".join(lines)


def _describe_transfer(report: Report) -> str:
    """Describe how many steps the tuned network takes to reach the best loss of training from scratch."""
    curves = {
        trial.setting: report.finished[fingerprint(trial.recipe)].curve
        for trial in report.trained
        if trial.claim == TRANSFER
    }
    if len(curves) < 2:
        return ""
    best = min(curves[SCRATCH], key=lambda point: point["loss"])
    reached = [point["step"] for point in curves[TUNED] if point["loss"] <= best["loss"]]
    tuned = (
        f"reaches it after {reached[0]:.0f} steps"
        if reached
        else f"had not reached it at its end, after {curves[TUNED][-1]['step']:.0f} steps"
    )
    return (
        f"The best validation loss of the training {SCRATCH} is {best['loss']:.5f}, after {best['step']:.0f} "
        f"steps. The training {TUNED} {tuned}. Both used one seed, and were validated every "
        f"{report.base.validate_every} steps."
    )


def _draw(report: Report, out: Path) -> None:
    """Draw Figs. 2, 3 and 5, and Fig. 2 for the projection loss, for claims that have finished trials."""
    held_out = report.held_out
    claims = {row.claim for row in report.rows}
    if ADJUSTMENT in claims:
        exponents = {row.exponent for row in report.rows if row.claim == ADJUSTMENT}
        histogram = count_truth(report.base, report.training)
        draw_exponent_curves(out / "exponent_curves.png", sorted(exponents), histogram)
    for claim, name in ((ADJUSTMENT, "exponent"), (PROJECTION, "projection")):
        if claim in claims:
            curves = dict(sorted(_curves_by_setting(report, claim).items()))
            draw_validation(out / f"{name}_validation.png", curves)
    samples = [held_out[index] for index in dict.fromkeys(shown % held_out.count for shown in SHOWN)]
    for claim, draw, name in ((ITERATIONS, draw_iterations, "iterations"), (NETWORKS, draw_views, "views")):
        if methods := _load_first_seeds(report, claim):
            estimates = [{setting: match(sample) for setting, match in methods.items()} for sample in samples]
            draw(out / f"{name}.jpg", list(zip(samples, estimates, strict=True)))


def _load_first_seeds(report: Report, claim: str) -> dict[str, DisparityMethod]:
    """Load the first seed's network for each setting; none unless the runs of all are there."""
    names = {t.setting: t.recipe.name for t in reversed(report.trained) if t.claim == claim}
    files = {setting: report.runs / name / "last.pt" for setting, name in reversed(names.items())}
    if not all(file.exists() for file in files.values()):
        return {}
    return {setting: make_method(checkpoint.load(file)) for setting, file in files.items()}


def _curves_by_setting(report: Report, claim: str) -> dict[str, list[list[tuple[int, float]]]]:
    """Return curves of (step, squared error) for each setting, one per seed; each recipe counts once."""
    # Reversed, so that the first trial of a name is kept.
    once = {trial.recipe.name: trial for trial in reversed(report.trained) if trial.claim == claim}
    found: dict[str, list[list[tuple[int, float]]]] = {}
    for trial in reversed(once.values()):
        curve = [
            (int(point["step"]), point["squared_error"])
            for point in report.finished[fingerprint(trial.recipe)].curve
        ]
        found.setdefault(trial.setting, []).append(curve)
    return found
