import atexit
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from dataset_examples import write_map, write_picture
from learn_examples import (
    CAMERA,
    PAIR_SIZE,
    RECIPE,
    SMALLER,
    Listed,
    assert_same,
    box_before_a_wall,
    checkpoint_of,
    complaint,
    keep_pairs,
    make_batches_in_place,
    recipe_of,
    untrained,
    write,
    write_box_set,
)
from lightning_fabric.loggers.tensorboard import TensorBoardLogger
from lightning_fabric.utilities.distributed import _destroy_dist_connection
from other_processes import halted
from rich.console import Console

from stereoweave.bench.error_classes import CLASSES
from stereoweave.errors import FormatError, OutputInUseError, StereoweaveError
from stereoweave.learn import checkpoint
from stereoweave.learn.data.batches import Batches
from stereoweave.learn.data.pair_cache import CachedPairs
from stereoweave.learn.data.sources import VALIDATION_SEED
from stereoweave.learn.models import MODELS
from stereoweave.learn.recipe import read_recipe
from stereoweave.learn.training import fabric
from stereoweave.learn.training import loop as training
from stereoweave.learn.training import run as training_run
from stereoweave.learn.training.fabric import make_fabric
from stereoweave.learn.training.loop import train
from stereoweave.learn.training.run import TrainingRun, load_start

RECIPES = sorted((Path(__file__).parents[3] / "recipes").rglob("*.toml"))
QUIET = Console(quiet=True)
CAMERA_PAIRS = Listed(
    [replace(box_before_a_wall(np.random.default_rng(seed)), camera=CAMERA) for seed in range(4)]
)


def in_memory(recipe):
    """Return the recipe for `CAMERA_PAIRS`, small enough for PSMNet to be fast."""
    return replace(
        recipe,
        name=recipe.model,
        seed=0,
        start_from="",
        dataset=RECIPE.dataset,
        root="",
        pair_size=PAIR_SIZE,
        batch=2,
        micro_batch=0,
        # A long warm-up moves some weights by less than the precision of float32.
        warm_up_steps=min(recipe.warm_up_steps, 2),
        held_out=(),
        **{"crop_size": (64, 64), "max_disparity_px": 48.0} | SMALLER.get(recipe.model, {}),
    )


