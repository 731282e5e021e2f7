import csv
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from learn_examples import CAMERA, RECIPE, box_before_a_wall, checkpoint_of, complaint, keep_pairs
from rich.console import Console

from experiments.ablations import experiment as ablations
from experiments.ablations.__main__ import main
from experiments.ablations.experiment import BASE, VARIATIONS, plan, run_ablations
from experiments.ablations.networks import register_variants
from experiments.trial import fingerprint
from stereoweave.data.packing import pack
from stereoweave.data.shards import write_shard
from stereoweave.learn import checkpoint
from stereoweave.learn.data.sources import VALIDATION_SEED
from stereoweave.learn.export.from_checkpoint import count_multiply_adds
from stereoweave.learn.models import build_network
from stereoweave.learn.recipe import read_recipe
from stereoweave.learn.training.objective import build_objective

REPOSITORY = Path(__file__).resolve().parents[3]
SHIPPED = REPOSITORY / "recipes/ablations/weave_small.toml"
CHOICES = [
    "correlation resolution",
    "correlation grouping",
    "distribution loss against regression",
    "sharpening at edges",
    "dilated dense blocks",
    "upsampling",
    "exponent p on the normalised disparity",
    "projection loss",
    "both of the paper's",
    "mix of data",
]
SCORES = [
    "epe_px",
    "bad1_percent",
    "bad2_percent",
    "d1_percent",
    "calibration_error",
    "edge_epe_px",
    "edge_bad1_percent",
    "flying_percent",
]
QUIET = Console(quiet=True)


@pytest.fixture
def rendered(tmp_path):
    folder = tmp_path / "rendered"
    folder.mkdir()
    sample = replace(box_before_a_wall(np.random.default_rng(0)), camera=CAMERA)
    write_shard(folder, "rooms", 0, [pack(sample, {})])
    return folder


@pytest.fixture
def runs(tmp_path):
    for seed, count in ((0, 4), (1, 4), (VALIDATION_SEED, 2)):
        keep_pairs(tmp_path / "runs" / "pairs", seed, count)
    return tmp_path / "runs"


@pytest.fixture
def trained(monkeypatch):
    """Return the names of the trained recipes; training is replaced by random weights, which is fast."""
    names = []

    def train_recipe(recipe, out, console):
        out.mkdir(parents=True, exist_ok=True)
        checkpoint.save(checkpoint_of(build_network(recipe), recipe), out / "last.pt")
        names.append(recipe.name)
        return out / "last.pt"

    monkeypatch.setattr(ablations, "train_recipe", train_recipe)
    # Counting is fast too with so small a picture.
    monkeypatch.setattr(ablations, "count_multiply_adds", partial(count_multiply_adds, height=32, width=64))
    return names


def read(report):
    with report.open(newline="") as file:
        return list(csv.DictReader(file))


def two_trials(**changes):
    return [t for t in plan(replace(RECIPE, **changes), 1) if t.setting in (BASE, "bilinear")]


def test_every_choice_has_a_variation():
    assert [choice for choice in CHOICES if not VARIATIONS.get(choice)] == []


def test_a_variation_differs_from_the_base_only_in_its_changes():
    base = asdict(read_recipe(SHIPPED))
    for trial in plan(read_recipe(SHIPPED), 2):
        ours = asdict(trial.recipe)
        different = {key: ours[key] for key in ours if ours[key] != base[key]}
        different.pop("name")
        assert different.pop("seed", 1) in (1, 2)
        assert different == VARIATIONS[trial.claim][trial.setting]


def test_every_variation_is_planned_with_the_first_seed_before_any_with_the_next():
    planned = plan(read_recipe(SHIPPED), 2)
    names = [name for variations in VARIATIONS.values() for name in variations]
    assert [(trial.recipe.seed, trial.setting) for trial in planned] == [
        (seed, name) for seed in (1, 2) for name in names
    ]
    assert len({trial.recipe.name for trial in planned}) == len(planned) == 2 * len(set(names))
    assert len({fingerprint(trial.recipe) for trial in planned}) == len(planned)


def test_only_some_variations_are_planned_beside_the_base():
    planned = plan(RECIPE, 2, ["projection", "exponent_1.5"])
    assert [(trial.recipe.seed, trial.setting) for trial in planned] == [
        (seed, name) for seed in (0, 1) for name in (BASE, "exponent_1.5", "projection")
    ]
    assert complaint(plan, RECIPE, 2, ["projection", "magic"]).endswith(", mix, found 'magic'")


