import copy

import numpy as np
import pytest
import torch
from learn_examples import PAIR_SIZE, box_before_a_wall, overfitted

from stereoweave.io.images import read_image
from stereoweave.learn.data.batches import collate
from stereoweave.learn.export import confidence as calibrate


@pytest.fixture
def few_small_pairs(monkeypatch):
    monkeypatch.setattr(calibrate, "_PAIRS", 1)
    monkeypatch.setattr(calibrate, "_SIZE", PAIR_SIZE)


@pytest.mark.parametrize(("scale", "shift"), [(1.0, 0.0), (0.4, -1.0), (2.5, 0.7)])
def test_the_fit_recovers_a_known_scale_and_shift(scale, shift):
    generator = torch.Generator().manual_seed(0)
    logits = 2 * torch.randn(100_000, generator=generator)
    within = torch.rand(100_000, generator=generator) < (scale * logits + shift).sigmoid()
    assert calibrate._fit_scale_and_shift(logits, within) == pytest.approx((scale, shift), abs=0.05)


def test_reliability_compares_claimed_with_observed_probability():
    probability = np.array([0.11, 0.13, 0.95, 1.0, 0.95, 0.9])
    happened = np.array([False, True, True, True, True, False])
    found = calibrate.measure_reliability(probability, happened)
    assert found["bins"] == [
        {"claimed": 0.12, "happened": 0.5, "share": 0.3333},
        {"claimed": 0.9, "happened": 0.0, "share": 0.1667},
        {"claimed": 0.9667, "happened": 1.0, "share": 0.5},
    ]
    # The error of the same bins is (2 * 0.38 + 1 * 0.9 + 3 * 0.0333) / 6.
    assert found["calibration_error"] == 0.2933


def test_reliability_of_honest_claims_has_no_error():
    probability = np.full(8, 0.75, np.float32)
    happened = np.arange(8) % 4 != 0
    found = calibrate.measure_reliability(probability, happened)
    assert found == {
        "calibration_error": 0.0,
        "bins": [{"claimed": 0.75, "happened": 0.75, "share": 1.0}],
    }


@pytest.mark.usefixtures("few_small_pairs")
@pytest.mark.parametrize("name", ["weave_small", "weave_half"])
def test_calibration_scales_and_shifts_the_confidence_and_leaves_the_disparity(name):
    network = overfitted(name).network
    calibrated = copy.deepcopy(network)
    proof = calibrate.calibrate_confidence(calibrated)
    assert 0 <= proof["calibration_error"] <= 1
    assert sum(row["share"] for row in proof["bins"]) == pytest.approx(1, abs=0.01)
    batch = collate([box_before_a_wall(np.random.default_rng(0))])
    with torch.no_grad():
        before_px, _, before = network(batch["left"], batch["right"])
        after_px, _, after = calibrated(batch["left"], batch["right"])
    torch.testing.assert_close(after_px, before_px)
    scale, shift = calibrate._fit_scale_and_shift(*calibrate._predict_claims(network, calibrate._FIT_SEED))
    torch.testing.assert_close(after, before * scale + shift, atol=1e-3, rtol=1e-3)


@pytest.mark.usefixtures("few_small_pairs")
def test_the_unseen_pair_differs_from_those_of_the_fit_and_the_proof():
    unseen = calibrate.paint_unseen_pair()
    for seed in (calibrate._FIT_SEED, calibrate._PROOF_SEED):
        assert (calibrate.paint_collage(seed, 0, 0, *PAIR_SIZE).left != unseen.left[:64, :96]).mean() > 0.5


def test_the_reliability_plot_is_a_picture(tmp_path):
    bins = [
        {"claimed": 0.15, "happened": 0.2, "share": 0.4},
        {"claimed": 0.9, "happened": 0.85, "share": 0.6},
    ]
    calibrate.draw_reliability({"calibration_error": 0.05, "bins": bins}, tmp_path / "plot.png")
    picture = read_image(tmp_path / "plot.png")
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 10
