"""Training by the processes of torchrun, whose results must equal those of one process."""

import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from learn_examples import RECIPE, assert_same, complaint, keep_pairs, write
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from stereoweave.learn import checkpoint
from stereoweave.learn.data.sources import VALIDATION_SEED
from stereoweave.learn.training import loop as training

pytestmark = pytest.mark.system

# Two processes make two micro-batches each.
PARTED = replace(
    RECIPE, steps=30, batch=4, micro_batch=1, crop_size=(32, 32), validation_pairs=1, validate_every=16
)
QUIET = Console(quiet=True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    keep_pairs(folder / "pairs", PARTED.seed, PARTED.pairs)
    keep_pairs(folder / "pairs", VALIDATION_SEED, PARTED.validation_pairs)
    return folder


def torchrun(folder, recipe, *options):
    """Start two processes that train a recipe. Returns torchrun and the file of their output."""
    log, file = folder / f"{recipe.name}.log", write(recipe, folder / f"{recipe.name}.toml")
    command = [Path(sys.executable).with_name("torchrun"), "--nproc-per-node", "2", *options]
    with log.open("w") as stream:
        process = subprocess.Popen(
            [*command, "-m", "stereoweave", "train", file, "-o", folder / recipe.name],
            stdout=stream,
            stderr=stream,
            # As in this process, because sums depend on the number of threads.
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
    return process, log


def kill(torchrun, rank):
    """Kill one of the processes."""
    children = Path(f"/proc/{torchrun.pid}/task/{torchrun.pid}/children").read_text().split()
    (pid,) = (pid for pid in children if f"\0RANK={rank}\0" in Path(f"/proc/{pid}/environ").read_text())
    os.kill(int(pid), signal.SIGKILL)


def train_here(recipe, out, patch):
    """Train in this process, which also crops the pairs."""
    steps = lambda batches, first: ((i, batches[i]) for i in range(first, batches.recipe.steps))  # noqa: E731
    patch.setattr(training, "_load_batches", steps)
    return checkpoint.load(training.train_recipe(recipe, out, QUIET))


def losses(run):
    """Return the logged losses by step."""
    events = EventAccumulator(str(run)).Reload()
    return {event.step: event.value for event in events.Scalars("loss")}


def test_two_processes_of_which_one_is_killed_end_with_the_result_of_one_process(folder, monkeypatch):
    recipe = replace(PARTED, name="shared")
    last = folder / "shared" / "last.pt"
    process, log = torchrun(folder, recipe, "--max-restarts", "3")
    while not last.exists() and process.poll() is None:
        time.sleep(0.005)
    kill(process, 1)
    (folder / "changed").mkdir()
    shutil.copy(last, folder / "changed" / "last.pt")
    alone = train_here(recipe, folder / "alone", monkeypatch)
    assert process.wait() == 0, log.read_text()

    shared, killed = checkpoint.load(last), checkpoint.load(folder / "changed" / "last.pt")
    assert (killed.step, shared.step) == (16, 30)
    # Resumed by one process where two had stopped.
    changed = train_here(recipe, folder / "changed", monkeypatch)
    for name in ("weights", "averaged", "scores"):
        assert_same(getattr(shared, name), getattr(alone, name))
        assert_same(getattr(changed, name), getattr(alone, name))
    assert losses(folder / "shared") == losses(folder / "alone")
    assert losses(folder / "alone").keys() == {0, 20}
    # Only rank 0 of the two starts writes; scores are printed once.
    assert len(list((folder / "shared").glob("events.out.*"))) == 2
    assert log.read_text().count("step 30: epe_px") == 1
    assert "RuntimeError" not in log.read_text()


def test_an_error_of_rank_0_alone_ends_all_with_its_one_line(folder):
    """The other ranks, which wait for it, must not report lost connections."""
    (folder / "taken").touch()
    process, log = torchrun(folder, replace(PARTED, name="taken"))
    assert process.wait() == 1
    told = log.read_text()
    assert told.count("stereoweave: ") == 1
    assert f"stereoweave: {folder / 'taken'}: expected a writable folder" in told
    assert "RuntimeError" not in told


def test_a_step_that_cannot_be_divided_among_the_ranks_is_refused_before_anything_is_made(
    tmp_path, monkeypatch
):
    started = {"TORCHELASTIC_RUN_ID": "none", "RANK": "0", "WORLD_SIZE": "3", "LOCAL_WORLD_SIZE": "3"}
    for name, value in started.items():
        monkeypatch.setenv(name, value)
    message = complaint(training.train_recipe, PARTED, tmp_path / "run", QUIET)
    assert message == (
        "tiny: micro-batches per step: expected a multiple of 3, the number of processes, found 4; "
        "set micro_batch or --nproc-per-node"
    )
    assert not list(tmp_path.iterdir())
