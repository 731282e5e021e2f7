"""Training by the clock: schedule, state files, and resumption after a killed command."""

import json
import math
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from dataset_examples import write_map, write_picture
from learn_examples import (
    RECIPE,
    Listed,
    box_before_a_wall,
    checkpoint_of,
    complaint,
    untrained,
)

from stereoweave.learn import checkpoint
from stereoweave.learn.data.batches import collate
from stereoweave.learn.data.painters import Painters, ReusedPairs, make_cool_down_recipe
from stereoweave.learn.recipe import read_recipe
from stereoweave.learn.training import timed
from stereoweave.learn.training.clock import RESERVE_S, RunClock, is_cooling_down, learning_rate_at
from stereoweave.learn.training.timed import TimedCommand, train_by_clock
from stereoweave.learn.training.timed_run import (
    NETWORK_FILE,
    OPTIMISER_FILE,
    PROGRESS_FILE,
    RunProgress,
    TimedRun,
    find_resume_point,
)

pytestmark = pytest.mark.system

GPU = Path(__file__).parents[3] / "recipes" / "gpu"
CPU = torch.device("cpu")
# 8 of 1000 px of width: the rate falls over the last fifth of the time.
SCHEDULE = replace(RECIPE, learning_rate=0.01, warm_up_steps=4, steps=1000, cool_down_steps=200)


def batch():
    """Return a batch of two pairs, as `Painters` returns it."""
    samples = [box_before_a_wall(np.random.default_rng(seed)) for seed in range(2)]
    made = collate(samples)
    images = {side: (made[side] * 255).round().to(torch.uint8) for side in ("left", "right")}
    return {**made, **images}


def run_of(start=None, optimiser=None):
    return TimedRun(start or checkpoint_of(untrained()), optimiser or {}, CPU)


def step(run, rate=1e-3):
    return run.finish(run.begin(run.move_to_device(batch())), rate)


def values_of(network):
    return [value.clone() for value in network.state_dict().values()]


@pytest.mark.parametrize(
    ("steps", "share", "rate"),
    [(0, 0.0, 0.0025), (1, 0.0, 0.005), (3, 0.1, 0.01), (900, 0.8, 0.01), (900, 0.9, 0.005), (900, 1.0, 0.0)],
)
def test_the_rate_rises_over_steps_stays_and_falls_over_the_last_fifth_of_the_time(steps, share, rate):
    assert learning_rate_at(SCHEDULE, steps, share) == pytest.approx(rate, abs=1e-12)


def test_crops_change_where_the_rate_begins_to_fall():
    assert [is_cooling_down(SCHEDULE, share) for share in (0.0, 0.79, 0.81, 1.0)] == [
        False,
        False,
        True,
        True,
    ]


def test_a_clock_counts_the_commands_before_and_ends_a_command_in_time():
    clock = RunClock(began_s=1000.0, used_s=500.0, minutes=9, total_minutes=26)
    assert clock.elapsed_s(1010) == 510
    assert clock.elapsed_share(1270) == 770 / (26 * 60 - RESERVE_S)
    assert clock.remaining_s(1010) == 9 * 60 - 10 - RESERVE_S
    late = replace(clock, used_s=1400.0)
    assert late.remaining_s(1010) == 26 * 60 - 1410 - RESERVE_S  # the run's end comes before the command's
    assert late.elapsed_share(2000) == 1


def test_a_pair_is_reused_for_the_given_number_of_cuts():
    sample = box_before_a_wall(np.random.default_rng(0))
    samples = [replace(sample) for _ in range(5000)]
    fresh, reused = (ReusedPairs(Listed(samples), held=10) for _ in range(2))
    assert all(fresh[index] is samples[index] for index in range(100))
    reused.cuts = 2.5
    counts = Counter(id(reused[index]) for index in range(5000))
    assert 5000 / len(counts) == pytest.approx(2.5, rel=0.1)
    assert max(counts.values()) < 20  # every pair is replaced at some point


def test_larger_crops_come_from_larger_pairs_in_smaller_batches():
    recipe = replace(RECIPE, batch=32, pair_size=(320, 512), crop_size=(256, 384))
    cool = make_cool_down_recipe(recipe, (384, 640))
    assert (cool.pair_size, cool.crop_size, cool.batch) == ((448, 768), (384, 640), 13)
    assert cool.seed != recipe.seed


def test_a_batch_on_the_device_is_the_one_that_was_collated():
    samples = [box_before_a_wall(np.random.default_rng(seed)) for seed in range(2)]
    moved = run_of().move_to_device(batch())
    for name, value in collate(samples).items():
        assert torch.equal(moved[name], value)


def test_a_run_learns_a_pair():
    run = run_of()
    first = step(run)
    for _ in range(20):
        last = step(run)
    assert last < 0.7 * first


