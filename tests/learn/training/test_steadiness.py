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


class Scaled(Refinement):
    """Refinement that multiplies the disparity by `slope`."""

    def __init__(self, slope):
        super().__init__(SMALL)
        self.slope = slope

    def forward(self, disparity, *_):
        # A new pixel takes the first of the four old ones around it.
        logits = torch.tensor([80.0, -80.0, -80.0, -80.0]).repeat_interleave(4).view(1, 16, 1, 1)
        height, width = disparity.shape[2:]
        confidence = torch.zeros(2, 1, 2 * height, 2 * width)
        return self.slope * disparity, logits.expand(2, 16, height, width), confidence


@pytest.mark.parametrize(("slope", "expected"), [(0.5, 0), (2.0, 0), (-3.0, 1), (21.0, 19)])
def test_the_amplification_is_the_upsampled_disparity_s_slope_beyond_2(slope, expected):
    network = untrained("weave_small")
    network.refinement = Scaled(slope)
    assert amplification(network) == pytest.approx(expected, rel=0.01, abs=0.01)


class BetweenSurfaces(Refinement):
    """Refinement whose columns lie on two surfaces in turn; the disparity moves the logit of one of them."""

    def __init__(self, step, slope):
        super().__init__(SMALL)
        self.step, self.slope, self.start = step, slope, None

    def forward(self, disparity, *_):
        self.start = disparity if self.start is None else self.start
        surfaces = (torch.arange(48) % 2 * self.step).expand(2, 1, 32, 48)
        # The first and third of the four old pixels around a new one are in the left of their two columns.
        left = torch.tensor([1.0, 0.0, 1.0, 0.0]).repeat_interleave(4).view(1, 16, 1, 1)
        return surfaces, self.slope * (disparity - self.start) * left, torch.zeros(2, 1, 64, 96)


@pytest.mark.parametrize(("step", "slope"), [(200.0, 0.2), (400.0, 0.1), (5.0, 0.2), (200.0, 0.005)])
def test_a_logit_s_slope_counts_times_the_step_between_two_surfaces(step, slope):
    network = untrained("weave_small")
    network.refinement = BetweenSurfaces(step, slope)
    # The sigmoid has a slope of 1/4 at 0, and the mean of two surfaces moves by half the change of a share of
    # one of them. The first and the last column have a single surface around them.
    expected = max(step * slope / 8 - 2, 0) * 94 / 96
    assert amplification(network) == pytest.approx(expected, rel=0.02, abs=1e-3)


@pytest.mark.parametrize("part", ["refinement", "enlargement"])
def test_both_refinements_of_a_network_at_half_the_resolution_count(part):
    network = untrained("weave_half")
    assert amplification(network) < 0.01
    setattr(network, part, Scaled(21))
    assert amplification(network) == pytest.approx(19, rel=0.01)


def test_the_first_upsampling_counts_too():
    network = untrained("weave_base_grown")
    assert amplification(network) < 0.01
    nn.init.normal_(network.weights.weight, std=100)
    assert amplification(network) > 1


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
    network.refinement = Scaled(21)
    objective = WeaveObjective(replace(RECIPE, steadiness=0.25, steadiness_share=0.3))
    found = []
    for seed in range(20):
        torch.manual_seed(seed)
        found.append(objective.losses(objective.predict(network, batch), batch))
    assert 1 <= sum(losses["steadiness"] > 0 for losses in found) <= 12  # 6 in the mean
    assert len({tuple(losses) for losses in found}) == 1


def test_training_lowers_the_amplification():
    network = build_network(replace(RECIPE, model="weave_base_grown")).train()
    nn.init.normal_(network.weights.weight, std=100)
    trained = (*network.completion.parameters(), *network.weights.parameters())
    optimiser = torch.optim.Adam(trained, 0.5)
    found = []
    for _ in range(10):
        _, excess = predict_with_amplification(network, *views())
        optimiser.zero_grad()
        excess.backward()
        for layer in (network.weights, network.completion.decoded):
            assert layer.weight.grad.abs().sum() > 0
        optimiser.step()
        found.append(excess.item())
    assert found[-1] < 0.8 * found[0]
