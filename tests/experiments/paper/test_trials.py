from collections import Counter
from dataclasses import asdict, replace

import pytest
from learn_examples import recipe_of

from experiments.paper.trials import (
    ADJUSTMENT,
    CLAIMS,
    DECODER,
    ITERATIONS,
    LOSS,
    NETWORKS,
    NETWORKS_SHORT,
    PAPER,
    PROJECTION,
    SCRATCH,
    TRANSFER,
    TUNED,
    Extent,
    list_trials,
)

BASE = recipe_of(
    "fast_depth",
    steps=600,
    cool_down_steps=0,
    exponent=1.5,
    alpha_p=1.0,
    seed=5,
    max_disparity_px=32.0,
)
ONCE, TWICE, THRICE = (Extent(seeds=seeds) for seeds in (1, 2, 3))
PLAIN = {"exponent": 1.0, "alpha_p": 0.0}
DENSEMAPNET = {"model": "densemapnet", **PLAIN}
DISPNET = {"model": "dispnet", **PLAIN, "loss": "l1", "learning_rate": 1e-4}
PSMNET = {"model": "psmnet", **PLAIN, "loss": "smooth_l1"}
SCVNET = {"model": "scvnet", **PLAIN, "loss": "l1"}
GANET_11 = {"model": "ganet_11", **PLAIN, "loss": "smooth_l1"}
# Collages of 96x64 with 32 px of disparity, enlarged by half.
OTHER = {"seed": 100, "pairs": 500, "pair_size": (96, 144), "max_disparity_px": 48.0}
FIRST = "fast_depth-l2-p1.5-projection1-steps600-seed5"
DIFFERENCES = {
    (PROJECTION, PAPER): {},
    (PROJECTION, "without"): {"alpha_p": 0.0},
    (NETWORKS, "fast_depth"): {},
    (NETWORKS, "densemapnet"): DENSEMAPNET,
    (NETWORKS, "dispnet"): DISPNET,
    (NETWORKS_SHORT, "fast_depth"): {"steps": 150},
    (NETWORKS_SHORT, "densemapnet"): {"steps": 150, **DENSEMAPNET},
    (NETWORKS_SHORT, "dispnet"): {"steps": 150, **DISPNET},
    (NETWORKS_SHORT, "psmnet"): {"steps": 150, **PSMNET},
    (NETWORKS_SHORT, "scvnet"): {"steps": 150, **SCVNET},
    (NETWORKS_SHORT, "ganet_11"): {"steps": 150, **GANET_11},
    (ADJUSTMENT, "p = 1"): {"exponent": 1.0},
    (ADJUSTMENT, "p = 1.25"): {"exponent": 1.25},
    (ADJUSTMENT, "p = 1.5"): {},
    (ADJUSTMENT, "p = 2"): {"exponent": 2.0},
    (ADJUSTMENT, "p = 1.37 (fitted)"): {"exponent": 1.37},
    (DECODER, PAPER): {},
    (DECODER, "step-wise, no skips"): {"model": "fast_depth_without_skips"},
    (DECODER, "upsampled at once, no skips"): {"model": "densemapnet"},
    (LOSS, "l2"): {},
    (LOSS, "l1"): {"loss": "l1"},
    (LOSS, "smooth_l1"): {"loss": "smooth_l1"},
    (LOSS, "cross_entropy"): {"loss": "cross_entropy"},
    (TRANSFER, SCRATCH): OTHER,
    (TRANSFER, TUNED): {**OTHER, "start_from": f"{FIRST}/last.pt"},
    (ITERATIONS, "10 steps"): {"steps": 10},
    (ITERATIONS, "50 steps"): {"steps": 50},
    (ITERATIONS, "250 steps"): {"steps": 250},
}
SEVERAL = {
    *((claim, setting) for claim, setting in DIFFERENCES if claim in (PROJECTION, ADJUSTMENT, DECODER, LOSS)),
    (NETWORKS, "fast_depth"),
    (NETWORKS, "densemapnet"),
}


def difference(recipe):
    """Return the keys, except the name, in which a recipe differs from the base."""
    ours, theirs = asdict(recipe), asdict(BASE)
    return {field: ours[field] for field in ours if ours[field] != theirs[field] and field != "name"}


