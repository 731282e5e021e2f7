import csv
from dataclasses import replace
from math import inf, isnan, nan

import numpy as np
import pytest
from learn_examples import CAMERA, complaint, make_batches_in_place, recipe_of
from rich.console import Console

from experiments.paper_sets.sets import read_sets
from experiments.paper_transfer.report import (
    TransferRow,
    draw_curves,
    find_reached_step,
    read_rows,
    summarise,
)
from experiments.paper_transfer.trials import (
    SCRATCH,
    TUNED,
    list_sets,
    list_trials,
    render_first_frames,
)
from stereoweave.data.paper_layout import list_complete_frames, write_frame
from stereoweave.data.samples import make_sample
from stereoweave.learn.training.loop import train_recipe
from stereoweave.stereo import StereoPair

QUIET = Console(quiet=True)
BASE = recipe_of(
    "fast_depth",
    name="base",
    dataset="paper_worlds",
    split="random",
    leave_out="disjoint",
    target="depth",
    steps=2,
    validate_every=1,
    warm_up_steps=0,
    cool_down_steps=0,
    averaged_steps=1,
    crop_size=(32, 32),
    augment=False,
    exponent=1.5,
    seed=3,
)


def write_worlds(root, rng):
    """Write two worlds of ten frames of noise before a plane."""
    for world in range(2):
        for frame in range(10):
            left, right = rng.integers(0, 256, (2, 32, 48, 3), dtype=np.uint8)
            sample = make_sample(
                StereoPair(left=left, right=right, camera=CAMERA),
                CAMERA.disparity_px(np.full((32, 48), 5 + world, np.float32)),
            )
            write_frame(root, f"ship/{world:03d}/{frame:06d}", sample)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Return the trials of one scene and their runs, tuned from a run of the same two steps."""
    folder, rng = tmp_path_factory.mktemp("transfer"), np.random.default_rng(0)
    write_worlds(folder / "worlds" / "ship", rng)
    with pytest.MonkeyPatch.context() as patch:
        make_batches_in_place(patch)
        start = train_recipe(replace(BASE, root=str(folder / "worlds" / "ship")), folder / "propeller", QUIET)
        trials = list_trials(BASE, ["ship"], folder / "worlds", start, 2)
        for trial in trials:
            train_recipe(trial.recipe, folder / "runs" / trial.recipe.name, QUIET)
    return trials, folder / "runs"


def test_seven_scenes_are_trained_without_the_propeller():
    assert [one.scene for one in read_sets()] == ["propeller", *(one.scene for one in list_sets())]


def test_each_scene_is_trained_with_and_without_the_checkpoint(tmp_path):
    start = tmp_path / "last.pt"
    start.touch()
    trials = list_trials(BASE, ["ship", "crane"], tmp_path, start, 2)
    found = [(trial.claim, trial.setting, trial.recipe.seed) for trial in trials]
    assert found == [
        (scene, setting, seed)
        for scene in ("ship", "crane")
        for setting in (SCRATCH, TUNED)
        for seed in (3, 4)
    ]
    assert len({trial.recipe.name for trial in trials}) == 8
    assert {trial.recipe.root for trial in trials} == {str(tmp_path / "ship"), str(tmp_path / "crane")}
    assert {trial.recipe.start_from for trial in trials if trial.setting == TUNED} == {str(start)}
    assert {trial.recipe.start_from for trial in trials if trial.setting == SCRATCH} == {""}


def test_a_missing_checkpoint_is_refused_before_anything_is_made(tmp_path):
    words = complaint(list_trials, BASE, ["ship"], tmp_path, tmp_path / "none.pt", 1)
    assert words == f"{tmp_path}/none.pt: expected a checkpoint of stereoweave train, found none"


def test_the_first_frames_of_each_world_are_rendered(tmp_path):
    (ship,) = (one for one in list_sets() if one.scene == "ship")
    render_first_frames(replace(ship, worlds=2), 1, (64, 48), tmp_path / "ship", 1)
    assert list_complete_frames(tmp_path / "ship") == ["ship/000/000000", "ship/001/000000"]


def test_a_step_reaches_a_loss_when_it_is_as_low():
    curve = [{"step": 10, "loss": 0.5}, {"step": 20, "loss": 0.25}, {"step": 30, "loss": 0.125}]
    assert find_reached_step(curve, 0.25) == 20
    assert find_reached_step(curve, 0.2) == 30
    assert isnan(find_reached_step(curve, 0.1))


def test_a_training_from_random_weights_reaches_its_own_lowest_loss(trained):
    trials, runs = trained
    rows = read_rows(trials, runs)
    assert [(row.start, row.seed, row.steps) for row in rows] == [
        (SCRATCH, 3, 2),
        (SCRATCH, 4, 2),
        (TUNED, 3, 2),
        (TUNED, 4, 2),
    ]
    for row in rows[:2]:
        assert row.reached_step == row.scratch_best_step
    with (runs / "ship-tuned-seed4" / "validation.csv").open() as file:
        last = list(csv.DictReader(file))[-1]
    assert rows[3].last_loss == float(last["loss"])
    assert rows[3].epe_cm == pytest.approx(100 * float(last["depth_error_m"]))
    assert rows[2].scratch_best_step == rows[0].scratch_best_step


def row(start, seed, reached, cm):
    return TransferRow(
        scene="ship", start=start, seed=seed, steps=9, first_loss=1, last_loss=0.5, scratch_best_step=8,
        reached_step=reached, epe_cm=cm, epe_px=1, minutes=1, commit="",
    )  # fmt: skip


def test_a_scene_has_median_steps_and_mean_errors():
    tuned = [row(TUNED, seed, reached, cm) for seed, reached, cm in ((0, 2, 30), (1, nan, 36), (2, 5, 30))]
    (ship,) = summarise([row(SCRATCH, 0, 8, 50), row(SCRATCH, 1, 8, 70), *tuned])
    assert (ship.scratch_steps, ship.tuned_steps, ship.scratch_cm, ship.tuned_cm) == (8, 5, 60, 32)


def test_steps_are_infinite_if_most_trainings_do_not_reach_the_loss():
    tuned = [row(TUNED, seed, reached, 30) for seed, reached in ((0, nan), (1, 4), (2, nan))]
    (ship,) = summarise([row(SCRATCH, 0, 8, 50), *tuned])
    assert ship.tuned_steps == inf


def test_the_curves_are_drawn(trained, tmp_path):
    draw_curves(*trained, tmp_path / "transfer.png")
    assert (tmp_path / "transfer.png").stat().st_size > 5000
