"""The table of runtimes is checked by measuring the small network again on the runtimes of this machine."""

import csv
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch

from stereoweave.cli import root as cli
from stereoweave.learn import checkpoint
from stereoweave.learn.export import float16 as halve
from stereoweave.learn.export import int8 as quantise
from stereoweave.learn.export import parity
from stereoweave.learn.export.from_checkpoint import load_matcher_network
from stereoweave.matching.matcher import model_file
from stereoweave.matching.providers import open_session

ROOT = Path(__file__).parents[3]
# When other tests run at the same time, two threads spend most of their time waiting for each other.
torch.set_num_threads(1)
# The tests use one pair instead of the table's twelve, which differ in difficulty, and processors with other
# vector instructions round differently.
MARGIN = 3


def rows_of(table):
    with table.open(newline="") as file:
        return [
            parity.ParityRow(**{x.name: x.type(row[x.name]) for x in fields(parity.ParityRow)})
            for row in csv.DictReader(file)
        ]


ROWS = rows_of(ROOT / "results/parity.csv")


def test_the_page_shows_the_rows_as_they_were_measured():
    page = (ROOT / "docs/runtimes.md").read_text()
    for table in sorted((ROOT / "results").glob("parity*.csv")):
        assert parity.format_markdown(rows_of(table)) in page


def test_the_table_has_every_variant_of_every_network():
    found = [(row.network, row.variant) for row in ROWS if row.provider == "cpu"]
    variants = ["float32", "batch of 4", "static 640x480", "fp16", "8-bit"]
    assert found == [(network, variant) for network in ("small", "base") for variant in variants]


def test_float32_differs_from_pytorch_only_by_rounding_and_float16_by_less_than_a_fiftieth_of_a_pixel():
    for row in ROWS:
        if row.provider == "cpu" and row.variant != "8-bit":
            most_px = 0.02 if row.variant == "fp16" else 0.0005
            assert max(row.left_mean_px, row.right_mean_px) < most_px, row


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Return the small network in PyTorch, and the variants of its file, made with few pairs."""
    file = model_file("small")
    kept = checkpoint.load(ROOT / "checkpoints/small.pt")
    with pytest.MonkeyPatch.context() as patch:
        for module in (halve, quantise):
            patch.setattr(module, "_PROOF_PAIRS", 1)
        patch.setattr(quantise, "_RANGES_PAIRS", 2)
        made = parity.make_variants(file, tmp_path_factory.mktemp("variants"))
    return parity.apply_shipped_calibration(load_matcher_network(kept), file), made


def test_variants_on_this_machine_differ_from_pytorch_by_no_more_than_the_table_says(small):
    network, made = small
    views = {size: parity.paint_pairs(size, 1) for size in parity.SIZES[::2]}
    expected = {size: parity.run_in_pytorch(network, x) for size, x in views.items()}
    here = [row for row in ROWS if row.network == "small" and row.provider in parity.list_providers()]
    for row in here:
        variant = made[row.variant]
        size = variant.sizes[0]
        session = open_session(variant.file, row.provider, 1)
        found = {size: parity.run_in_onnx_runtime(session, variant.batch, views[size])}
        for name, value in parity.summarise_differences(expected, found).items():
            # Nearly equal values differ by rounding, which depends on the machine.
            assert value <= MARGIN * getattr(row, name) + 1e-4, (row.variant, row.provider, name)
        assert variant.file.stat().st_size / 1e6 == pytest.approx(row.file_mb, rel=0.02)
    assert {row.variant for row in here} == set(made)


def test_differences_are_over_all_pixels_of_all_sizes():
    def maps(*values):
        return parity.NetworkMaps(*(np.full((1, 1, 1, 2), x, np.float32) for x in values))

    small_size, large_size, left_out = (32, 32), (64, 64), (96, 96)
    expected = {small_size: maps(1, 2, 0.5), large_size: maps(1, 2, 0.5), left_out: maps(9, 9, 9)}
    found = {small_size: maps(2, 2, 0.25), large_size: maps(4, 1, 0.5)}
    assert parity.summarise_differences(expected, found) == {
        "left_mean_px": 2.0,  # of 1 and 3
        "left_max_px": 3.0,
        "right_mean_px": 0.5,  # of 0 and 1
        "right_max_px": 1.0,
        "confidence_mean": 0.125,  # of 0.25 and 0
        "confidence_max": 0.25,
    }


def test_the_command_writes_and_shows_a_row_for_each_variant(tmp_path, monkeypatch, capsys):
    sizes = ((32, 64), (64, 96))
    shipped = parity.MatcherVariant(model_file("small"), 2, sizes)
    made = {"float32": shipped, "one size": shipped._replace(sizes=sizes[1:])}
    for name, value in (("SIZES", sizes), ("_TURNS", 1), ("make_variants", lambda _file, _folder: made)):
        monkeypatch.setattr(parity, name, value)
    out, threads = tmp_path / "parity.csv", torch.get_num_threads()
    assert cli.main(["bench", "parity", str(ROOT / "checkpoints/small.pt"), "-o", str(out)]) == 0
    rows = rows_of(out)
    assert parity.format_markdown(rows) in capsys.readouterr().out
    here = [row for row in rows if row.provider == "cpu"]
    assert [(row.network, row.variant, row.pairs) for row in here] == [
        ("small", "float32", 8), ("small", "one size", 4),
    ]  # fmt: skip
    assert here[0].time_relative == 1
    assert torch.get_num_threads() == threads
    assert 0 < here[0].left_max_px < 0.01


def test_a_network_that_is_not_shipped_has_no_file_to_compare(capsys):
    assert cli.main(["bench", "parity", str(ROOT / "checkpoints/fast_depth.pt")]) == 2
    assert "expected base, small" in capsys.readouterr().err
