import json
from dataclasses import asdict
from pathlib import Path

import pytest
from learn_examples import RECIPE

from stereoweave.errors import FormatError
from stereoweave.learn.recipe import Recipe, read_recipe, recipe_from

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
    assert recipe_from(asdict(RECIPE), "here") == RECIPE


def test_a_mix_is_a_table_of_sets_and_weights_and_survives_being_a_dictionary(tmp_path):
    file = tmp_path / "x.toml"
    lines = [f"{name} = {value!r}" for name, value in NEEDED.items()]
    file.write_text("\n".join([*lines, "[mix]", "collage = 0.5", '"runs/synth/rooms" = 2']))
    recipe = read_recipe(file)
    assert recipe == Recipe(**NEEDED, mix=(("collage", 0.5), ("runs/synth/rooms", 2)))
    assert hash(recipe) != hash(Recipe(**NEEDED))
    assert recipe_from(asdict(recipe), "here") == recipe
    # As a checkpoint's card keeps it.
    assert recipe_from(json.loads(json.dumps(asdict(recipe))), "here") == recipe


def test_a_recipe_for_a_dataset_on_disk_is_bound_by_no_pair_size():
    recipe = recipe_from(
        NEEDED | {"dataset": "sintel", "root": "datasets/sintel", "crop_size": [384, 1024]}, "here"
    )
    assert recipe.crop_size == (384, 1024)


def test_table_1_has_a_recipe_for_each_of_its_cells():
    recipes = {file.stem: read_recipe(file) for file in RECIPES if file.parent.name == "paper"}
    cells = {
        f"{dataset}_{model}": (dataset.replace("propeller", "paper"), model)
        for dataset in ("sintel", "driving", "monkaa", "propeller")
        for model in ("dispnet", "densemapnet", "psmnet", "fast_depth")
    }
    assert cells.keys() <= recipes.keys()
    for name, cell in cells.items():
        recipe = recipes[name]
        assert recipe.name == name
        assert (recipe.dataset, recipe.model) == cell
        assert recipe.target == ("depth" if recipe.dataset == "paper" else "disparity")
        # The paper's: Adam and batches of 4 pairs.
        assert (recipe.batch, recipe.weight_decay, recipe.averaged_steps) == (4, 0.0, 1)
        # Its own two contributions, and the transfer, are for its own network alone.
        own = (1.5, 1.0, "checkpoints/fast_depth.pt") if recipe.model == "fast_depth" else (1.0, 0.0, "")
        assert (recipe.exponent, recipe.alpha_p, recipe.start_from) == own


def test_the_learning_rate_rises_stays_and_falls():
    recipe = Recipe(**NEEDED)
    rates = [recipe.learning_rate_at(step) for step in range(10)]
    assert rates == [0.25, 0.5, 0.75, 1, 1, 1, 1, 1, 1, 0.5]


