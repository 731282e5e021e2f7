import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from learn_examples import RECIPE

from stereoweave.errors import FormatError
from stereoweave.learn.models import build_network
from stereoweave.learn.recipe import Recipe, parse_recipe, read_recipe

RECIPES = sorted((Path(__file__).parents[2] / "recipes").rglob("*.toml"))
NEEDED = {
    "name": "x",
    "model": "weave_small",
    "steps": 10,
    "batch": 4,
    "learning_rate": 1.0,
    "warm_up_steps": 4,
    "cool_down_steps": 2,
}
COUNT = "expected a whole number of at least 1 that fits in 64 bits"
TABLE = "expected a table of sets with weights above 0"


@pytest.mark.parametrize("file", RECIPES, ids=lambda file: file.name)
def test_every_shipped_recipe_parses(file):
    assert read_recipe(file).steps > 0


def test_there_are_shipped_recipes():
    assert RECIPES


def test_a_recipe_is_read_with_its_defaults(tmp_path):
    file = tmp_path / "x.toml"
    file.write_text(
        'name = "x"\nmodel = "weave_small"\nsteps = 10\nbatch = 4\nlearning_rate = 1\nwarm_up_steps = 4\n'
        "cool_down_steps = 2\ncrop_size = [64, 96]\n"
    )
    assert read_recipe(file) == Recipe(**NEEDED, crop_size=(64, 96))


def test_a_recipe_survives_being_a_dictionary():
    assert parse_recipe(asdict(RECIPE), "here") == RECIPE


def test_a_mix_is_a_table_of_sets_and_weights_and_survives_being_a_dictionary(tmp_path):
    file = tmp_path / "x.toml"
    lines = [f"{name} = {value!r}" for name, value in NEEDED.items()]
    file.write_text("\n".join([*lines, "[mix]", "collage = 0.5", '"runs/synth/rooms" = 2']))
    recipe = read_recipe(file)
    assert recipe == Recipe(**NEEDED, mix=(("collage", 0.5), ("runs/synth/rooms", 2)))
    assert hash(recipe) != hash(Recipe(**NEEDED))
    assert parse_recipe(asdict(recipe), "here") == recipe
    # As it is stored in a checkpoint's card.
    assert parse_recipe(json.loads(json.dumps(asdict(recipe))), "here") == recipe


def test_the_pair_size_does_not_limit_the_crops_of_a_dataset_on_disk():
    recipe = parse_recipe(
        NEEDED | {"dataset": "sintel", "root": "datasets/sintel", "crop_size": [384, 1024]}, "here"
    )
    assert recipe.crop_size == (384, 1024)


def test_table_1_has_a_recipe_for_each_of_its_cells():
    recipes = {file.stem: read_recipe(file) for file in RECIPES if file.parent.name == "paper"}
    cells = {
        f"{dataset}_{model}": (dataset.replace("propeller", "paper"), model)
        for dataset in ("sintel", "driving", "monkaa", "propeller")
        for model in ("dispnet", "densemapnet", "psmnet", "scvnet", "ganet_11", "fast_depth")
    }
    assert cells.keys() <= recipes.keys()
    for name, cell in cells.items():
        recipe = recipes[name]
        assert recipe.name == name
        assert (recipe.dataset, recipe.model) == cell
        assert recipe.target == ("depth" if recipe.dataset == "paper" else "disparity")
        # As in the paper: Adam and batches of 4 pairs.
        assert (recipe.batch, recipe.weight_decay, recipe.averaged_steps) == (4, 0.0, 1)
        # Only the paper's own network uses its two contributions and the transfer.
        own = (1.5, 1.0, "checkpoints/fast_depth.pt") if recipe.model == "fast_depth" else (1.0, 0.0, "")
        assert (recipe.exponent, recipe.alpha_p, recipe.start_from) == own


@pytest.mark.parametrize("file", RECIPES, ids=lambda file: file.stem)
def test_the_crops_of_a_shipped_recipe_fit_its_network(file):
    recipe = read_recipe(file)
    with torch.device("meta"):
        multiple = build_network(recipe).multiple_of
    assert [side % multiple for side in recipe.crop_size] == [0, 0]


def test_every_rival_can_be_trained_on_the_crops_of_the_experiment_on_propellers():
    (base,) = (read_recipe(file) for file in RECIPES if file.stem == "propeller")
    for model in ("dispnet", "densemapnet", "psmnet", "scvnet", "ganet_11", "fast_depth"):
        with torch.device("meta"):
            multiple = build_network(replace(base, model=model)).multiple_of
        assert [side % multiple for side in base.crop_size] == [0, 0]


