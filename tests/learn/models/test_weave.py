"""Tests of WeaveNet's design, in addition to the tests of every network in test_models.py."""

from dataclasses import replace

import pytest
import torch
from learn_examples import overfitted, random_pair, untrained

from stereoweave.learn.export.from_checkpoint import count_multiply_adds
from stereoweave.learn.models.weave import BASE, BASE_GROWN, WeaveNet
from stereoweave.learn.models.weave_stages import OFFSETS, Completion
from stereoweave.learn.training.losses import weave_losses


@pytest.mark.parametrize("size", [(16, 16), (32, 32), (16, 112), (48, 80), (112, 32)])
def test_any_size_that_is_a_multiple_of_16_gives_maps_of_that_size(size):
    with torch.no_grad():
        maps = untrained()(*random_pair(1, *size))
    assert len(maps) == 3
    for values in maps:
        assert values.shape == (1, 1, *size)
        assert values.dtype == torch.float32
        assert values.isfinite().all()


@pytest.mark.parametrize(
    ("name", "most"), [("weave_small", 3e9), ("weave_base", 16e9), ("weave_base_grown", 16e9)]
)
def test_the_whole_graph_of_both_views_takes_no_more_multiply_adds_than_promised(name, most):
    count = count_multiply_adds(untrained(name))
    assert count <= most
    assert f"{count / 1e9:.2f} G multiply-adds" in WeaveNet.__doc__


def test_a_network_that_grows_gives_the_same_results_until_it_is_trained_further():
    torch.manual_seed(0)
    before = WeaveNet(replace(BASE, convolutions=(1, 2, 2, 2), propagation=0, refinement=2)).eval()
    grown = WeaveNet(BASE).eval()
    shared = before.state_dict()
    assert len(shared) < len(grown.state_dict())
    grown.load_state_dict(grown.state_dict() | shared)
    pair = random_pair(1, 48, 80)
    with torch.no_grad():
        for found, expected in zip(grown(*pair), before(*pair), strict=True):
            torch.testing.assert_close(found, expected, atol=1e-3, rtol=0)


def test_the_network_overfits_one_pair():
    trained = overfitted()
    assert trained.error_after_px < 1
    assert trained.error_after_px < trained.error_before_px / 5


def test_a_disparity_below_zero_becomes_zero():
    network = untrained()
    # The coarse estimate stays near 0 px, and the refinement subtracts 2 px at half resolution.
    torch.nn.init.zeros_(network.refinement.scores.weight)
    with torch.no_grad():
        network.aggregation.scores.bias[0] = 1e4
        network.refinement.scores.bias[0] = 1e4
        pair = random_pair(1, 32, 64)
        assert network.stages(*pair).disparity_px.max() < 0
        for values in network(*pair)[:2]:
            assert (values == 0).all()


def test_forty_eight_levels_reach_192_px():
    assert untrained().max_disparity_px == 192


@pytest.mark.parametrize("part", ["wider", "completion"])
def test_each_optional_stage_changes_nothing_until_it_is_trained(part):
    torch.manual_seed(0)
    before = WeaveNet(BASE).eval()
    grown = WeaveNet(replace(BASE, **{part: getattr(BASE_GROWN, part)})).eval()
    grown.load_state_dict(grown.state_dict() | before.state_dict())
    pair = random_pair(1, 64, 96)
    with torch.no_grad():
        for found, expected in zip(grown(*pair), before(*pair), strict=True):
            assert torch.equal(found, expected)


def test_every_stage_of_a_grown_network_learns():
    """Train in bfloat16, in which oneDNN's gradients of some convolutions are not finite."""
    torch.manual_seed(0)
    network = WeaveNet(BASE_GROWN).train()
    left, right = random_pair(2, 64, 96)
    truth_px = torch.full((4, 1, 64, 96), 9.0)
    for _ in range(4):  # a layer of zeros passes on a gradient only after its first step
        with torch.autocast("cpu", torch.bfloat16):
            stages = network.stages(left, right)
        terms = weave_losses(stages, truth_px, torch.zeros_like(truth_px, dtype=torch.bool))
        network.zero_grad()
        sum(terms.values()).backward()
        assert all(parameter.grad.isfinite().all() for parameter in network.parameters())
        with torch.no_grad():
            for parameter in network.parameters():
                parameter -= 1e-2 * parameter.grad
    grown_by = ("completion.", "aggregation.context.wider.")
    for name, parameter in network.named_parameters():
        assert not name.startswith(grown_by) or parameter.grad.any(), name


def test_a_completion_takes_the_surface_that_its_affinities_point_to():
    """Complete a hole of 3 columns in a wall at 2, with affinities for the pixel 8 columns to the left."""
    torch.manual_seed(0)
    completion = Completion(quarter=4, channels=8).eval()
    disparity = torch.full((1, 1, 6, 24), 2.0)
    disparity[..., 12:15] = 7.0
    with torch.no_grad():
        completion.affinity.weight.zero_()
        completion.affinity.bias.fill_(-1e4)
        completion.affinity.bias[OFFSETS.index((0, -8))] = 0
        completion.share.bias.fill_(100.0)
        found, decoded = completion(
            disparity, torch.full_like(disparity, 2.0), torch.rand(1, 4, 6, 24), torch.rand(1, 32, 6, 24)
        )
    assert found[..., 12:15].tolist() == [[[[2.0] * 3] * 6]]
    assert found[..., 20:23].tolist() == [[[[7.0] * 3] * 6]]
