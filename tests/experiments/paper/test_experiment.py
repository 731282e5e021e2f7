import csv
import os
import shutil
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from learn_examples import (
    CAMERA,
    Listed,
    box_before_a_wall,
    complaint,
    keep_pairs,
    make_batches_in_place,
    recipe_of,
)
from rich.console import Console

from experiments.paper import experiment as paper
from experiments.paper import report as paper_report
from experiments.paper import trials as the_trials
from experiments.paper.experiment import plan, run_trials
from experiments.paper.finished import FinishedTraining, find_finished, keep_finished
from experiments.paper.report import FINISHED, Report, list_unfinished, write_report
from experiments.paper.trials import (
    ADJUSTMENT,
    FITTED,
    ITERATIONS,
    NETWORKS,
    PAPER,
    PROJECTION,
    TRANSFER,
    Extent,
    list_trials,
)
from experiments.trial import Trial, fingerprint
from stereoweave.bench.projected_views import ProjectionRow
from stereoweave.data.paper_layout import write_frame
from stereoweave.io.images import read_image
from stereoweave.learn import checkpoint
from stereoweave.learn.data.pair_cache import CachedPairs
from stereoweave.learn.data.sources import VALIDATION_SEED
from stereoweave.learn.training.loop import SCORES_FILE, read_scores
from stereoweave.learn.training.run import TrainingRun
from stereoweave.stereo import fit_exponent

QUIET = Console(quiet=True)
# One thread each, so that a training in this process keeps the number of threads.
JOBS = os.cpu_count() or 1
SIZE = (64, 64)
BASE = recipe_of(
    "fast_depth",
    name="base",
    steps=4,
    warm_up_steps=0,
    cool_down_steps=0,
    averaged_steps=1,
    pair_size=SIZE,
    crop_size=SIZE,
    augment=False,
    exponent=1.5,
    alpha_p=1.0,
    max_disparity_px=16.0,
)
CLAIMS = PROJECTION, NETWORKS, ADJUSTMENT, ITERATIONS
FIRST = "fast_depth-l2-p1.5-projection1-steps4-seed0"
WITHOUT = "fast_depth-l2-p1.5-projection0-steps4-seed0"
STRAIGHT = "fast_depth-l2-p1-projection1-steps4-seed0"
DENSEMAPNET = "densemapnet-l2-p1-projection0-steps4-seed0"
EARLY, LATER = (f"fast_depth-l2-p1.5-projection1-steps{steps}-seed0" for steps in (1, 2))
SECOND_POWER = "fast_depth-l2-p2-projection1-steps4-seed0"
ON_DISK = FIRST, WITHOUT, DENSEMAPNET, "psmnet-smooth_l1-p1-projection0-steps1-seed0"
TRAINED = FIRST, WITHOUT, DENSEMAPNET, STRAIGHT, EARLY, LATER
ROWS = [
    (PROJECTION, PAPER, FIRST),
    (PROJECTION, "without", WITHOUT),
    (NETWORKS, "fast_depth", FIRST),
    (NETWORKS, "densemapnet", DENSEMAPNET),
    (ADJUSTMENT, "p = 1", STRAIGHT),
    (ADJUSTMENT, "p = 1.5", FIRST),
    (ITERATIONS, "1 steps", EARLY),
    (ITERATIONS, "2 steps", LATER),
]


@dataclass(frozen=True)
class Experiment:
    """A plan of which the trials `TRAINED` are trained, and its report."""

    planned: list[Trial]
    runs: Path
    out: Path

    def last(self, name):
        return self.runs / name / "last.pt"

    def of(self, *names):
        return [trial for trial in self.planned if trial.recipe.name in names]


def train_in_place(patch):
    """Run trainings and load batches in this process, because a new one takes seconds to load PyTorch."""
    patch.setattr(paper, "run_in_workers", lambda work, tasks, *_: map(work, tasks))
    make_batches_in_place(patch)


@pytest.fixture
def in_place(monkeypatch):
    train_in_place(monkeypatch)