FIRST_STEPS = {in_memory(read_recipe(file)): file.stem for file in RECIPES}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return the folder of the runs, with their training and held-out pairs."""
    folder = tmp_path_factory.mktemp("runs")
    keep_pairs(folder / "pairs", RECIPE.seed, RECIPE.pairs)
    keep_pairs(folder / "pairs", VALIDATION_SEED, RECIPE.validation_pairs)
    return folder


@pytest.fixture(scope="module")
def recipe_file(folder):
    return write(RECIPE, folder / "tiny.toml")


@pytest.fixture(scope="module")
def finished(folder, recipe_file):
    """Return the last checkpoint of a run that was not interrupted."""
    with pytest.MonkeyPatch.context() as patch:
        make_batches_in_place(patch)
        return train(recipe_file, folder / "finished", QUIET)


@pytest.fixture
def in_place(monkeypatch):
    make_batches_in_place(monkeypatch)


@pytest.fixture
def logger(tmp_path):
    with training.close_curves(TensorBoardLogger(tmp_path, name="", version="")) as logger:
        yield logger


def test_a_killed_and_resumed_run_ends_as_an_uninterrupted_one(folder, recipe_file, finished):
    last = folder / "killed" / "last.pt"
    code = (
        "import sys; from pathlib import Path; from stereoweave.learn.training.loop import train; "
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
        with halted(process):
            with pytest.raises(OutputInUseError, match="killed: .* found one that is in use"):
                train(recipe_file, last.parent, QUIET)
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
        StereoweaveError,
        match=r"last\.pt: expected a run of this recipe, found a run of recipe tiny with other settings; "
        r"train into a new folder",
    ):
        train(other, finished.parent, QUIET)
    assert finished.read_bytes() == before


def test_a_run_resumes_with_other_steps_and_other_data(folder, finished):
    recipe = replace(
        RECIPE, steps=RECIPE.steps + 2, cool_down_steps=1, mix=(("collage", 1.0),), crop_size=(32, 64)
    )
    start = load_start(recipe, finished)
    assert (start.step, start.recipe) == (RECIPE.steps, recipe)
    assert_same(start.optimiser, checkpoint.load(finished).optimiser)


def test_a_run_is_saved_every_ten_minutes(folder, recipe_file, tmp_path, logger, monkeypatch):
    last = tmp_path / "last.pt"
    run = TrainingRun(RECIPE, load_start(RECIPE, last), make_fabric(logger))
    run.save_periodically(3, last)
    assert not last.exists()
    now = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now + 601)
    run.save_periodically(3, last)
    assert checkpoint.load(last).step == 3
    run.save_periodically(4, last)
    assert checkpoint.load(last).step == 3


def test_a_run_that_is_stopped_in_a_validation_validates_when_it_resumes(
    folder, in_place, tmp_path, monkeypatch, finished
):
    (tmp_path / "pairs").symlink_to(folder / "pairs")
    validate = training._validate

    def stop(*_given):
        raise KeyboardInterrupt

    monkeypatch.setattr(training, "_validate", stop)
    monkeypatch.setattr(training_run, "_SAVE_EVERY_S", 0)
    with pytest.raises(KeyboardInterrupt):
        training.train_recipe(RECIPE, tmp_path / "stopped", QUIET)
    monkeypatch.setattr(training, "_validate", validate)
    last = training.train_recipe(RECIPE, tmp_path / "stopped", QUIET)
    whole = checkpoint.load(finished)
    assert checkpoint.load(last).scores.keys() == whole.scores.keys()
    assert [row["step"] for row in training.read_scores(last.with_name("validation.csv"))] == [
        row["step"] for row in training.read_scores(finished.with_name("validation.csv"))
    ]


def test_a_run_is_scored_by_class_on_the_held_out_sets_of_its_recipe(folder, in_place, tmp_path):
    boxes = write_box_set(tmp_path / "boxes")
    recipe = replace(RECIPE, name="scored", steps=2, held_out=(("boxes", str(boxes)),))
    kept = checkpoint.load(train(write(recipe, tmp_path / "scored.toml"), folder / "scored", QUIET))
    assert kept.scores["boxes_epe_px"] > 0
    parts = [kept.scores[f"boxes_{name}_bad1_percent"] for name in CLASSES]
    assert sum(parts) == pytest.approx(kept.scores["boxes_bad1_percent"])


def test_a_run_starts_from_the_averaged_weights_of_another(folder, finished):
    recipe = replace(RECIPE, name="second", start_from=str(finished))
    start = load_start(recipe, folder / "second" / "last.pt")
    first = checkpoint.load(finished)
    assert start.step == 0
    assert start.hours == first.hours
    assert start.origin == ({"recipe": asdict(RECIPE), "step": RECIPE.steps, "commit": first.commit},)
    assert_same(start.weights, first.averaged)


def test_a_second_loss_that_is_not_finite_stops_the_run_and_names_the_pairs(folder, in_place, tmp_path):
    broken = untrained()
    torch.nn.init.constant_(broken.to_match.weight, torch.nan)
    checkpoint.save(checkpoint_of(broken), tmp_path / "broken.pt")
    recipe = replace(RECIPE, name="broken", start_from=str(tmp_path / "broken.pt"))
    file = write(recipe, tmp_path / "broken.toml")
    pairs = CachedPairs(folder / "pairs", recipe.seed, recipe.pairs, PAIR_SIZE)
    names = ", ".join(pairs.name(index) for index in Batches(recipe, pairs).list_pairs(1))
    with pytest.raises(StereoweaveError) as caught:
        train(file, folder / "broken", QUIET)
    assert str(caught.value) == (
        f"step 1: the loss is nan; the pairs are {names}; step 0 was skipped for the same reason"
    )
    assert not (folder / "broken" / "last.pt").exists()


def test_a_process_that_fails_does_not_wait_for_the_others_to_leave_their_gpus(tmp_path, monkeypatch):
    left_out = []
    monkeypatch.setattr(atexit, "unregister", left_out.append)
    complaint(train, tmp_path / "none.toml", tmp_path / "run", QUIET)
    assert left_out == [_destroy_dist_connection]


def test_a_pair_that_cannot_be_trained_on_is_named_in_one_line(tmp_path):
    """It is read in another process, where PyTorch would put a traceback before the message."""
    for frame in ("a", "b"):
        for side in ("left", "right"):
            write_picture(tmp_path / "set" / side / f"{frame}.png", 7)
        # No depth is known.
        write_map(tmp_path / "set" / "depth" / f"{frame}.png", [0], 0, np.uint16)
    (tmp_path / "set" / "calib.txt").write_text(
        "cam0=[300 0 19.5; 0 300 15.5; 0 0 1]\ndoffs=0\nbaseline=100\nwidth=40\nheight=32\n"
    )
    changes = {"dataset": "paper", "root": str(tmp_path / "set"), "crop_size": (32, 32), "batch": 1}
    file = write(recipe_of("fast_depth", **changes), tmp_path / "unknown.toml")
    message = complaint(train, file, tmp_path / "run", QUIET)
    assert re.fullmatch(r"[ab]: expected at least one pixel with known disparity, found none; .*", message)


def test_a_truth_out_of_range_is_named_with_the_pairs_of_its_step(tmp_path, logger):
    recipe = recipe_of("fast_depth", target="depth", max_depth_m=1.0)
    run = TrainingRun(recipe, load_start(recipe, tmp_path / "last.pt"), make_fabric(logger))
    batches = Batches(recipe, CAMERA_PAIRS)
    message = complaint(run.step, 0, batches[0], batches)
    assert message.startswith(f"step 0: one of {', '.join(batches.names(0))}: depth: expected more than 0")


def test_weights_of_another_network_are_refused_as_a_start(finished, tmp_path):
    recipe = recipe_of("fast_depth", start_from=str(finished))
    assert complaint(load_start, recipe, tmp_path / "last.pt") == (
        "tiny: start_from: expected a checkpoint that shares weights with fast_depth, found "
        f"{str(finished)!r}, a checkpoint of weave_small"
    )


def test_gradients_that_are_not_finite_never_reach_the_weights_and_the_second_stops_the_run(
    tmp_path, logger, caplog
):
    recipe = recipe_of("fast_depth")
    run = TrainingRun(recipe, load_start(recipe, tmp_path / "last.pt"), make_fabric(logger))
    network = run.network
    before = {name: value.clone() for name, value in network.state_dict().items()}
    # A product with infinity makes the gradient infinite and leaves the loss as it was.
    network.head.to_code.bias.register_hook(lambda gradient: gradient * torch.inf)
    batches = Batches(recipe, CAMERA_PAIRS)
    found = f"step 7: the norm of the gradient is inf; the pairs are {', '.join(batches.names(7))}"
    run.step(7, batches[7], batches)
    assert run.skipped == [7]
    assert caplog.messages[-1] == f"{found}; skipped"
    run.step(507, batches[507], batches)  # 500 steps later it is still isolated
    assert complaint(run.step, 1006, batches[1006], batches).endswith(
        "; step 507 was skipped for the same reason"
    )
    # This includes the statistics of batch norms.
    assert_same(network.state_dict(), before)
    assert_same(run.averaged.module.state_dict(), before)
    assert not run.optimiser.state_dict()["state"]


def test_a_resumed_run_remembers_the_steps_that_it_skipped(tmp_path, logger):
    recipe, batches = recipe_of("fast_depth"), Batches(recipe_of("fast_depth"), CAMERA_PAIRS)

    def resume():
        run = TrainingRun(recipe, load_start(recipe, tmp_path / "last.pt"), make_fabric(logger))
        run.network.head.to_code.bias.register_hook(lambda gradient: gradient * torch.inf)
        return run

    before = resume()
    before.step(7, batches[7], batches)
    before.save(8, {}, tmp_path / "last.pt")
    assert complaint(resume().step, 506, batches[506], batches).endswith(
        "; step 7 was skipped for the same reason"
    )


def test_the_average_of_a_resumed_run_does_not_count_skipped_steps(tmp_path, logger):
    recipe, batches = recipe_of("fast_depth"), Batches(recipe_of("fast_depth"), CAMERA_PAIRS)

    def resume():
        return TrainingRun(recipe, load_start(recipe, tmp_path / "last.pt"), make_fabric(logger))

    before = resume()
    hook = before.network.head.to_code.bias.register_hook(lambda gradient: gradient * torch.inf)
    before.step(0, batches[0], batches)
    hook.remove()
    before.step(1, batches[1], batches)
    before.save(2, {}, tmp_path / "last.pt")
    resumed = resume()
    for run in (before, resumed):
        run.step(2, batches[2], batches)
    assert_same(resumed.averaged.module.state_dict(), before.averaged.module.state_dict())


def test_a_recipe_for_an_unknown_network_is_refused(tmp_path):
    file = write(replace(RECIPE, model="spider"), tmp_path / "spider.toml")
    with pytest.raises(FormatError, match=r"tiny: model = 'spider', expected one of weave_small"):
        train(file, tmp_path / "run", QUIET)


@pytest.mark.parametrize("sizes", [{"crop_size": (64, 56)}, {"pair_size": (64, 100)}])
def test_a_recipe_with_sizes_that_the_network_cannot_divide_is_refused(tmp_path, sizes):
    file = write(replace(RECIPE, **sizes), tmp_path / "odd.toml")
    with pytest.raises(
        FormatError, match=r"tiny: pair_size and crop_size: expected multiples of 16 for weave_small"
    ):
        train(file, tmp_path / "run", QUIET)


def test_a_run_into_a_file_fails_before_any_pair_is_made(recipe_file, tmp_path):
    (tmp_path / "file").write_text("kept")
    with pytest.raises(StereoweaveError, match="file: expected a writable folder"):
        train(recipe_file, tmp_path / "file", QUIET)
    assert [file.read_text() for file in tmp_path.iterdir()] == ["kept"]


def step_of(recipe, folder, logger, steps=1):
    """Take the first steps of a recipe on pairs in memory. Returns the run, and its initial parameters."""
    run = TrainingRun(recipe, load_start(recipe, folder / "last.pt"), make_fabric(logger))
    before = {name: value.clone() for name, value in run.network.named_parameters()}
    batches = Batches(recipe, CAMERA_PAIRS)
    for step in range(steps):
        assert 0 < run.step(step, batches[step], batches) < 100
    return run, before


def assert_all_moved(run, before):
    trained = run.recipe.trained or tuple(dict(run.network.named_children()))
    for name, value in run.network.named_parameters():
        assert value.isfinite().all()
        assert torch.equal(value, before[name]) == (name.split(".")[0] not in trained), name


@pytest.mark.parametrize("recipe", FIRST_STEPS, ids=FIRST_STEPS.values())
def test_every_shipped_recipe_takes_its_first_steps(recipe, tmp_path, logger):
    # WeaveNet has layers that start at zero, so its first two steps only enable them one after the other.
    steps = 3 if recipe.model.startswith("weave") else 1
    assert_all_moved(*step_of(recipe, tmp_path, logger, steps))


@pytest.mark.parametrize("model", [name for name in MODELS if not name.startswith(("weave", "mc_cnn"))])
def test_each_of_the_papers_networks_trains_if_only_the_model_is_changed(model, tmp_path, logger):
    """The loss is all of equation (5) on depth with an exponent, on one batch for all networks but GA-Net."""
    recipe = recipe_of("fast_depth", target="depth", exponent=1.5, alpha_p=1.0, averaged_steps=1)
    run, before = step_of(replace(recipe, model=model, **SMALLER.get(model, {})), tmp_path, logger)
    assert_all_moved(run, before)
    # An average over one step equals the weights of that step.
    assert_same(dict(run.averaged.module.state_dict()), dict(run.network.state_dict()))


@pytest.mark.parametrize("model", ["fast_depth", "mc_cnn"])
def test_another_network_ends_as_an_uninterrupted_one_if_it_is_resumed(folder, in_place, model):
    """This includes dropout and the choice of patches, whose random draws continue."""
    recipe = recipe_of(model, name="paper", steps=4, alpha_p=1.0)
    whole = checkpoint.load(training.train_recipe(recipe, folder / model, QUIET))
    last = folder / f"{model}_resumed" / "last.pt"

    class Killed(Exception):
        pass

    def kill(self, *arguments):
        keep(self, *arguments)
        raise Killed

    with pytest.MonkeyPatch.context() as patch:
        keep = TrainingRun.save
        patch.setattr(TrainingRun, "save", kill)
        with pytest.raises(Killed):
            training.train_recipe(recipe, last.parent, QUIET)
    assert checkpoint.load(last).step == 2
    torch.manual_seed(99)
    resumed = checkpoint.load(training.train_recipe(recipe, last.parent, QUIET))
    assert resumed.step == whole.step == 4
    for name in ("weights", "averaged", "optimiser", "random_state", "scores"):
        assert_same(getattr(resumed, name), getattr(whole, name))


def test_the_scores_of_a_run_are_recorded_step_by_step(folder, finished):
    rows = training.read_scores(finished.with_name(training.SCORES_FILE))
    assert [row["step"] for row in rows] == list(range(2, RECIPE.steps + 1, 2))
    assert rows[-1] == {"step": RECIPE.steps, **checkpoint.load(finished).scores}


def test_scores_written_again_replace_those_of_later_steps(tmp_path):
    for step, score in ((10, 3.0), (20, 2.0), (30, 1.0), (20, 2.5)):
        training.append_scores(tmp_path / "curve.csv", step, {"loss": score})
    rows = training.read_scores(tmp_path / "curve.csv")
    assert rows == [{"step": 10, "loss": 3.0}, {"step": 20, "loss": 2.5}]
    assert training.read_scores(tmp_path / "nowhere.csv") == []


def test_a_held_out_set_may_be_left_out_and_return_when_a_run_resumes(tmp_path):
    rows = [
        {"step": 10, "loss": 3.0, "rooms": 1.0},
        {"step": 20, "loss": 2.0},
        {"step": 30, "loss": 1.0, "rooms": 0.5, "streets": 4.0},
    ]
    for row in rows:
        scores = {name: value for name, value in row.items() if name != "step"}
        training.append_scores(tmp_path / "curve.csv", row["step"], scores)
    assert training.read_scores(tmp_path / "curve.csv") == rows


def test_a_recipe_with_fewer_steps_than_were_trained_is_refused(folder, finished):
    message = complaint(
        training.train_recipe, replace(RECIPE, steps=RECIPE.steps - 1), finished.parent, QUIET
    )
    assert message.endswith(
        f"expected at most {RECIPE.steps - 1} steps, as the recipe has, found {RECIPE.steps}; "
        "give the recipe more steps"
    )


@pytest.mark.parametrize(("precision", "dtype"), [("bf16-mixed", torch.bfloat16), ("32-true", torch.float32)])
def test_a_step_computes_in_bfloat16_where_the_device_does(
    folder, tmp_path, monkeypatch, logger, precision, dtype
):
    monkeypatch.setattr(fabric, "_choose_precision", lambda: precision)
    run = TrainingRun(RECIPE, load_start(RECIPE, tmp_path / "last.pt"), make_fabric(logger))
    seen = []
    run.network.to_match.register_forward_hook(lambda _layer, _inputs, output: seen.append(output.dtype))
    batches = Batches(RECIPE, CachedPairs(folder / "pairs", RECIPE.seed, RECIPE.pairs, PAIR_SIZE))
    run.step(0, batches[0], batches)
    assert set(seen) == {dtype}
