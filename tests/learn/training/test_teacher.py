import math
from dataclasses import replace

import pytest
import torch
from learn_examples import RECIPE, checkpoint_of, complaint, keep_pairs, recipe_of, untrained, write
from rich.console import Console

from stereoweave.learn import checkpoint
from stereoweave.learn.data.sources import VALIDATION_SEED
from stereoweave.learn.models.weave import WeaveNet
from stereoweave.learn.training.loop import train
from stereoweave.learn.training.losses import regression_loss
from stereoweave.learn.training.objective import build_objective
from stereoweave.learn.training.teacher import Lesson, Teacher, distillation_losses


def batch():
    torch.manual_seed(1)
    left, right = torch.rand(2, 1, 3, 64, 96)
    return {
        "left": left,
        "right": right,
        "disparity_px": torch.full((2, 1, 64, 96), 5.0),
        "occluded": torch.zeros(2, 1, 64, 96, dtype=torch.bool),
    }


def write_teacher(folder, name="weave_base"):
    path = folder / "teacher.pt"
    checkpoint.save(checkpoint_of(untrained(name), recipe_of(name)), path)
    return path


def test_the_lesson_is_what_the_teacher_estimates(tmp_path):
    views = batch()["left"], batch()["right"]
    lesson = Teacher(write_teacher(tmp_path)).teach(*views)
    expected = untrained("weave_base").stages(*views)
    assert torch.equal(lesson.disparity_px, expected.disparity_px)
    torch.testing.assert_close(lesson.probabilities, expected.scores.softmax(1))
    assert not lesson.probabilities.requires_grad


def test_the_losses_are_the_cross_entropy_of_the_levels_and_the_error_of_the_disparity():
    stages = untrained().stages(batch()["left"], batch()["right"])
    even = replace(stages, scores=torch.zeros(2, 48, 16, 24))
    probabilities = torch.zeros(2, 48, 16, 24)
    probabilities[:, 0], probabilities[:, 7] = 0.7, 0.3
    lesson = Lesson(probabilities, stages.disparity_px.detach() + 3)
    terms = distillation_losses(even, lesson, regression_loss)
    # All 48 levels are equally likely, and an error of 3 px is 2.75 in the regression loss.
    assert terms["taught_scores"].item() == pytest.approx(math.log(48))
    assert terms["taught_disparity"].item() == pytest.approx(2.75, abs=1e-5)


def test_a_recipe_with_a_teacher_adds_its_weighted_losses(tmp_path):
    network, path = untrained(), str(write_teacher(tmp_path))
    plain = build_objective(RECIPE, network)
    taught = build_objective(replace(RECIPE, teacher=path, taught=0.25), network)
    found = taught.losses(taught.predict(network, batch()), batch())
    alone = plain.losses(plain.predict(network, batch()), batch())
    assert {name: found[name] for name in alone} == alone
    predicted = taught.predict(network, batch())
    expected = distillation_losses(predicted.stages, predicted.lesson, regression_loss)
    assert {name: found[name] / 0.25 for name in expected} == expected


def test_a_network_that_is_its_own_teacher_has_no_error(tmp_path):
    network = untrained()
    objective = build_objective(replace(RECIPE, teacher=str(write_teacher(tmp_path, "weave_small"))), network)
    terms = objective.losses(objective.predict(network, batch()), batch())
    assert terms["taught_disparity"] == 0


def test_a_teacher_of_another_kind_or_with_other_levels_is_named(tmp_path):
    path = str(write_teacher(tmp_path, "fast_depth"))
    message = complaint(build_objective, replace(RECIPE, teacher=path), untrained())
    assert message == f"{path}: expected a WeaveNet as teacher, found fast_depth"
    path = str(write_teacher(tmp_path))
    message = complaint(build_objective, replace(RECIPE, teacher=path), WeaveNet(levels=24))
    found = f"found 48 levels to 192 px in {path}"
    assert message == f"tiny: teacher: expected 24 levels to 96 px as in weave_small, {found}"
    recipe = recipe_of("weave_half", teacher=path)
    message = complaint(build_objective, recipe, untrained("weave_half"))
    assert message == f"tiny: teacher: expected 48 levels to 256 px as in weave_half, {found}"


def test_crops_must_fit_the_teacher(tmp_path):
    path = str(write_teacher(tmp_path, "weave_base_grown"))
    recipe = replace(RECIPE, teacher=path, crop_size=(48, 64))
    message = complaint(build_objective, recipe, untrained())
    assert message == f"tiny: crop_size: expected multiples of 32 for {path}, found [48, 64]"


@pytest.mark.parametrize(("setting", "value"), [("teacher", "teacher.pt"), ("steadiness", 0.5)])
def test_a_loss_of_weavenet_alone_is_refused_for_other_networks(setting, value):
    message = complaint(build_objective, recipe_of("fast_depth", **{setting: value}), untrained("fast_depth"))
    assert message.startswith(f"tiny: {setting}: expected none for model = 'fast_depth', found {value!r}")


def test_a_network_is_trained_with_a_teacher(tmp_path):
    for seed, count in ((RECIPE.seed, RECIPE.pairs), (VALIDATION_SEED, RECIPE.validation_pairs)):
        keep_pairs(tmp_path / "pairs", seed, count)
    recipe = replace(RECIPE, name="taught", steps=2, teacher=str(write_teacher(tmp_path)))
    last = train(write(recipe, tmp_path / "taught.toml"), tmp_path / "taught", Console(quiet=True))
    assert checkpoint.load(last).step == 2