def test_a_trial_differs_from_the_base_only_in_its_setting():
    found = {
        (trial.claim, trial.setting): difference(trial.recipe) for trial in list_trials(BASE, ONCE, 1.37)
    }
    assert found == DIFFERENCES
    assert {claim for claim, _ in found} == set(CLAIMS)


def test_what_is_compared_with_an_interval_is_trained_with_every_seed():
    planned = list_trials(BASE, THRICE, 1.37)
    counts = Counter((trial.claim, trial.setting) for trial in planned)
    assert counts == {key: 3 if key in SEVERAL else 1 for key in DIFFERENCES}
    for key in SEVERAL:
        found = [trial.recipe for trial in planned if (trial.claim, trial.setting) == key]
        assert [recipe.seed for recipe in found] == [5, 6, 7]
        assert len({replace(recipe, seed=5, name="") for recipe in found}) == 1


@pytest.mark.parametrize("fitted", [1.0, 1.37, 1.5])
def test_a_name_stands_for_one_recipe_and_a_recipe_has_one_name(fitted):
    recipes = {trial.recipe for trial in list_trials(BASE, THRICE, fitted)}
    assert len({recipe.name for recipe in recipes}) == len(recipes)
    assert len({replace(recipe, name="") for recipe in recipes}) == len(recipes)


def test_slow_networks_and_those_beside_them_take_the_steps_that_are_asked_for():
    base = replace(BASE, cool_down_steps=200)
    planned = list_trials(base, Extent(seeds=1, slow_steps=300, claims=[NETWORKS, NETWORKS_SHORT]), 1.37)
    lengths = {(trial.claim, trial.recipe.steps, trial.recipe.cool_down_steps) for trial in planned}
    assert lengths == {(NETWORKS, 600, 200), (NETWORKS_SHORT, 300, 100)}


def test_the_steps_of_figure_3_are_the_first_ones_of_the_whole_training():
    base = replace(BASE, cool_down_steps=200)
    planned = list_trials(base, Extent(seeds=1, slow_steps=250), 1.37)
    begun = [trial.recipe for trial in planned if trial.claim == ITERATIONS]
    assert [recipe.steps for recipe in begun] == [10, 50, 250]
    for recipe in begun:
        rates = [recipe.learning_rate_at(step) for step in range(recipe.steps)]
        assert rates == [base.learning_rate_at(step) for step in range(recipe.steps)]
    names = {trial.recipe: trial.recipe.name for trial in planned}
    assert len(set(names.values())) == len(names)  # 250 steps with a decay are another training


def test_the_papers_recipe_is_trained_once_for_five_claims():
    claims = [trial.claim for trial in list_trials(BASE, ONCE, 1.37) if trial.recipe.name == FIRST]
    assert claims == [PROJECTION, NETWORKS, ADJUSTMENT, DECODER, LOSS]


def test_a_base_that_fits_its_exponent_does_not_make_the_others_fit():
    assert list_trials(replace(BASE, fit_exponent=True), ONCE, 1.37) == list_trials(BASE, ONCE, 1.37)


def test_pairs_on_disk_have_all_trials_but_the_transfer():
    on_disk = list_trials(replace(BASE, dataset="paper", root="propeller", target="depth"), TWICE, 1.37)
    collages = list_trials(BASE, TWICE, 1.37)
    same = [trial.recipe.name for trial in on_disk if trial.setting != "depth in metres"]
    assert same == [trial.recipe.name for trial in collages if trial.claim != TRANSFER]
    assert {trial.recipe.target for trial in on_disk} == {"depth"}


def test_depth_in_metres_weighs_225_times_as_much_as_its_code_up_to_15_m():
    on_disk = replace(BASE, dataset="paper", root="propeller", target="depth", max_depth_m=15.0)
    found = {
        trial.setting: trial.recipe.alpha_p
        for trial in list_trials(on_disk, ONCE, 1.37)
        if trial.claim == PROJECTION
    }
    assert found == {PAPER: 1.0, "without": 0.0, "depth in metres": 1 / 225}


def test_the_perceptual_loss_waits_for_its_file():
    with_file = list_trials(replace(BASE, vgg16_weights="vgg16.npz"), ONCE, 1.37)
    losses = [trial.recipe.loss for trial in with_file if trial.claim == LOSS]
    assert losses == ["l2", "l1", "smooth_l1", "cross_entropy", "perceptual"]
