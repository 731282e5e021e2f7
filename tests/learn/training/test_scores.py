import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from learn_examples import Listed, box_before_a_wall, keep_pairs
from torch import nn

from stereoweave.bench.error_classes import CLASSES
from stereoweave.learn.training.scores import validate, validate_by_class


class Constant(nn.Module):
    """A network that returns 5 px everywhere, with a confidence of 3/4, for views of certain sizes."""

    multiple_of = 16

    def forward(self, left, right):
        assert not any(side % 16 for side in left.shape[2:])
        flat = torch.zeros_like(left[:, :1])
        return flat + 5, flat + 5, flat + math.log(3)


def test_scores_are_those_of_the_left_views(tmp_path):
    # A quarter of each left view is the box at 12 px, the rest the wall at 4 px: errors of 7 and 1 px.
    pairs = keep_pairs(tmp_path, 0, 2)
    scores = validate(Constant(), pairs, torch.device("cpu"))
    expected = {
        "epe_px": 0.25 * 7 + 0.75 * 1,
        "bad1_percent": 25,
        "bad2_percent": 25,
        "d1_percent": 25,
        "calibration_error": 0,  # three quarters are right
    }
    assert scores == pytest.approx(expected, abs=1e-6)


def test_pairs_of_different_sizes_are_scored_whatever_the_network_needs():
    sizes = (33, 70), (48, 96)
    pairs = Listed([box_before_a_wall(np.random.default_rng(0), size) for size in sizes])
    expected = [np.mean(np.abs(5 - sample.disparity_px)) for sample in pairs.samples]
    assert validate(Constant(), pairs, torch.device("cpu"))["epe_px"] == pytest.approx(np.mean(expected))


def test_confidence_is_not_scored_where_the_truth_is_unknown():
    sample = box_before_a_wall(np.random.default_rng(0))
    # Only the box remains, on which all estimates are wrong.
    truth_px = np.where(sample.disparity_px == 4, np.float32("nan"), sample.disparity_px)
    pairs = Listed([replace(sample, disparity_px=truth_px)])
    assert validate(Constant(), pairs, torch.device("cpu"))["calibration_error"] == pytest.approx(0.75)
    # Only the wall remains, on which all are right.
    truth_px = np.where(sample.disparity_px == 4, sample.disparity_px, np.float32("nan"))
    pairs = Listed([replace(sample, disparity_px=truth_px)])
    assert validate(Constant(), pairs, torch.device("cpu"))["calibration_error"] == pytest.approx(0.25)


def test_the_network_is_scored_as_it_will_be_used(tmp_path):
    network = Constant().train()
    validate(network, keep_pairs(tmp_path, 0, 1), torch.device("cpu"))
    assert not network.training


def test_scores_by_class_add_up_and_leave_out_what_the_network_cannot_reach(tmp_path):
    pairs = keep_pairs(tmp_path, 0, 2)
    network = Constant()
    network.max_disparity_px = 192
    scores = validate_by_class(network, pairs, torch.device("cpu"))
    assert scores["epe_px"] == pytest.approx(0.25 * 7 + 0.75 * 1)
    # Only the box, no part of which is occluded, is off by over 1 px.
    assert scores["bad1_percent"] == pytest.approx(25)
    classes = [scores[f"{name}_bad1_percent"] for name in CLASSES]
    assert sum(classes) == pytest.approx(25)
    assert classes[:2] == [0, 0]
    # A network whose range ends at 8 px is scored only on the wall.
    network.max_disparity_px = 8
    assert validate_by_class(network, pairs, torch.device("cpu"))["epe_px"] == pytest.approx(1)