@pytest.fixture(scope="module")
def experiment(tmp_path_factory):
    folder = tmp_path_factory.mktemp("experiment")
    runs, out = folder / "runs", folder / "report"
    keep_pairs(runs / "pairs", VALIDATION_SEED, BASE.validation_pairs, SIZE)
    training = CachedPairs(runs / "pairs", BASE.seed, BASE.pairs, SIZE)
    training.folder.mkdir()
    for index in range(training.count):
        rng = np.random.default_rng(index)
        training.keep(index, box_before_a_wall(rng, SIZE, wall_px=12, box_px=14))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(the_trials, "FIGURE_3_STEPS", (1, 2))
        planned = plan(BASE, runs, Extent(seeds=1, claims=CLAIMS), QUIET)
        experiment = Experiment(planned, runs, out)
        run_trials(experiment.of(FIRST), runs, JOBS, QUIET, scored=True)
        train_in_place(patch)
        run_trials(experiment.of(*TRAINED[1:]), runs, JOBS, QUIET, scored=True)
    write_report(BASE, planned, runs, out)
    return experiment


def fitted_name():
    """Return the recipe name for the exponent fitted to 3/4 of the truth at 12 px and 1/4 at 14 px."""
    counts = np.zeros(256)
    counts[256 * 12 // 16], counts[256 * 14 // 16] = 3, 1
    return f"fast_depth-l2-p{fit_exponent(counts):g}-projection1-steps4-seed0"


def rows_of(experiment):
    with (experiment.out / "paper.csv").open() as file:
        return list(csv.DictReader(file))


def test_a_plan_has_the_trials_of_its_claims_and_makes_no_pair_twice(experiment):
    assert {trial.claim for trial in experiment.planned} == set(CLAIMS)
    assert len(list((experiment.runs / "pairs").iterdir())) == 2


def test_the_exponent_is_fitted_to_the_training_truth(experiment):
    (trial,) = (trial for trial in experiment.planned if trial.setting.endswith(FITTED))
    assert trial.recipe.name == fitted_name()
    assert not trial.recipe.fit_exponent


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"model": "weave_small"},
            "model: expected 'fast_depth', from which the experiment starts, found 'weave_small'",
        ),
        (
            {"target": "depth"},
            "target: expected 'disparity', from which the experiment starts, found 'depth'",
        ),
        (
            {"steps": 3},
            "steps: expected at least 4, because the slow networks train for fewer steps than the others, "
            "found 3",
        ),
    ],
)
def test_a_plan_starts_from_the_papers_network_and_of_collages_from_disparity(tmp_path, changes, words):
    assert complaint(plan, replace(BASE, **changes), tmp_path, Extent(seeds=1), QUIET) == f"base: {words}"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("extent", "words"),
    [
        (
            Extent(slow_steps=5),
            "base: steps: expected at least 5, because the slow networks train for fewer steps than the "
            "others, found 4",
        ),
        (Extent(claims=["speed"]), f"only: expected some of {', '.join(the_trials.CLAIMS)}, found 'speed'"),
    ],
)
def test_a_plan_refuses_claims_and_steps_that_it_cannot_have(tmp_path, extent, words):
    assert complaint(plan, BASE, tmp_path, extent, QUIET) == words


def test_every_trial_that_was_asked_for_is_trained_to_its_end(experiment):
    folders = {folder.name for folder in experiment.runs.iterdir()} - {"pairs"}
    assert folders == set(TRAINED)
    for trial in experiment.of(*TRAINED):
        kept = checkpoint.load(experiment.last(trial.recipe.name))
        assert (kept.recipe, kept.step) == (trial.recipe, trial.recipe.steps)


