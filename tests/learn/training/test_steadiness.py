from dataclasses import replace

import pytest
import torch
from learn_examples import RECIPE, untrained
from torch import nn

from stereoweave.learn.models import build_network
from stereoweave.learn.models.weave import SMALL, Refinement
from stereoweave.learn.training.objective import WeaveObjective
from stereoweave.learn.training.steadiness import predict_with_amplification


def views():
    torch.manual_seed(1)
    return torch.rand(2, 1, 3, 64, 96)


def amplification(network):
    torch.manual_seed(2)
    return predict_with_amplification(network, *views())[1].item()


class Sloped(Refinement):
    """Refinement whose logits are all `slope` times the disparity, in half-resolution pixels."""

    def __init__(self, slope):
        super().__init__(SMALL)
        self.slope = slope

    def forward(self, disparity, *_):
        return disparity, (self.slope * disparity).expand(-1, 16, -1, -1), torch.zeros(2, 1, 64, 96)


@pytest.mark.parametrize(("slope", "expected"), [(0.5, 0), (1.0, 0), (-3.0, 4), (21.0, 400)])
def test_the_amplification_is_the_square_of_a_logit_s_slope_beyond_1(slope, expected):
    network = untrained("weave_small")
    network.refinement = Sloped(slope)
    assert amplification(network) == pytest.approx(expected, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("part", ["refinement", "enlargement"])
def test_the_amplification_of_both_refinements_of_a_network_at_half_the_resolution_counts(part):
    network = untrained("weave_half")
    for refinement in network.refinements:
        nn.init.zeros_(refinement.weights.weight)
    nn.init.zeros_(network.weights.weight)
    assert amplification(network) == 0
    nn.init.constant_(getattr(network, part).weights.weight, 1000.0)
    assert amplification(network) > 1


def test_the_amplification_before_the_first_upsampling_counts_too():
    network = untrained("weave_base_grown")
    nn.init.zeros_(network.refinement.weights.weight)
    without = amplification(network)
    nn.init.zeros_(network.weights.weight)
    assert amplification(network) == 0
    nn.init.constant_(network.weights.weight, 1.0)
    assert amplification(network) > max(without, 1)


def test_the_stages_are_those_of_a_prediction_without_the_amplification():
    network = untrained("weave_base_grown")
    stages, _ = predict_with_amplification(network, *views())
    assert torch.equal(stages.disparity_px, network.stages(*views()).disparity_px)


@pytest.mark.parametrize("name", ["weave_small", "weave_base_grown", "weave_half"])
def test_batch_norms_record_one_pass(name):
    plain, measured = untrained(name).train(), untrained(name).train()
    plain.stages(*views())
    predict_with_amplification(measured, *views())
    for expected, found in zip(plain.buffers(), measured.buffers(), strict=True):
        assert torch.equal(found, expected)


def known_batch():
    left, right = views()
    truth_px = torch.full((2, 1, 64, 96), 5.0)
    return {"left": left, "right": right, "disparity_px": truth_px, "occluded": truth_px < 0}


def test_the_loss_of_a_recipe_has_the_amplification_only_if_it_asks_for_it():
    network, batch = untrained("weave_small"), known_batch()
    plain = WeaveObjective(RECIPE)
    assert "steadiness" not in plain.losses(plain.predict(network, batch), batch)
    steady = WeaveObjective(replace(RECIPE, steadiness=0.25))
    predicted = steady.predict(network, batch)
    assert steady.losses(predicted, batch)["steadiness"] == 0.25 * predicted.amplification


def test_a_share_of_the_micro_batches_has_the_loss():
    network, batch = untrained("weave_small"), known_batch()
    nn.init.constant_(network.refinement.weights.weight, 1000.0)
    objective = WeaveObjective(replace(RECIPE, steadiness=0.25, steadiness_share=0.3))
    found = []
    for seed in range(20):
        torch.manual_seed(seed)
        found.append(objective.losses(objective.predict(network, batch), batch))
    assert 1 <= sum(losses["steadiness"] > 0 for losses in found) <= 12  # 6 in the mean
    assert len({tuple(losses) for losses in found}) == 1


def test_training_lowers_the_amplification():
    network = build_network(replace(RECIPE, model="weave_small")).train()
    nn.init.constant_(network.refinement.weights.weight, 2.0)
    optimiser = torch.optim.Adam(network.refinement.parameters(), 0.05)
    found = []
    for _ in range(10):
        _, excess = predict_with_amplification(network, *views())
        optimiser.zero_grad()
        excess.backward()
        optimiser.step()
        found.append(excess.item())
    assert found[-1] < 0.5 * found[0]