def test_a_step_that_is_not_finite_changes_nothing():
    run = run_of()
    step(run)
    before = values_of(run.averaged.module), [value.clone() for value in run.network.parameters()]
    spoiled = run.move_to_device(batch())
    spoiled["left"][:] = torch.nan
    assert math.isnan(run.finish(run.begin(spoiled), 1e-3))
    after = values_of(run.averaged.module), list(run.network.parameters())
    assert all(
        torch.equal(old, new)
        for pair in zip(before, after, strict=True)
        for old, new in zip(*pair, strict=True)
    )
    assert all(value.isfinite().all() for value in run.network.state_dict().values())
    assert math.isfinite(step(run))


def test_undone_steps_leave_weights_statistics_and_moments_as_they_were():
    run = run_of()
    step(run)
    parts = run.network, run.averaged, run.optimiser
    before = [deepcopy(part.state_dict()) for part in parts]
    with run.undone():
        step(run)
        assert not torch.equal(run.network.to_match.weight, before[0]["to_match.weight"])
    for part, values in zip(parts, before, strict=True):
        torch.testing.assert_close(part.state_dict(), values, rtol=0, atol=0)


def test_weights_that_are_not_finite_are_not_written(tmp_path):
    run = run_of()
    torch.nn.init.constant_(run.network.to_match.weight, torch.nan)
    assert "expected finite weights" in complaint(run.save, tmp_path, RunProgress(), 0.0, {})
    assert not list(tmp_path.iterdir())


def test_another_run_resumes_from_the_files(tmp_path):
    (tmp_path / "out").mkdir()
    run = run_of()
    step(run)
    progress = RunProgress(seconds=60.0, steps=1, optimiser_steps=1, pairs=2, batches=3)
    run.save(tmp_path / "out", progress, 0.5, {"epe_px": 2.0})
    found = find_resume_point(RECIPE, tmp_path / "next", tmp_path / "out", "abc")
    assert found.progress == progress
    assert (found.checkpoint.commit, found.checkpoint.hours, found.checkpoint.step) == ("abc", 0.5, 1)
    other = run_of(found.checkpoint, found.optimiser)
    assert step(other) == step(run)
    assert all(
        torch.equal(a, b) for a, b in zip(values_of(other.network), values_of(run.network), strict=True)
    )


def test_of_two_folders_the_run_that_is_further_ahead_is_resumed(tmp_path):
    run = run_of()
    for name, seconds in (("out", 10.0), ("earlier", 20.0)):
        (tmp_path / name).mkdir()
        run.save(tmp_path / name, RunProgress(seconds=seconds, optimiser_steps=9), 0.0, {})
    (tmp_path / "earlier" / OPTIMISER_FILE).unlink()
    found = find_resume_point(RECIPE, tmp_path / "out", tmp_path / "earlier", "")
    assert found.progress.seconds == 20
    # Without its state, the optimiser warms up again.
    assert (found.optimiser, found.progress.optimiser_steps) == ({}, 0)


def test_files_from_which_no_run_can_resume_are_named(tmp_path):
    assert "copy all of that command's files" in complaint(
        find_resume_point, RECIPE, tmp_path / "out", tmp_path, ""
    )
    run_of().save(tmp_path, RunProgress(), 0.0, {})
    other = replace(RECIPE, model="weave_base")
    assert "expected a run of weave_base, found a run of weave_small" in complaint(
        find_resume_point, other, tmp_path, None, ""
    )
    parts = replace(RECIPE, trained=("refinement",))
    assert "expected trained = ['refinement'], found []" in complaint(
        find_resume_point, parts, tmp_path, None, ""
    )
    (tmp_path / PROGRESS_FILE).write_text("{}x")
    assert "expected the progress of a timed run" in complaint(find_resume_point, RECIPE, tmp_path, None, "")


@pytest.mark.parametrize("name", ["base", "small"])
def test_every_file_of_a_run_is_below_16_mib(name, tmp_path, monkeypatch):
    monkeypatch.chdir(GPU.parents[1])
    recipe = read_recipe(GPU / f"{name}.toml")
    start = find_resume_point(recipe, tmp_path, None, "").checkpoint
    run = TimedRun(start, {}, CPU)
    run.begin(run.move_to_device(batch()))
    run.optimiser.step()
    run.save(tmp_path, RunProgress(), 0.0, {})
    assert max(file.stat().st_size for file in tmp_path.iterdir()) < 16 * 2**20
    assert checkpoint.load(tmp_path / NETWORK_FILE).recipe == recipe


class Seconds:
    """A clock that advances by a second whenever it is read."""

    def __init__(self):
        self.now_s = 0.0

    def monotonic(self):
        self.now_s += 1
        return self.now_s


def dataset(folder):
    """Write frames of known depth, which are fast to read. Returns a recipe file for them."""
    for number in range(4):
        for side, shade in (("left", 90), ("right", 100)):
            write_picture(folder / "set" / side / f"{number}.png", shade, (32, 48))
        write_map(folder / "set" / "depth" / f"{number}.png", [3000], 3000, np.uint16, (32, 48))
    (folder / "set" / "calib.txt").write_text(
        "cam0=[300 0 23.5; 0 300 15.5; 0 0 1]\ndoffs=0\nbaseline=100\nwidth=48\nheight=32\n"
    )
    lines = [
        'name = "timed"',
        'model = "weave_small"',
        "steps = 100",
        "cool_down_steps = 20",
        "warm_up_steps = 2",
        "batch = 2",
        "learning_rate = 1e-3",
        'dataset = "paper"',
        f'root = "{folder / "set"}"',
        "crop_size = [32, 32]",
    ]
    file = folder / "timed.toml"
    file.write_text("\n".join(lines) + "\n")
    return file