def test_the_papers_two_ideas_are_trained_alone_and_together():
    found = {trial.setting: trial.recipe for trial in plan(RECIPE, 1)}
    assert {
        name: (found[name].alpha_p, found[name].exponent)
        for name in (BASE, "projection", "exponent_1.5", "projection_exponent_1.5")
    } == {
        BASE: (0, 1),
        "projection": (100, 1),
        "exponent_1.5": (0, 1.5),
        "projection_exponent_1.5": (100, 1.5),
    }


def test_every_variation_has_a_network_and_a_loss():
    register_variants()
    for recipe in {replace(trial.recipe, name="", seed=0) for trial in plan(RECIPE, 1)}:
        build_objective(recipe, build_network(recipe))


def test_each_training_is_a_row_with_the_scores_on_both_kinds_of_pairs(rendered, runs, trained, tmp_path):
    report = tmp_path / "new" / "ablations.csv"
    run_ablations(two_trials(), runs, rendered, report, QUIET)
    assert trained == ["base-seed0", "bilinear-seed0"]
    base, bilinear = read(report)
    assert (base["choice"], base["variation"], base["changes"]) == ("what all are compared with", BASE, "")
    assert (bilinear["choice"], bilinear["changes"]) == ("upsampling", "model = weave_small_bilinear")
    assert {"seed": "0", "steps": "20", "pairs_seen": "40", "hours": "0.25", "commit": "0123abc"}.items() <= (
        base.items()
    )
    assert int(base["parameters"]) > int(bilinear["parameters"])
    assert int(base["multiply_adds"]) > int(bilinear["multiply_adds"])
    columns = [f"{pairs}_{score}" for pairs in ("collage", "rendered") for score in SCORES]
    assert [name for name in base if name.startswith(("collage", "rendered"))] == columns
    for name in columns:
        assert 0 <= float(base[name]) <= 192


def test_a_training_with_a_row_is_not_repeated_and_another_recipe_is_trained(
    rendered, runs, trained, tmp_path
):
    report = tmp_path / "ablations.csv"
    run_ablations(two_trials()[:1], runs, rendered, report, QUIET)
    (first,) = read(report)
    run_ablations(two_trials(), runs, rendered, report, QUIET)
    assert trained == ["base-seed0", "bilinear-seed0"]
    assert read(report)[0] == first
    run_ablations(two_trials(steps=30), runs, rendered, report, QUIET)
    assert trained[2:] == ["base-seed0", "bilinear-seed0"]
    assert [row["steps"] for row in read(report)] == ["30", "30"]


def test_the_report_is_there_after_the_first_of_two_trainings(rendered, runs, trained, tmp_path, monkeypatch):
    report = tmp_path / "ablations.csv"
    train = ablations.train_recipe

    def killed_at_the_second(recipe, out, console):
        if trained:
            raise KeyboardInterrupt
        return train(recipe, out, console)

    monkeypatch.setattr(ablations, "train_recipe", killed_at_the_second)
    with pytest.raises(KeyboardInterrupt):
        run_ablations(two_trials(), runs, rendered, report, QUIET)
    assert [row["variation"] for row in read(report)] == [BASE]


def test_pairs_that_are_missing_are_named_before_anything_is_trained(
    rendered, runs, trained, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    report = tmp_path / "ablations.csv"
    message = complaint(run_ablations, two_trials(), runs, tmp_path / "none", report, QUIET)
    assert str(tmp_path / "none") in message
    mixed = [trial for trial in plan(RECIPE, 1) if trial.setting in (BASE, "mix")]
    message = complaint(run_ablations, mixed, runs, rendered, report, QUIET)
    assert "runs/synth/rooms" in message
    assert trained == []
    assert not report.exists()


def test_a_fingerprint_is_that_of_everything_but_the_name():
    assert fingerprint(RECIPE) == fingerprint(replace(RECIPE, name="other"))
    assert fingerprint(RECIPE) != fingerprint(replace(RECIPE, distribution=0.5))


def test_the_command_trains_what_is_planned(rendered, runs, trained, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(ablations, "VARIATIONS", {"all": {BASE: {}}})
    recipe = tmp_path / "recipe.toml"
    keys = ("model", "steps", "batch", "learning_rate", "warm_up_steps", "cool_down_steps", "pairs")
    sizes = ("pair_size", "crop_size", "validation_pairs")
    lines = [f"{key} = {value!r}" for key, value in asdict(RECIPE).items() if key in keys]
    lines += [f"{key} = {np.array(getattr(RECIPE, key)).tolist()}" for key in sizes]
    recipe.write_text("\n".join(['name = "tiny"', *lines]))
    report = tmp_path / "ablations.csv"
    words = [recipe, "-o", runs, "--report", report, "--rendered", rendered]
    assert main([str(word) for word in words]) == 0
    assert trained == ["base-seed0", "base-seed1"]
    assert str(report) in capfd.readouterr().out
    assert [row["seed"] for row in read(report)] == ["0", "1"]