def test_a_training_has_a_row_for_each_claim_that_it_serves(experiment):
    rows = rows_of(experiment)
    assert [(row["claim"], row["setting"]) for row in rows] == [row[:2] for row in ROWS]
    for row, (_, _, name) in zip(rows, ROWS, strict=True):
        kept = checkpoint.load(experiment.last(name))
        assert (row["model"], int(row["seed"]), int(row["steps"])) == (
            kept.recipe.model,
            kept.recipe.seed,
            kept.recipe.steps,
        )
        assert float(row["exponent"]) == kept.recipe.exponent
        assert float(row["alpha_p"]) == kept.recipe.alpha_p
        assert row["crop"] == "64x64"
        # The last scores of the training, and those of the evaluation on the same pairs.
        for measure in ("prediction", "squared_error", "epe_px"):
            assert float(row[measure]) == pytest.approx(kept.scores[measure], rel=1e-4)


def test_the_tables_name_what_was_not_run(experiment):
    text = (experiment.out / "paper.md").read_text()
    not_run = text.split("## Not run\n\n")[1].split()
    names = {"dispnet-l1-p1-projection0-steps4-seed0", SECOND_POWER, fitted_name()}
    names.add("fast_depth-l2-p1.25-projection1-steps4-seed0")
    assert not_run == [word for name in sorted(names) for word in ("-", name)]
    assert "against dispnet: end-point error | " in text
    # Two each against DispNet, PSMNet, SCV-Net and GA-Net, and the decoder.
    assert text.count("| not run | | |") == 10
    assert [line for line in text.splitlines() if line.startswith("| no warping | 6.00 | ")]
    assert "## Transfer" not in text
    assert "Propeller" not in text and "EPE cm" not in text
    for claim in CLAIMS:
        assert f"## {claim.capitalize()}\n" in text


def test_every_figure_of_what_was_trained_can_be_read(experiment):
    names = {file.name for file in experiment.out.iterdir()} - {"paper.csv", "paper.md", FINISHED}
    assert names == {
        "exponent_curves.png",
        "exponent_validation.png",
        "projection_validation.png",
        "iterations.jpg",
        "views.jpg",
    }
    pictures = {name: read_image(experiment.out / name) for name in names}
    assert all(len(np.unique(picture)) > 10 for picture in pictures.values())
    # Two held-out pairs in rows; columns of one width: left, two estimates and the truth; left and right
    # image, and the views of the truth and of two networks.
    widths = [pictures[name].shape[1] for name in ("iterations.jpg", "views.jpg")]
    assert widths == [4 * 286, 5 * 286]
    assert pictures["views.jpg"].shape[0] == 2 * 286 + 39


def test_a_resumed_experiment_trains_only_what_is_missing(experiment, in_place, monkeypatch):
    steps, step = [], TrainingRun.step
    monkeypatch.setattr(
        TrainingRun, "step", lambda run, *rest: steps.append((run.recipe.name, rest[0])) or step(run, *rest)
    )
    keep = TrainingRun.save
    some = experiment.of(FIRST, WITHOUT, SECOND_POWER)
    before = {name: experiment.last(name).read_bytes() for name in TRAINED}

    class Killed(Exception):
        pass

    def kill(*arguments):
        keep(*arguments)
        raise Killed

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(TrainingRun, "save", kill)
        run_trials(some, experiment.runs, JOBS, QUIET, scored=True)
    # Killed as soon as its first checkpoint was written.
    assert steps == [(SECOND_POWER, 0), (SECOND_POWER, 1)]
    assert checkpoint.load(experiment.last(SECOND_POWER)).step == 2
    out = experiment.out.with_name("again")
    write_report(BASE, experiment.of(FIRST, SECOND_POWER), experiment.runs, out)
    assert f"## Not run\n\n- {SECOND_POWER}\n" in (out / "paper.md").read_text()

    run_trials(some, experiment.runs, JOBS, QUIET, scored=True)
    assert steps[2:] == [(SECOND_POWER, 2), (SECOND_POWER, 3)]
    assert {name: experiment.last(name).read_bytes() for name in TRAINED} == before
    recorded = read_scores(experiment.runs / SECOND_POWER / SCORES_FILE)
    assert [row["step"] for row in recorded] == [2, 4]
    write_report(BASE, experiment.of(FIRST, SECOND_POWER), experiment.runs, out)
    assert "## Not run" not in (out / "paper.md").read_text()


