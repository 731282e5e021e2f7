import csv
import json
from dataclasses import asdict, replace

import pytest
import torch
from learn_examples import (
    RECIPE,
    checkpoint_of,
    complaint,
    keep_pairs,
    untrained,
    write,
    write_box_set,
)
from rich.console import Console

from stereoweave.cli.root import main
from stereoweave.learn import checkpoint
from stereoweave.learn.data.pair_cache import CachedPairs
from stereoweave.learn.data.sources import VALIDATION_SEED
from stereoweave.learn.training.curves import fit_power_law, record_curve, record_network
from stereoweave.learn.training.loop import SCORES_FILE, append_scores
from stereoweave.learn.training.scores import validate
from stereoweave.learn.training.timed_run import NETWORK_FILE, PROGRESS_FILE, RunProgress


@pytest.fixture
def run(tmp_path):
    """Write a run with batches of 2 and five scores: bad-1 falls with the pairs, the EPE of rooms rises."""
    run = tmp_path / "weave_tiny"
    run.mkdir()
    checkpoint.save(checkpoint_of(untrained()), run / "last.pt")
    for step in (500, 1000, 2000, 4000, 8000):
        share = 2 * step / 10_000
        scores = {"epe_px": 2.0, "bad1_percent": 20 * share**-0.25, "rooms_epe_px": 8 * share**0.1}
        append_scores(run / SCORES_FILE, step, scores)
    return run


def test_a_power_law_is_found_again():
    pairs = [1e3, 1e4, 4e4]
    assert fit_power_law(pairs, [12 * (p / 1e4) ** -0.2 for p in pairs]) == pytest.approx((12, 0.2))


def test_a_curve_is_written_against_the_pairs_seen_and_fitted(run, tmp_path):
    fits = record_curve(run, tmp_path / "curve.csv")
    assert fits["bad1_percent"] == pytest.approx((20, 0.25), abs=1e-4)
    assert fits["epe_px"] == pytest.approx((2, 0), abs=1e-4)
    with (tmp_path / "curve.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["pairs"] for row in rows] == ["1000", "2000", "4000", "8000", "16000"]
    assert rows[0]["recipe"] == "weave_tiny"
    assert rows[0]["commit"] == "0123abc"
    assert float(rows[0]["bad1_percent"]) == pytest.approx(20 * 0.1**-0.25, abs=1e-4)


def test_rows_of_other_runs_stay_and_those_of_the_run_are_replaced(run, tmp_path):
    out = tmp_path / "curve.csv"
    out.write_text("recipe,step,epe_px\nearlier,200,3.5\nweave_tiny,7,9.9\n")
    for _ in range(2):
        record_curve(run, out)
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["recipe"] for row in rows] == ["earlier"] + 5 * ["weave_tiny"]
    assert (rows[0]["epe_px"], rows[0]["pairs"]) == ("3.5", "")


def test_a_run_without_scores_is_named(tmp_path):
    checkpoint.save(checkpoint_of(untrained(), RECIPE), tmp_path / "last.pt")
    message = complaint(record_curve, tmp_path, tmp_path / "curve.csv")
    assert message.startswith(f"{tmp_path / SCORES_FILE}: expected scores of a run, found none")


def test_the_command_prints_the_fits(run, tmp_path, capsys):
    assert main(["bench", "training", str(run), "-o", str(tmp_path / "curve.csv")]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert "bad1_percent: 20 * (pairs / 10,000)^-0.250" in printed
    assert "rooms_epe_px: 8 * (pairs / 10,000)^0.100" in printed


@pytest.fixture
def timed_run(tmp_path):
    """Write a timed run of 7 steps and 21 pairs."""
    run = tmp_path / "on_a_gpu"
    run.mkdir()
    checkpoint.save(checkpoint_of(untrained()), run / NETWORK_FILE)
    progress = RunProgress(seconds=60, steps=7, optimiser_steps=7, pairs=21)
    (run / PROGRESS_FILE).write_text(json.dumps(asdict(progress)))
    return run


def test_a_timed_run_has_the_scores_of_its_network_and_the_pairs_of_its_progress(timed_run, tmp_path):
    out = tmp_path / "curve.csv"
    out.write_text("recipe,step,epe_px\nearlier,7,3.5\non_a_gpu,2,8.8\non_a_gpu,7,9.9\n")
    boxes = write_box_set(tmp_path / "boxes")
    recipe = replace(RECIPE, mix=(("not_here", 1.0),), held_out=(("boxes", str(boxes)),))
    scores = record_network(timed_run, recipe, tmp_path / "pairs", out, Console(quiet=True))
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["recipe"], row["step"], row["pairs"]) for row in rows] == [
        ("earlier", "7", ""),
        ("on_a_gpu", "2", ""),
        ("on_a_gpu", "7", "21"),
    ]
    held_out = CachedPairs(tmp_path / "pairs", VALIDATION_SEED, 2, RECIPE.pair_size)
    expected = validate(untrained(), held_out, torch.device("cpu"))
    assert expected.items() <= scores.items()
    assert float(rows[-1]["boxes_bad1_percent"]) == pytest.approx(scores["boxes_bad1_percent"], abs=1e-5)


def test_the_command_scores_a_timed_run_with_a_recipe(timed_run, tmp_path, capsys):
    keep_pairs(tmp_path / "pairs", VALIDATION_SEED, RECIPE.validation_pairs)
    recipe = write(RECIPE, tmp_path / "tiny.toml")
    line = ["bench", "training", str(timed_run), "--recipe", str(recipe), "-o", str(tmp_path / "curve.csv")]
    assert main(line) == 0
    assert "bad1_percent: " in capsys.readouterr().out
    assert "on_a_gpu,7,21" in (tmp_path / "curve.csv").read_text()


def test_a_timed_run_needs_a_recipe(timed_run, tmp_path, capsys):
    curve = tmp_path / "curve.csv"
    message = f"{timed_run}: expected a recipe for a run of recipes/gpu/train.py, found none; "
    advice = "give the recipe of its held-out pairs"
    assert complaint(record_curve, timed_run, curve) == f"{message}{advice} (recipe)"
    assert main(["bench", "training", str(timed_run), "-o", str(curve)]) == 2
    assert f"{message}{advice} (--recipe)" in capsys.readouterr().err


def test_a_checkpoint_has_the_scores_of_its_network_and_the_pairs_of_its_recipe(tmp_path, capsys):
    network, curve = tmp_path / "kept.pt", tmp_path / "curve.csv"
    checkpoint.save(checkpoint_of(untrained()), network)
    pairs = keep_pairs(tmp_path / "collages", VALIDATION_SEED, RECIPE.validation_pairs)
    recipe = write(RECIPE, tmp_path / "tiny.toml")
    line = ["bench", "training", str(network), "-o", str(curve)]
    assert main([*line, "--recipe", str(recipe), "--pairs", str(tmp_path / "collages")]) == 0
    with curve.open(newline="") as file:
        (row,) = csv.DictReader(file)
    # 20 steps with batches of 2.
    assert (row["recipe"], row["step"], row["pairs"]) == ("kept", "20", "40")
    expected = validate(untrained(), pairs, torch.device("cpu"))
    assert float(row["epe_px"]) == pytest.approx(expected["epe_px"], abs=1e-5)
    capsys.readouterr()
    assert main(line) == 2
    message = f"{network}: expected a recipe for a network, found none"
    assert message in capsys.readouterr().err
    assert main([*line, "--pairs", "collages"]) == 2
    assert "--pairs: expected only with --recipe" in capsys.readouterr().err