def test_painters_continue_when_one_of_them_is_killed(tmp_path):
    recipe = read_recipe(dataset(tmp_path))
    with Painters([recipe, make_cool_down_recipe(recipe, (16, 32))], tmp_path, processes=2) as painters:
        first = painters.take()
        assert {name: tuple(value.shape) for name, value in first.items()} == {
            "left": (2, 3, 32, 32),
            "right": (2, 3, 32, 32),
            "disparity_px": (4, 1, 32, 32),
            "occluded": (4, 1, 32, 32),
        }
        # 300 px * 0.1 m / 3 m, scaled with the cut; of the right views nothing is known.
        assert 7 < float(first["disparity_px"][0, 0, 5, 5]) < 15
        assert first["disparity_px"][2:].isnan().all()
        os.kill(multiprocessing.active_children()[0].pid, signal.SIGKILL)
        painters.switch(1)
        sizes = [tuple(painters.take()["left"].shape) for _ in range(20)]
        assert sizes[-1] == (4, 3, 16, 32)
    assert not multiprocessing.active_children()


def test_a_killed_command_is_resumed_until_the_time_is_over(tmp_path, monkeypatch):
    recipe_file, out = dataset(tmp_path), tmp_path / "killed"
    call = [sys.executable, str(GPU / "train.py"), str(recipe_file), "--out", str(out)]
    with (tmp_path / "log").open("w") as log:
        process = subprocess.Popen(
            [*call, "--device", "cpu", "--processes", "1"],
            stdout=log,
            stderr=log,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
        while not (out / PROGRESS_FILE).exists() and process.poll() is None:
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL, (tmp_path / "log").read_text()
    killed = json.loads((out / PROGRESS_FILE).read_text())

    monkeypatch.setattr(timed, "time", Seconds())
    lines = []
    command = TimedCommand(
        out=tmp_path / "next",
        earlier=out,
        began_s=0.0,
        minutes=2,
        total_minutes=(killed["seconds"] + 100) / 60,
        device="cpu",
        processes=1,
        cool_down_crop=(16, 32),
    )
    progress = train_by_clock(read_recipe(recipe_file), command, lines.append)
    assert progress.steps > 5
    assert progress.skipped == 0
    last = checkpoint.load(command.out / NETWORK_FILE)
    assert last.step == progress.steps
    assert all(value.isfinite().all() for value in (*last.weights.values(), *last.averaged.values()))
    assert last.scores["epe_px"] < math.inf
    assert any("smoke test passed" in line for line in lines)
    assert "minutes used up" in lines[-1]
    # The same command, run again, finds that no time is left.
    again = train_by_clock(read_recipe(recipe_file), replace(command, earlier=None), lines.append)
    assert again == progress
    assert "minutes are used" in lines[-1]


def test_a_second_step_in_500_that_is_not_finite_ends_the_run(tmp_path, monkeypatch):
    recipe = read_recipe(dataset(tmp_path))
    monkeypatch.setattr(timed, "time", Seconds())
    finish = TimedRun.finish
    # The steps of the smoke test have a rate of 0.
    monkeypatch.setattr(TimedRun, "finish", lambda *given: math.nan if given[2] else finish(*given))
    lines = []
    command = TimedCommand(
        out=tmp_path / "out", began_s=0.0, minutes=9, total_minutes=9, device="cpu", processes=1
    )
    assert "steps 0 and 1: expected a finite loss" in complaint(train_by_clock, recipe, command, lines.append)
    assert "step 0: the loss or its gradient is not finite; skipped" in lines


def test_training_by_the_clock_runs_without_optional_libraries():
    left_out = [
        "lightning_fabric",
        "tensorboard",
        "onnx",
        "onnxruntime",
        "moderngl",
        "trimesh",
        "h5py",
        "matplotlib",
    ]
    loaded = f"[name for name in {left_out} if name in sys.modules]"
    code = f"import sys, stereoweave.learn.training.timed; print({loaded})"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def test_a_library_that_is_missing_is_named_before_anything_else(tmp_path):
    (tmp_path / "numba.py").write_text("raise ImportError('not for this NumPy')\n")
    call = [sys.executable, str(GPU / "train.py"), str(GPU / "base.toml"), "--out", str(tmp_path / "out")]
    found = subprocess.run(
        call, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(tmp_path)}, check=False
    )
    assert found.returncode == 2
    assert found.stderr == (
        "numba: expected numba 0.61 or later, found ImportError: not for this NumPy; install its wheel\n"
    )
    assert not (tmp_path / "out").exists()
