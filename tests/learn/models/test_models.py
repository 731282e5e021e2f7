"""Tests that every network in MODELS must pass."""

from functools import cache

import numpy as np
import pytest
import torch
from learn_examples import box_before_a_wall, recipe_of, untrained
from torch import nn

from stereoweave.errors import FormatError
from stereoweave.learn.data.batches import collate
from stereoweave.learn.models import MODELS, CodeNetwork, build_network
from stereoweave.learn.training.objective import build_objective

PARAMETERS = {
    "weave_small": 278_029,
    "weave_base": 1_274_290,
    "weave_base_grown": 1_466_405,
    "weave_half": 761_602,
    "fast_depth": 314_722,
    "fast_depth_without_skips": 301_858,
    "densemapnet": 290_290,
    "dispnet": 42_174_022,
    "psmnet": 5_224_768,
    "mc_cnn": 148_352,
    "scvnet": 2_315_654,
    "ganet_11": 4_483_728,
    # As the published code, less a layer without use: 8 * 8 * 48 + 16 * 8 * 27 and two batch norms of 8.
    "ganet_deep": 6_580_112 - 6_560,
}
CODE_NETWORKS = [name for name in MODELS if not name.startswith(("weave", "mc_cnn"))]
# Loss, learning rate and steps with which each network overfits one pair. GA-Net-deep, which takes twice as
# long, has the layers of GA-Net-11.
LEARNS = {
    "fast_depth": ("l2", 2e-3, 20),
    "fast_depth_without_skips": ("l2", 2e-3, 20),
    "densemapnet": ("l2", 2e-3, 20),
    "dispnet": ("l1", 3e-4, 25),
    "psmnet": ("l2", 2e-3, 16),
    "scvnet": ("l1", 2e-3, 20),
    "ganet_11": ("l1", 5e-3, 10),
}


@cache
def random_network(name):
    """Return a network that all tests share and must not change; drawing DispNet's weights takes 0.5 s."""
    return untrained(name)


def random_pair(batch, height, width):
    torch.manual_seed(1)
    return torch.rand(batch, 3, height, width), torch.rand(batch, 3, height, width)


def outputs_of(network, pair):
    """Return all outputs that training supervises."""
    return network.outputs(*pair) if isinstance(network, CodeNetwork) else network(*pair)


@pytest.fixture(params=MODELS)
def name(request):
    return request.param


@pytest.mark.parametrize("size", [(37, 53), (16, 24), (1, 90)])
@pytest.mark.parametrize("name", CODE_NETWORKS)
def test_any_size_gives_an_answer_of_that_size(name, size):
    network = random_network(name).eval()
    with torch.no_grad():
        answer = network(*random_pair(1, *size))
    assert answer.shape == (1, 1, *size)
    assert answer.dtype == torch.float32
    assert answer.isfinite().all()


@pytest.mark.parametrize("name", CODE_NETWORKS)
def test_each_output_has_its_weight_and_the_last_one_is_the_answer(name):
    network = random_network(name).eval()
    assert isinstance(network, CodeNetwork)
    pair = random_pair(1, 32, 64)
    with torch.no_grad():
        outputs, answer = network.outputs(*pair), network(*pair)
    assert len(outputs) == len(network.output_weights)
    torch.testing.assert_close(outputs[-1], answer)
    assert network.predicts in ("code", "disparity_px")
    if network.predicts == "code":
        assert 0 < answer.min() < answer.max() < 1


def test_each_parameter_gets_a_gradient(name):
    network = untrained(name).train()
    for parameter in network.parameters():
        # A layer of zeros, which adds nothing until it is trained, blocks the gradient of earlier layers.
        if not parameter.any():
            nn.init.normal_(parameter, std=0.1)
    maps = outputs_of(network, random_pair(2, 32, 64))
    torch.stack([(values * torch.rand_like(values)).sum() for values in maps]).sum().backward()
    for parameter_name, parameter in network.named_parameters():
        assert parameter.grad is not None, parameter_name
        assert parameter.grad.isfinite().all(), parameter_name
        assert parameter.grad.any(), parameter_name


def test_the_result_of_a_pair_does_not_depend_on_the_others_in_its_batch(name):
    network = random_network(name).eval()
    left, right = random_pair(3, 32, 64)
    with torch.no_grad():
        among_some = outputs_of(network, (left[:2], right[:2]))
        among_others = outputs_of(network, (left[::2], right[::2]))
    for one, other in zip(among_some, among_others, strict=True):
        torch.testing.assert_close(one[0], other[0], atol=1e-4, rtol=1e-4)
        assert (one[1] - other[1]).abs().max() > 1e-3


def test_the_network_has_its_published_number_of_parameters(name):
    count = sum(parameter.numel() for parameter in random_network(name).parameters())
    assert count == PARAMETERS[name]
    assert f"{count:,} parameters" in type(random_network(name)).__doc__


@pytest.mark.parametrize("name", [name for name in CODE_NETWORKS if name != "ganet_deep"])
def test_the_network_overfits_one_pair(name):
    loss, learning_rate, steps = LEARNS[name]
    recipe = recipe_of(name, loss=loss, max_disparity_px=16.0)
    torch.manual_seed(0)
    # In training mode, because the running mean of Keras's batch norm lags 100 steps behind; without dropout.
    network = build_network(recipe).train()
    for layer in network.modules():
        if isinstance(layer, nn.Dropout):
            layer.p = 0.0
    if name == "dispnet":
        # These parts hold nine tenths of the weights and are slow to train, but see at most 4x4 pixels here.
        for part in (network.conv4, network.conv5, network.conv6, *network.expansions[:2]):
            part.requires_grad_(False)
    objective = build_objective(recipe, network)
    batch = collate([box_before_a_wall(np.random.default_rng(0), recipe.crop_size)])
    trained = [parameter for parameter in network.parameters() if parameter.requires_grad]
    optimiser = torch.optim.Adam(trained, learning_rate, fused=True)
    errors_px = []
    for _ in range(steps):
        predicted = objective.predict(network, batch)
        found_px = objective.disparity_px(predicted[-1], batch)
        errors_px.append(float((found_px - batch["disparity_px"][:1]).abs().mean().detach()))
        optimiser.zero_grad()
        torch.stack(list(objective.losses(predicted, batch).values())).sum().backward()
        optimiser.step()
    # A box at 12 px covers a quarter of a wall at 4 px, so the best constant has an error of 2 px.
    assert errors_px[-1] < 1.5 < 2 < errors_px[0]


def test_psmnet_has_the_number_of_candidates_of_the_recipe():
    assert build_network(recipe_of("psmnet", max_disparity_px=64.0)).max_disparity_px == 64


def test_the_error_for_an_unknown_network_lists_the_known_ones():
    with pytest.raises(FormatError) as caught:
        build_network(recipe_of("spider"))
    assert str(caught.value) == (
        "tiny: model = 'spider', expected one of weave_small, weave_base, weave_base_grown, weave_half, "
        "fast_depth, fast_depth_without_skips, densemapnet, dispnet, psmnet, mc_cnn, scvnet, ganet_11, "
        "ganet_deep"
    )