def test_the_learning_rate_rises_stays_and_falls():
    recipe = Recipe(**NEEDED)
    rates = [recipe.learning_rate_at(step) for step in range(10)]
    assert rates == [0.25, 0.5, 0.75, 1, 1, 1, 1, 1, 1, 0.5]


def test_the_learning_rate_without_warm_up_and_cool_down_is_constant():
    recipe = Recipe(**NEEDED | {"warm_up_steps": 0, "cool_down_steps": 0})
    assert {recipe.learning_rate_at(step) for step in range(10)} == {1.0}


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("a = " + "[" * 3000, "maximum recursion depth"),
        (f"steps = {'9' * 5000}", "integer string conversion"),
        (
            f"steps = 0x{'f' * 5000}",
            "steps: expected a whole number .*, found a value too long to show",
        ),
        ("a" + ".a" * 50_000 + " = 1", "more than 10000 characters"),
    ],
)
def test_a_malicious_recipe_is_refused_at_once(tmp_path, text, found):
    file = tmp_path / "hostile.toml"
    file.write_text(text)
    with pytest.raises(FormatError, match=f"hostile.toml: .*{found}"):
        read_recipe(file)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stepz": 3}, "unknown key 'stepz'; a recipe has name, model, seed, "),
        ({"steps": "many"}, f"steps: {COUNT}, found 'many'"),
        ({"steps": 1.5}, f"steps: {COUNT}, found 1.5"),
        ({"steps": True}, f"steps: {COUNT}, found True"),
        ({"steps": 2**63}, f"steps: {COUNT}, found 9223372036854775808"),
        ({"learning_rate": 10**400}, f"learning_rate: expected a number above 0, found 1{'0' * 99}..."),
        ({"learning_rate": "high"}, "learning_rate: expected a number above 0, found 'high'"),
        ({"learning_rate": False}, "learning_rate: expected a number above 0, found False"),
        ({"name": 3}, "name: expected text in quotes, found 3"),
        ({"crop_size": 256}, "crop_size: expected two whole numbers of at least 1, found 256"),
        ({"crop_size": [256]}, "crop_size: expected two whole numbers of at least 1, found [256]"),
        ({"crop_size": [256, 1.5]}, "crop_size: expected two whole numbers of at least 1, found [256, 1.5]"),
        ({"crop_size": [0, 64]}, "crop_size: expected two whole numbers of at least 1, found [0, 64]"),
        ({"crop_size": [64, 528]}, "crop_size: expected at most pair_size = [320, 512], found [64, 528]"),
        ({"batch": 0}, f"batch: {COUNT}, found 0"),
        ({"steps": -1}, f"steps: {COUNT}, found -1"),
        ({"pairs": 0}, f"pairs: {COUNT}, found 0"),
        ({"validation_pairs": 0}, f"validation_pairs: {COUNT}, found 0"),
        ({"validate_every": 0}, f"validate_every: {COUNT}, found 0"),
        ({"averaged_steps": 0}, f"averaged_steps: {COUNT}, found 0"),
        ({"seed": 2**63}, "seed: expected a whole number that fits in 64 bits, found 9223372036854775808"),
        (
            {"micro_batch": -1},
            "micro_batch: expected a whole number of at least 0 that fits in 64 bits, found",
        ),
        ({"max_disparity_px": 0.0}, "max_disparity_px: expected a number above 0, found 0.0"),
        ({"max_disparity_px": float("inf")}, "max_disparity_px: expected a number above 0, found inf"),
        ({"max_depth_m": 0.0}, "max_depth_m: expected a number above 0, found 0.0"),
        ({"fit_exponent": "yes"}, "fit_exponent: expected true or false, found 'yes'"),
        ({"loss": 2}, "loss: expected text in quotes, found 2"),
        ({"exponent": float("nan")}, "exponent: expected a number of at least 1, found nan"),
        ({"alpha_z": float("inf")}, "alpha_z: expected a number of at least 0, found inf"),
        ({"augment": 1}, "augment: expected true or false, found 1"),
        ({"exponent": 0.5}, "exponent: expected a number of at least 1, found 0.5"),
        ({"exponent": float("inf")}, "exponent: expected a number of at least 1, found inf"),
        ({"alpha_z": -1.0}, "alpha_z: expected a number of at least 0, found -1.0"),
        ({"alpha_p": -0.1}, "alpha_p: expected a number of at least 0, found -0.1"),
        ({"weight_decay": -0.1}, "weight_decay: expected a number of at least 0, found -0.1"),
        ({"target": "height"}, "target: expected 'disparity' or 'depth', found 'height'"),
        ({"dataset": "sintel"}, "root: expected the dataset's folder, found '' with dataset = 'sintel'"),
        ({"root": "sintel"}, "root: expected no folder, found 'sintel' with dataset = 'collage'"),
        ({"leave_out": "disjoint"}, "leave_out: expected none for collages, found 'disjoint'"),
        (
            {"leave_out": "random", "dataset": "sintel", "root": "sintel"},
            "leave_out: expected a split other than split = 'random', found 'random'",
        ),
        ({"mix": "collage"}, f"mix: {TABLE}, such as collage = 0.5, found 'collage'"),
        ({"mix": {"collage": "half"}}, f"mix: {TABLE}, such as collage = 0.5, found {{'collage': 'half'}}"),
        ({"mix": [["collage", 1, 2]]}, f"mix: {TABLE}, such as collage = 0.5, found [['collage', 1, 2]]"),
        ({"mix": {"collage": 1.0, "rooms": 0}}, f"mix: {TABLE}, such as collage = 0.5, found {{'collage': "),
        (
            {"mix": {"collage": float("nan")}},
            f"mix: {TABLE}, such as collage = 0.5, found {{'collage': nan}}",
        ),
        (
            {"mix": {"collage": 1.0}, "dataset": "sintel", "root": "sintel"},
            "mix: expected dataset = 'collage' to validate the mix on, found 'sintel'",
        ),
        ({"learning_rate": float("nan")}, "learning_rate: expected a number above 0, found nan"),
        ({"offset_share": 1.5}, "offset_share: expected a number from 0 to 1, found 1.5"),
        ({"robust": -0.1}, "robust: expected a number from 0 to 1, found -0.1"),
        ({"fresh": 1}, "fresh: expected true or false, found 1"),
        ({"held_out": {"rooms": 1}}, "held_out: expected a table of names and folders, such as rooms"),
    ],
)
def test_an_error_names_a_wrong_key_or_value_in_one_line(changes, message):
    with pytest.raises(FormatError) as caught:
        parse_recipe(NEEDED | changes, "my.toml")
    assert str(caught.value).startswith(f"my.toml: {message}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("missing", NEEDED)
def test_an_error_names_a_missing_key_in_one_line(missing):
    values = {name: value for name, value in NEEDED.items() if name != missing}
    with pytest.raises(FormatError) as caught:
        parse_recipe(values, "my.toml")
    assert str(caught.value) == f"my.toml: missing key '{missing}'; a recipe needs {', '.join(NEEDED)}"


@pytest.mark.parametrize(
    "content",
    [
        b"steps = ",
        b"\xff\xfe\x00",
        b"[table",
        b"steps = " + b"9" * 5000,
        b"steps = " + b"[" * 60_000,
        b"steps = " + b"{a = " * 20_000,
    ],
)
def test_an_error_names_a_file_that_is_not_toml_in_one_line(tmp_path, content):
    file = tmp_path / "bad.toml"
    file.write_bytes(content)
    with pytest.raises(FormatError) as caught:
        read_recipe(file)
    assert str(caught.value).startswith(f"{file}: expected a recipe in TOML, found one that ")
    assert "\n" not in str(caught.value)


def test_an_endless_recipe_is_refused():
    with pytest.raises(FormatError, match="/dev/zero: expected a regular file, found a pipe or a device"):
        read_recipe(Path("/dev/zero"))


def test_an_error_names_a_missing_file(tmp_path):
    with pytest.raises(FormatError, match=r"nowhere\.toml: expected a recipe in TOML, found no such file"):
        read_recipe(tmp_path / "nowhere.toml")


def test_a_step_has_one_micro_batch_unless_the_recipe_says_otherwise():
    assert parse_recipe(NEEDED, "here").micro_batches == 1
    assert parse_recipe(NEEDED | {"micro_batch": 4}, "here").micro_batches == 1
    assert parse_recipe(NEEDED | {"micro_batch": 1}, "here").micro_batches == 4


@pytest.mark.parametrize(
    ("micro_batch", "expected"), [(3, "a divisor of batch = 4"), (8, "a divisor"), (-1, "a .* at least 0")]
)
def test_micro_batches_that_do_not_divide_the_batch_are_refused(micro_batch, expected):
    with pytest.raises(FormatError, match=f"here: micro_batch: expected {expected}.*, found {micro_batch}"):
        parse_recipe(NEEDED | {"micro_batch": micro_batch}, "here")
