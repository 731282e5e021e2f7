import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from learn_examples import PAIR_SIZE, RECIPE, box_before_a_wall, checkpoint_of, keep_pairs, untrained
from lightning_fabric.loggers.tensorboard import TensorBoardLogger
from rich.console import Console

from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.learn import checkpoint
from stereoweave.learn import train as training
from stereoweave.learn.batches import Batches, collated
from stereoweave.learn.pairs import KeptPairs
from stereoweave.learn.recipe import read_recipe
from stereoweave.learn.sources import VALIDATION_SEED
from stereoweave.learn.train import Run, train

RECIPES = sorted((Path(__file__).parent.parent / "recipes").rglob("*.toml"))
QUIET = Console(quiet=True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where runs go, with the pairs that they train on and are scored on."""
    folder = tmp_path_factory.mktemp("runs")
    keep_pairs(folder / "pairs", RECIPE.seed, RECIPE.pairs)
    keep_pairs(folder / "pairs", VALIDATION_SEED, RECIPE.validation_pairs)
    return folder


@pytest.fixture(scope="module")
def recipe_file(folder):
    return write(RECIPE, folder / "tiny.toml")


@pytest.fixture(scope="module")
def finished(folder, recipe_file):
    """The last checkpoint of a run that nothing stopped."""
    return train(recipe_file, folder / "finished", QUIET)


@pytest.fixture
def logger(tmp_path):
    with training.closing_curves(TensorBoardLogger(tmp_path, name="", version="")) as logger:
        yield logger


def write(recipe, file):
    lines = (f"{name} = {json.dumps(value)}" for name, value in asdict(recipe).items())
    file.write_text("\n".join(lines) + "\n")
    return file


def assert_same(one, other):
    """Equal to the last bit, through dictionaries and lists."""
    if isinstance(one, torch.Tensor):
        assert torch.equal(one, other)
    elif isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_same(one[key], other[key])
    else:
        assert one == other


def test_a_run_that_is_killed_and_started_again_ends_as_one_that_was_not(folder, recipe_file, finished):
    last = folder / "killed" / "last.pt"
    code = (
        "import sys; from pathlib import Path; from stereoweave.learn.train import train; "
        "train(Path(sys.argv[1]), Path(sys.argv[2]))"
    )
    with (folder / "killed.log").open("w") as log:
        process = subprocess.Popen(
            [sys.executable, "-c", code, str(recipe_file), str(last.parent)],
            stdout=log,
            stderr=log,
            env={**os.environ, "OMP_NUM_THREADS": str(torch.get_num_threads())},
        )
        while not last.exists() and process.poll() is None:
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL, (folder / "killed.log").read_text()
    killed = checkpoint.load(last)
    assert 0 < killed.step < RECIPE.steps

    train(recipe_file, last.parent, QUIET)
    resumed, whole = checkpoint.load(last), checkpoint.load(finished)
    assert resumed.step == whole.step == RECIPE.steps
    for name in ("weights", "averaged", "optimiser", "random_state", "scores"):
        assert_same(getattr(resumed, name), getattr(whole, name))
    assert resumed.hours > killed.hours


def test_a_run_keeps_its_weights_scores_and_curves(folder, finished):
    kept = checkpoint.load(finished)
    assert kept.recipe == RECIPE
    assert kept.scores.keys() == {"epe_px", "bad1_percent", "bad2_percent", "d1_percent", "calibration_error"}
    assert not torch.equal(kept.weights["to_match.weight"], kept.averaged["to_match.weight"])
    assert any(file.name.startswith("events.out.tfevents") for file in finished.parent.iterdir())


def test_a_folder_with_a_run_of_another_recipe_is_refused(folder, finished, tmp_path):
    other = write(replace(RECIPE, name="other", learning_rate=2e-3), tmp_path / "other.toml")
    before = finished.read_bytes()
    with pytest.raises(
        StereoweaveError, match=r"last\.pt: is of another recipe \(tiny\); train into a folder"
    ):
        train(other, finished.parent, QUIET)
    assert finished.read_bytes() == before


def test_a_run_starts_from_the_averaged_weights_of_another(folder, finished):
    recipe = replace(RECIPE, name="second", start_from=str(finished))
    start = training._starting_point(recipe, folder / "second" / "last.pt")
    first = checkpoint.load(finished)
    assert start.step == 0
    assert start.hours == first.hours
    assert start.origin == ({"recipe": asdict(RECIPE), "step": RECIPE.steps, "commit": first.commit},)
    assert_same(start.weights, first.averaged)


def test_a_loss_that_is_not_finite_stops_and_names_the_pairs(folder, tmp_path):
    broken = untrained()
    torch.nn.init.constant_(broken.to_match.weight, torch.nan)
    checkpoint.save(checkpoint_of(broken), tmp_path / "broken.pt")
    recipe = replace(RECIPE, name="broken", start_from=str(tmp_path / "broken.pt"))
    file = write(recipe, tmp_path / "broken.toml")
    chosen = Batches(recipe, KeptPairs(folder / "pairs", recipe.seed, recipe.pairs, PAIR_SIZE)).chosen(0)
    with pytest.raises(StereoweaveError) as caught:
        train(file, folder / "broken", QUIET)
    assert str(caught.value) == f"step 0: the loss is nan; its pairs are {chosen} of seed {recipe.seed}"
    assert not (folder / "broken" / "last.pt").exists()


def test_a_recipe_for_an_unknown_network_is_refused(tmp_path):
    file = write(replace(RECIPE, model="spider"), tmp_path / "spider.toml")
    with pytest.raises(FormatError, match=r"tiny: model = 'spider', expected weave"):
        train(file, tmp_path / "run", QUIET)


@pytest.mark.parametrize("sizes", [{"crop_size": (64, 56)}, {"pair_size": (64, 100)}])
def test_a_recipe_with_sizes_that_the_network_cannot_divide_is_refused(tmp_path, sizes):
    file = write(replace(RECIPE, **sizes), tmp_path / "odd.toml")
    with pytest.raises(FormatError, match=r"tiny: pair_size = .*, expected multiples of 16 for weave"):
        train(file, tmp_path / "run", QUIET)


def test_a_run_into_a_file_fails_before_any_pair_is_made(recipe_file, tmp_path):
    (tmp_path / "file").write_text("kept")
    with pytest.raises(StereoweaveError, match="file: expected a folder that can be written"):
        train(recipe_file, tmp_path / "file", QUIET)
    assert [file.read_text() for file in tmp_path.iterdir()] == ["kept"]


@pytest.mark.parametrize("file", RECIPES, ids=lambda file: file.name)
def test_every_shipped_recipe_takes_a_step(file, folder, tmp_path, logger):
    small = {name: getattr(RECIPE, name) for name in ("pairs", "pair_size", "crop_size", "batch")}
    recipe = replace(read_recipe(file), seed=RECIPE.seed, start_from="", **small)
    batches = Batches(recipe, KeptPairs(folder / "pairs", recipe.seed, recipe.pairs, recipe.pair_size))
    start = training._starting_point(recipe, tmp_path / "last.pt")
    run = Run(recipe, start, logger)
    before = {name: value.clone() for name, value in run.network.module.named_parameters()}
    assert 0 < run.step(0, batches[0], batches) < 100
    for name, value in run.network.module.named_parameters():
        assert value.isfinite().all()
        assert not torch.equal(value, before[name]), name


@pytest.mark.parametrize(("precision", "dtype"), [("bf16-mixed", torch.bfloat16), ("32-true", torch.float32)])
def test_a_step_computes_in_bfloat16_where_the_device_does(
    folder, tmp_path, monkeypatch, logger, precision, dtype
):
    monkeypatch.setattr(training, "_precision", lambda: precision)
    run = Run(RECIPE, training._starting_point(RECIPE, tmp_path / "last.pt"), logger)
    seen = []
    run.network.module.to_match.register_forward_hook(
        lambda _layer, _inputs, output: seen.append(output.dtype)
    )
    batches = Batches(RECIPE, KeptPairs(folder / "pairs", RECIPE.seed, RECIPE.pairs, PAIR_SIZE))
    run.step(0, batches[0], batches)
    assert set(seen) == {dtype}


def test_every_pair_comes_once_before_any_comes_again():
    recipe = replace(RECIPE, pairs=7, batch=3)
    batches = Batches(recipe, KeptPairs(Path("unused"), 0, recipe.pairs, PAIR_SIZE))
    chosen = [index for step in range(7) for index in batches.chosen(step)]
    epochs = [chosen[:7], chosen[7:14], chosen[14:]]
    assert all(sorted(epoch) == list(range(7)) for epoch in epochs)
    assert epochs[0] != epochs[1]


def test_a_batch_depends_on_the_seed_and_the_step_alone(folder):
    pairs = KeptPairs(folder / "pairs", RECIPE.seed, RECIPE.pairs, PAIR_SIZE)
    one, other = Batches(RECIPE, pairs), Batches(RECIPE, pairs)
    other[0]
    assert_same(one[1], other[1])
    assert not torch.equal(one[1]["left"], one[2]["left"])


def test_a_batch_holds_the_left_views_maps_and_behind_them_the_right_ones_mirrored():
    samples = [box_before_a_wall(np.random.default_rng(seed)) for seed in (0, 1)]
    batch = collated(samples)
    height, width = PAIR_SIZE
    assert batch["left"].shape == batch["right"].shape == (2, 3, height, width)
    assert batch["left"][1, 2, 5, 7].item() == pytest.approx(samples[1].left[5, 7, 2] / 255)
    assert batch["disparity_px"].shape == batch["occluded"].shape == (4, 1, height, width)
    np.testing.assert_array_equal(batch["disparity_px"][1, 0], samples[1].disparity_px)
    np.testing.assert_array_equal(batch["disparity_px"][3, 0], samples[1].right_disparity_px[:, ::-1])
    np.testing.assert_array_equal(batch["occluded"][2, 0], samples[0].right_occluded[:, ::-1])