def test_a_training_whose_run_is_gone_is_reported_again_and_not_repeated(experiment, tmp_path):
    out, runs = tmp_path / "report", tmp_path / "runs"
    shutil.copytree(experiment.out, out)
    runs.mkdir()
    shutil.copytree(experiment.runs / "pairs", runs / "pairs")
    missing = [trial for trial in experiment.planned if trial.recipe.name not in TRAINED]
    assert list_unfinished(experiment.planned, runs, out) == missing
    before = {file.name: file.read_bytes() for file in out.iterdir()}
    write_report(BASE, experiment.planned, runs, out)
    for name in ("paper.csv", "paper.md", FINISHED, "views.jpg", "iterations.jpg"):
        assert (out / name).read_bytes() == before[name], name


def test_a_training_with_another_setting_is_not_taken_for_a_finished_one(experiment):
    slower = [
        replace(trial, recipe=replace(trial.recipe, learning_rate=1e-5)) for trial in experiment.of(FIRST)
    ]
    assert list_unfinished(experiment.of(FIRST), experiment.runs, experiment.out) == []
    assert list_unfinished(slower, experiment.runs, experiment.out) == slower


def test_a_training_is_repeated_if_another_starts_from_its_lost_checkpoint(experiment, tmp_path):
    first, tuned = experiment.of(FIRST)[0], experiment.of(WITHOUT)[0]
    there, gone = experiment.last(FIRST), tmp_path / FIRST / "last.pt"
    for start, expected in ((there, 1), (gone, 2)):
        recipe = replace(tuned.recipe, start_from=str(start), name="tuned")
        found = list_unfinished([first, replace(tuned, recipe=recipe)], experiment.runs, experiment.out)
        assert [trial.recipe.name for trial in found] == [FIRST, "tuned"][-expected:]


def test_of_a_training_in_the_report_and_in_its_run_the_run_wins(tmp_path):
    report, run = tmp_path / "trainings.jsonl", tmp_path / "runs" / "tiny"
    run.mkdir(parents=True)
    other = replace(finished_of("other", []), fingerprint="01234567")
    old, new = finished_of("tiny", []), replace(finished_of("tiny", []), minutes=None)
    keep_finished(report, [old, other])
    keep_finished(run / "finished.json", [new])
    assert find_finished(tmp_path / "runs", report) == {"89abcdef": new, "01234567": other}


def test_a_damaged_file_of_finished_trainings_is_named(tmp_path):
    report = tmp_path / "trainings.jsonl"
    for damage in ("{", '{"name": "tiny"}', "[]", '{"scores": {"epe_px": 1}}'):
        report.write_text(damage)
        message = complaint(find_finished, tmp_path, report)
        assert message.startswith(f"{report}: expected finished trainings, found unexpected contents (")


def test_what_starts_from_another_training_comes_after_it(monkeypatch, tmp_path):
    rounds = []
    monkeypatch.setattr(
        paper, "_train_all", lambda recipes, *_: rounds.append([recipe.name for recipe in recipes])
    )
    run_trials(list_trials(BASE, Extent(seeds=1), 1.37)[::-1], tmp_path, 1, QUIET)
    first, second = rounds
    assert second == ["fast_depth-l2-p1.5-projection1-steps4-seed100-tuned"]
    assert FIRST in first
    assert len(first) == len(set(first))


def test_a_tuned_trial_starts_from_a_run_below_the_folder_of_the_runs():
    tuned = next(trial for trial in list_trials(BASE, Extent(seeds=1), 1.37) if trial.recipe.start_from)
    for spelled in (Path("runs"), Path("runs/../runs")):
        start_from = paper._resolve_start(tuned, spelled).recipe.start_from
        assert start_from == str(Path.cwd() / "runs" / FIRST / "last.pt")


def finished_of(name, curve):
    """Return a training whose scores are all 0: only its curve is read."""
    scores = {field.name: 0.0 for field in fields(ProjectionRow)} | {"method": name}
    return FinishedTraining(
        name=name,
        fingerprint="89abcdef",
        commit="0123abc",
        machine="",
        minutes=0.0,
        validation={},
        scores=ProjectionRow(**scores),
        curve=curve,
    )


