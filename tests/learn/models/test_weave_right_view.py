"""Tests of the right view that a WeaveNet estimates beside the left one."""

import pytest
import torch
from learn_examples import random_pair, untrained
from torch import nn

from stereoweave.learn.models.layers import mirror
from stereoweave.learn.models.weave import BASE_GROWN, WeaveNet
from stereoweave.learn.models.weave_half import WeaveHalfNet


def grown() -> WeaveNet:
    """Return a network whose completion changes the results, unlike that of a new one."""
    torch.manual_seed(0)
    network = WeaveNet(BASE_GROWN).eval()
    nn.init.normal_(network.completion.share.weight, std=0.5)
    return network


NETWORKS = {"small": untrained, "grown": grown, "half": lambda: untrained("weave_half")}


@pytest.fixture(params=NETWORKS)
def network(request) -> WeaveNet | WeaveHalfNet:
    return NETWORKS[request.param]()


def test_in_training_a_mirrored_pair_gives_mirrored_results(network):
    """Use mirror-symmetric features, with which the results are mirrored exactly."""
    # In double precision, because rounding could decide between two levels that match equally well.
    network.double()
    encoders = [part for name, part in network.named_children() if name in ("encoder", "stem")]
    with torch.no_grad():
        for layer in (layer for encoder in encoders for layer in encoder.modules()):
            if isinstance(layer, nn.Conv2d):
                layer.weight += mirror(layer.weight.clone())
        left, right = (image.double() for image in random_pair(1, 64, 96))
        left_px, right_px = network.stages(left, right).disparity_px
        mirrored_right_px, mirrored_left_px = network.stages(mirror(right), mirror(left)).disparity_px
    # The stages of a right view are mirrored.
    torch.testing.assert_close(left_px, mirrored_left_px, atol=1e-3, rtol=0)
    torch.testing.assert_close(right_px, mirrored_right_px, atol=1e-3, rtol=0)
    assert (left_px - right_px).abs().max() > 0.1


def test_the_left_view_is_refined_as_in_the_stages_and_the_right_one_is_their_coarse_disparity(network):
    pair = random_pair(2, 64, 96)
    with torch.no_grad():
        stages = network.stages(*pair)
        left_px, right_px, logit = network(*pair)
    torch.testing.assert_close(left_px, stages.disparity_px[:2].clamp(min=0))
    torch.testing.assert_close(logit, stages.confidence_logit[:2])
    # The stages of a right view are mirrored. Each of its pixels at half the resolution becomes 2x2.
    assert stages.coarse_px.shape == (4, 1, 32, 48)
    coarse_px = mirror(stages.coarse_px[2:]).clamp(min=0)
    assert torch.equal(right_px, coarse_px.repeat_interleave(2, 2).repeat_interleave(2, 3))


@pytest.mark.parametrize(("name", "cell_px"), [("weave_small", 4), ("weave_half", 8)])
def test_the_scores_of_both_views_are_at_the_resolution_of_the_levels(name, cell_px):
    network = untrained(name)
    with torch.no_grad():
        stages = network.stages(*random_pair(2, 64, 96))
    assert stages.correlation.shape == stages.scores.shape == (4, 48, 64 // cell_px, 96 // cell_px)
