from dataclasses import replace

from experiments.trial import fingerprint
from stereoweave.learn.recipe import Recipe

RECIPE = Recipe(
    name="one",
    model="fast_depth",
    steps=10,
    batch=4,
    learning_rate=1e-3,
    warm_up_steps=0,
    cool_down_steps=0,
    start_from="runs/first/last.pt",
)


def test_the_hash_ignores_the_name_and_the_folder_of_the_runs():
    moved = replace(RECIPE, name="two", start_from="elsewhere/first/last.pt")
    assert fingerprint(moved) == fingerprint(RECIPE)
    assert fingerprint(replace(RECIPE, start_from="runs/second/last.pt")) != fingerprint(RECIPE)


def test_the_hash_counts_every_setting_that_is_not_at_its_default():
    assert fingerprint(replace(RECIPE, seed=1)) != fingerprint(RECIPE)
    assert fingerprint(replace(RECIPE, robust=0.5)) != fingerprint(RECIPE)


def test_the_hash_stays_when_recipes_get_new_settings():
    # results/propeller_networks/trainings.jsonl holds hashes made by the same rule.
    assert fingerprint(RECIPE) == "969a6612"