def report_of(trained, curves):
    return Report(
        base=BASE,
        training=Listed([]),
        held_out=Listed([]),
        planned=trained,
        trained=trained,
        missing=[],
        runs=Path("runs"),
        finished={
            fingerprint(trial.recipe): finished_of(trial.recipe.name, curves[trial.recipe.name])
            for trial in trained
        },
        rows=[],
        common=[],
    )


def transfer_of(scratch, tuned):
    """Return what the report says of two trainings with these (step, loss) curves."""
    trained = [trial for trial in list_trials(BASE, Extent(seeds=1), 1.37) if trial.claim == TRANSFER]
    curves = [[{"step": step, "loss": loss} for step, loss in curve] for curve in (scratch, tuned)]
    named = {trial.recipe.name: curve for trial, curve in zip(trained, curves, strict=True)}
    report = report_of(trained, named)
    alone = replace(report, trained=trained[:1])
    return paper_report._describe_transfer(report), paper_report._describe_transfer(alone)


def test_transfer_counts_the_steps_to_the_best_loss_from_scratch():
    scratch = [(2.0, 0.5), (4.0, 0.25), (6.0, 0.375)]
    found, alone = transfer_of(scratch, [(2.0, 0.25), (4.0, 0.125), (6.0, 0.125)])
    assert found == (
        "The best validation loss of the training from scratch is 0.25000, after 4 steps. The training from "
        "the synthetic checkpoint reaches it after 2 steps. Both used one seed, and were validated every 2 "
        "steps."
    )
    assert alone == ""
    never, _ = transfer_of(scratch, [(2.0, 0.5), (4.0, 0.5), (6.0, 0.5)])
    assert "had not reached it at its end, after 6 steps. " in never


def test_a_fitted_exponent_that_was_planned_anyway_is_named_and_drawn_once():
    planned = [trial for trial in list_trials(BASE, Extent(seeds=2), 1.5) if trial.claim == ADJUSTMENT]
    assert paper_report._describe_fit(planned) == (
        "The exponent fitted to the histogram of the training pairs' ground truth is 1.5, the same as "
        "p = 1.5: both rows show the same trainings."
    )
    assert paper_report._describe_fit(list_trials(BASE, Extent(seeds=1), 1.3742)) == (
        "The exponent fitted to the histogram of the training pairs' ground truth is 1.374."
    )
    curves = {trial.recipe.name: [{"step": 2.0, "squared_error": 0.5}] for trial in planned}
    drawn = paper_report._curves_by_setting(report_of(planned, curves), ADJUSTMENT)
    assert drawn == dict.fromkeys(("p = 1", "p = 1.25", "p = 1.5", "p = 2"), [[(2, 0.5)]] * 2)


@pytest.fixture(scope="module")
def on_disk(tmp_path_factory):
    """Return the experiment on depth, on ten pairs in the paper's layout: a wall at 6 m and a box at 2 m."""
    folder = tmp_path_factory.mktemp("propeller")
    root, runs, out = folder / "set", folder / "runs", folder / "report"
    for index in range(10):
        sample = box_before_a_wall(np.random.default_rng(index), (64, 80))
        write_frame(root, f"propeller/{index:04d}", replace(sample, camera=CAMERA))
    base = replace(
        BASE,
        dataset="paper",
        root=str(root),
        split="disjoint",
        target="depth",
        max_depth_m=8.0,
        max_disparity_px=48.0,
        validation_pairs=64,
    )
    with pytest.MonkeyPatch.context() as patch:
        train_in_place(patch)
        patch.setattr(the_trials, "FIGURE_3_STEPS", (1, 2))
        planned = plan(base, runs, Extent(seeds=1), QUIET)
        experiment = Experiment(planned, runs, out)
        run_trials(experiment.of(*ON_DISK), runs, JOBS, QUIET, scored=True)
    write_report(base, planned, runs, out)
    return experiment