def test_the_learning_rate_without_slopes_is_constant():
    recipe = Recipe(**NEEDED | {"warm_up_steps": 0, "cool_down_steps": 0})
    assert {recipe.learning_rate_at(step) for step in range(10)} == {1.0}


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("a = " + "[" * 3000, "maximum recursion depth"),
        (f"steps = {'9' * 5000}", "integer string conversion"),
        (f"steps = 0x{'f' * 5000}", "steps = a value too long to be written, expected a whole number"),
        ("a" + ".a" * 50_000 + " = 1", "more than 10000 characters"),
    ],
)
def test_a_recipe_made_to_do_harm_is_refused_at_once(tmp_path, text, found):
    file = tmp_path / "hostile.toml"
    file.write_text(text)
    with pytest.raises(FormatError, match=f"hostile.toml: .*{found}"):
        read_recipe(file)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stepz": 3}, "unknown key 'stepz'; a recipe has name, model, seed, "),
        ({"steps": "many"}, "steps = 'many', expected a whole number"),
        ({"steps": 1.5}, "steps = 1.5, expected a whole number"),
        ({"steps": True}, "steps = True, expected a whole number"),
        ({"steps": 2**63}, "steps = 9223372036854775808, expected a whole number of at most 64 bits"),
        ({"learning_rate": 10**400}, f"learning_rate = 1{'0' * 99}..., expected a number"),
        ({"learning_rate": "high"}, "learning_rate = 'high', expected a number"),
        ({"learning_rate": False}, "learning_rate = False, expected a number"),
        ({"name": 3}, "name = 3, expected a text in quotes"),
        ({"crop_size": 256}, "crop_size = 256, expected two whole numbers"),
        ({"crop_size": [256]}, r"crop_size = [256], expected two whole numbers"),
        ({"crop_size": [256, 1.5]}, r"crop_size = [256, 1.5], expected two whole numbers"),
        (
            {"crop_size": [0, 64]},
            "crop_size = [0, 64], expected more than 0 and at most pair_size = [320, 512]",
        ),
        ({"crop_size": [64, 528]}, "crop_size = [64, 528], expected more than 0 and at most pair_size = ["),
        ({"batch": 0}, "batch = 0, expected more than 0"),
        ({"steps": -1}, "steps = -1, expected more than 0"),
        ({"pairs": 0}, "pairs = 0, expected more than 0"),
        ({"validation_pairs": 0}, "validation_pairs = 0, expected more than 0"),
        ({"validate_every": 0}, "validate_every = 0, expected more than 0"),
        ({"averaged_steps": 0}, "averaged_steps = 0, expected more than 0"),
        ({"max_disparity_px": 0.0}, "max_disparity_px = 0.0, expected more than 0"),
        ({"max_disparity_px": float("inf")}, "max_disparity_px = inf, expected more than 0"),
        ({"max_depth_m": 0.0}, "max_depth_m = 0.0, expected more than 0"),
        ({"fit_exponent": "yes"}, "fit_exponent = 'yes', expected true or false"),
        ({"loss": 2}, "loss = 2, expected a text in quotes"),
        ({"exponent": float("nan")}, "exponent = nan, expected at least 1"),
        ({"alpha_z": float("inf")}, "alpha_z = inf, expected at least 0"),
        ({"augment": 1}, "augment = 1, expected true or false"),
        ({"exponent": 0.5}, "exponent = 0.5, expected at least 1"),
        ({"exponent": float("inf")}, "exponent = inf, expected at least 1"),
        ({"alpha_z": -1.0}, "alpha_z = -1.0, expected at least 0"),
        ({"alpha_p": -0.1}, "alpha_p = -0.1, expected at least 0"),
        ({"target": "height"}, "target = 'height', expected disparity or depth"),
        ({"dataset": "sintel"}, "dataset = 'sintel' with root = '', expected a root for a dataset on disk"),
        ({"root": "sintel"}, "dataset = 'collage' with root = 'sintel', expected a root for a dataset on"),
        ({"mix": "collage"}, "mix = 'collage', expected a table of sets and their weights, such as collage"),
        (
            {"mix": {"collage": "half"}},
            "mix = {'collage': 'half'}, expected a table of sets and their weights",
        ),
        ({"mix": [["collage", 1, 2]]}, "mix = [['collage', 1, 2]], expected a table of sets and their weig"),
        ({"mix": {"collage": 1.0, "rooms": 0}}, "mix: weight 0 of 'rooms', expected more than 0"),
        ({"mix": {"collage": float("nan")}}, "mix: weight nan of 'collage', expected more than 0"),
        (
            {"mix": {"collage": 1.0}, "dataset": "sintel", "root": "sintel"},
            "mix with dataset = 'sintel', expected 'collage', which a mix is scored on",
        ),
        ({"learning_rate": float("nan")}, "learning_rate = nan, expected more than 0"),
        ({"offset_share": 1.5}, "offset_share = 1.5, expected 0 to 1"),
        ({"robust": -0.1}, "robust = -0.1, expected 0 to 1"),
        ({"fresh": 1}, "fresh = 1, expected true or false"),
        ({"held_out": {"rooms": 1}}, "held_out = {'rooms': 1}, expected a table of names and folders"),
    ],
)
def test_a_wrong_key_or_value_is_named_in_one_line(changes, message):
    with pytest.raises(FormatError) as caught:
        recipe_from(NEEDED | changes, "my.toml")
    assert str(caught.value).startswith(f"my.toml: {message}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("missing", NEEDED)
def test_a_missing_key_is_named_in_one_line(missing):
    values = {name: value for name, value in NEEDED.items() if name != missing}
    with pytest.raises(FormatError) as caught:
        recipe_from(values, "my.toml")
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
def test_a_file_that_is_no_toml_is_named_in_one_line(tmp_path, content):
    file = tmp_path / "bad.toml"
    file.write_bytes(content)
    with pytest.raises(FormatError) as caught:
        read_recipe(file)
    assert str(caught.value).startswith(f"{file}: expected a recipe in TOML, found one that cannot be read (")
    assert "\n" not in str(caught.value)


def test_a_recipe_without_end_is_refused():
    with pytest.raises(FormatError, match="/dev/zero: expected a regular file, found a pipe or a device"):
        read_recipe(Path("/dev/zero"))


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(FormatError, match=r"nowhere\.toml: expected a recipe in TOML, found no such file"):
        read_recipe(tmp_path / "nowhere.toml")


def test_a_step_has_one_micro_batch_unless_the_recipe_says_otherwise():
    assert recipe_from(NEEDED, "here").micro_batches == 1
    assert recipe_from(NEEDED | {"micro_batch": 4}, "here").micro_batches == 1
    assert recipe_from(NEEDED | {"micro_batch": 1}, "here").micro_batches == 4


@pytest.mark.parametrize(
    ("micro_batch", "expected"), [(3, "a divisor of batch = 4"), (8, "a divisor"), (-1, "at least 0")]
)
def test_micro_batches_that_a_batch_cannot_be_parted_into_are_refused(micro_batch, expected):
    with pytest.raises(FormatError, match=f"here: micro_batch = {micro_batch}, expected {expected}"):
        recipe_from(NEEDED | {"micro_batch": micro_batch}, "here")
