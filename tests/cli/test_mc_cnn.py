"""`stereoweave bench pairs --mc-cnn`."""

import csv
import pickle

import numpy as np
import pytest
import torch
from shard_examples import box_before_a_wall

from stereoweave.bench.opencv_matchers import OPENCV_MATCHERS
from stereoweave.cli.root import main
from stereoweave.data.packing import pack
from stereoweave.data.shards import write_shard
from stereoweave.learn.mc_cnn_matcher import STEPS
from stereoweave.learn.models.mc_cnn import MCCNN


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Work in a folder with a set of one pair, and files of random weights."""
    threads = torch.get_num_threads()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    write_shard(
        tmp_path / "ship", "ship", 0, [pack(box_before_a_wall(np.random.default_rng(0), (96, 64)), {})]
    )
    torch.manual_seed(0)
    for name in ("random", "3dmst", "base"):
        torch.save({"model": MCCNN().state_dict()}, tmp_path / f"{name}.pt")
    yield tmp_path
    torch.set_num_threads(threads)


def test_mc_cnn_has_a_row_for_each_set_of_steps_beside_opencv_s_matchers(folder, monkeypatch):
    made = []

    def measure(make, _):
        # Another process makes the matcher, for which it is pickled.
        made.append(pickle.loads(pickle.dumps(make)))
        return 1.0

    monkeypatch.setattr("stereoweave.bench.pairs.peak_memory_mb", measure)
    monkeypatch.setattr("stereoweave.bench.pairs.TURNS", 1)
    assert main(["bench", "pairs", "ship", "--mc-cnn", "random.pt", "-o", "rows.csv", "--threads", "1"]) == 0
    with (folder / "rows.csv").open() as file:
        means = {row["matcher"]: row for row in csv.DictReader(file) if row["scene"] == "mean"}
    assert list(means) == [*OPENCV_MATCHERS, *(f"random{steps}" for steps in STEPS)]
    assert len(made) == len(means)
    assert torch.get_num_threads() == 1
    # Both views show the same noise, which random vectors match too, where both cameras see it.
    for name in ("random raw", "random", "random aggregated"):
        assert float(means[name]["bad1_percent"]) < 60
        assert means[name]["calibration_error"] == "nan"


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("--mc-cnn missing.pt", "missing.pt: expected MC-CNN's weights, found no such file"),
        ("--mc-cnn ship", "ship: expected MC-CNN's weights in a PyTorch file, found "),
        ("--mc-cnn random.pt --mc-cnn ./random.pt", "random: expected weight files of different names"),
        ("--mc-cnn 3dmst.pt --matchers 3dmst", "3dmst: expected a name that no other row of the table uses"),
        ("--mc-cnn base.pt --model base", "base: expected a name that no other row of the table uses"),
    ],
)
def test_a_mistake_is_reported_in_one_line_before_anything_is_measured(folder, capfd, options, expected):
    assert main(f"bench pairs ship {options} -o rows.csv".split()) == 2
    printed, told = capfd.readouterr()
    assert printed == ""
    (line,) = told.splitlines()
    assert expected in line
    assert not (folder / "rows.csv").exists()