def test_depth_of_pairs_on_disk_is_scored_in_cm(on_disk):
    rows = {(row["claim"], row["setting"]): row for row in rows_of(on_disk)}
    names = {trial.recipe.name for trial in on_disk.planned}
    assert {row["model"] for row in rows.values()} == {"fast_depth", "densemapnet", "psmnet"}
    assert set(ON_DISK) <= names
    for trial in on_disk.of(*ON_DISK):
        kept = checkpoint.load(on_disk.last(trial.recipe.name))
        row = rows[trial.claim, trial.setting]
        assert float(row["epe_cm"]) == pytest.approx(100 * kept.scores["depth_error_m"], rel=1e-3)
        assert float(row["epe_px"]) == pytest.approx(kept.scores["epe_px"], rel=1e-3)
        assert (row["crop"], row["seed"]) == ("64x64", "0")


def test_the_tables_of_depth_stand_beside_the_papers_propeller(on_disk):
    text = (on_disk.out / "paper.md").read_text()
    assert "9 pairs of " in text.split("## The claims")[0]
    assert "cropped to 64x64, split disjoint, target depth up to 8 m" in text
    assert "means over 1 held-out pairs" in text
    assert "Ground truth beyond 8 m is unknown" in text
    assert "transfer" not in text.lower()
    table = text.split("## Table I, Propeller\n\n")[1].split("\n\n")[0].splitlines()[2:]
    assert [line.split(" | ")[:4] for line in table] == [
        ["| DenseMapNet", "4", "1", "8.67"],
        ["| PSMNet", "1", "1", "2.38"],
        ["| the paper's network", "4", "1", "2.32"],
    ]
    # Without disparity, everything is at 8 m: three quarters of the pixels are off by 2 m, the box by 6 m.
    assert [line for line in text.splitlines() if line.startswith("| no warping | 300.0 | 6.00 | ")]
    assert [line for line in text.splitlines() if line.startswith("| ground truth | 0.0 | 0.00 | ")]
    names = {file.name for file in on_disk.out.iterdir()}
    assert names == {
        "paper.csv",
        "paper.md",
        FINISHED,
        "exponent_curves.png",
        "projection_validation.png",
    } | {
        "views.jpg",
        "exponent_validation.png",
    }


def test_run_times_beside_the_report_join_it(experiment, tmp_path):
    header = "network,parameters,multiply_adds,eager_ms,eager_relative,onnx_ms,onnx_relative\n"
    speed = tmp_path / "speed.csv"
    speed.write_text(header + "fast_depth,300,9000000000,420,1.1,90,1.25\n")
    write_report(BASE, experiment.of(EARLY), experiment.runs, tmp_path)
    text = (tmp_path / "paper.md").read_text()
    assert "| the paper's network | 300 | 9.0 | 420 | 1.10 | 90 | 1.25 | 1.05 | +0.20 |" in text
    assert "## Run time" not in (experiment.out / "paper.md").read_text()
    speed.write_text("network\nfast_depth\n")
    words = complaint(write_report, BASE, experiment.of(EARLY), experiment.runs, tmp_path)
    assert words == (
        f"{speed}: expected the rows of `python -m experiments.speed`, found rows that cannot be parsed "
        "('onnx_relative'); write the file again or remove it"
    )


def test_a_report_of_nothing_is_refused(tmp_path):
    out = tmp_path / "report"
    planned = list_trials(BASE, Extent(seeds=1), 1.37)
    names = {trial.recipe.name for trial in planned}
    assert complaint(write_report, BASE, planned, tmp_path / "runs", out) == (
        f"{tmp_path}/runs: expected at least one finished trial, found none of {len(names)}; "
        "run `python -m experiments.paper`"
    )
    assert not out.exists()


def test_the_report_states_the_differences_from_the_paper(experiment):
    text = (experiment.out / "paper.md").read_text().split("## The claims")[0]
    for words in ("averaged over about 1 steps", "to a norm of 5", torch.__version__, "± is the standard"):
        assert words in text
