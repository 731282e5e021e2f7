"""Each variant of SMALL differs from it in what its name says, and in nothing else."""

import pytest
import torch
from learn_examples import untrained
from torch import nn

from experiments.ablations.networks import VARIANTS, register_variants, soft_argmax, upsample_bilinear
from stereoweave.learn.models.layers import local_soft_argmax
from stereoweave.learn.training.losses import weave_losses

CONTEXT = "aggregation.context"
# Parts that only one of the two networks has, or that have another shape.
DIFFERENT = {
    "weave_small_eighth": {"to_match", "aggregation.down", "aggregation.join", "aggregation.scores",
                           "weights_of_eighth"},
    "weave_small_grouped": {"aggregation.down", "aggregation.join"},
    "weave_small_all_levels": set(),
    "weave_small_undilated": set(),
    "weave_small_without_dense": {"aggregation.dense", "aggregation.bottleneck", f"{CONTEXT}.down"},
    "weave_small_without_context": {f"{CONTEXT}.{part}" for part in ("down", "join", "body", "up")},
    "weave_small_bilinear": {"weights", "refinement.weights"},
    "weave_small_nine_neighbours": {"weights", "refinement.weights"},
    "weave_small_looked_up": {"to_match_half", "to_half", "refinement.join"},
}  # fmt: skip


@pytest.fixture(autouse=True)
def registered():
    """Let recipes name the variants."""
    register_variants()


@pytest.fixture(params=VARIANTS)
def name(request):
    return request.param


def shapes(network):
    return {name: tuple(value.shape) for name, value in network.state_dict().items()}


def alike(name):
    """Return the variant and SMALL, with equal weights wherever both have them."""
    variant, small = untrained(name), untrained()
    small_shapes = shapes(small)
    shared = {k: v for k, v in variant.state_dict().items() if small_shapes.get(k) == tuple(v.shape)}
    small.load_state_dict(shared, strict=False)
    return variant, small


def stages_of(network, height=32, width=64):
    torch.manual_seed(1)
    with torch.no_grad():
        return network.stages(*torch.rand(2, 2, 3, height, width))


def test_a_variant_has_other_parameters_only_where_its_name_says(name):
    ours, small = shapes(untrained(name)), shapes(untrained())
    different = {key for key in ours.keys() | small.keys() if ours.get(key) != small.get(key)}
    parts = DIFFERENT[name]
    assert {part for part in parts if any(key.startswith(f"{part}.") for key in different)} == parts
    assert [key for key in different if not key.startswith(tuple(f"{part}." for part in parts))] == []


def test_a_variant_gives_finite_maps_of_the_pictures_size_that_are_not_those_of_small(name):
    variant, small = alike(name)
    if name == "weave_small_without_context":
        # At initialisation, it adds nothing.
        nn.init.normal_(small.aggregation.context.up.weight)
    torch.manual_seed(1)
    pair = torch.rand(2, 2, 3, 32, 64)
    with torch.no_grad():
        maps, small_maps = variant(*pair), small(*pair)
    for values in maps:
        assert values.shape == (2, 1, 32, 64)
        assert values.isfinite().all()
    # With the same weights, the same computation would give the same bits.
    assert not torch.equal(maps[0], small_maps[0])
    assert variant.max_disparity_px == small.max_disparity_px == 192


def test_every_parameter_of_a_variant_gets_a_gradient_from_the_loss(name):
    network = untrained(name).train()
    for parameter in network.parameters():
        if not parameter.any():
            nn.init.normal_(parameter, std=0.1)
    torch.manual_seed(1)
    stages = network.stages(*torch.rand(2, 2, 3, 64, 96))
    truth_px = 20 * torch.rand(4, 1, 64, 96)
    losses = weave_losses(stages, truth_px, torch.zeros(4, 1, 64, 96, dtype=torch.bool))
    torch.stack(list(losses.values())).sum().backward()
    for parameter_name, parameter in network.named_parameters():
        assert parameter.grad is not None, parameter_name
        assert parameter.grad.isfinite().all(), parameter_name
        assert parameter.grad.any(), parameter_name


def test_all_levels_expect_a_surface_between_two_where_the_best_of_them_takes_one():
    logits = torch.full((1, 12, 1, 1), -1e4)
    logits[:, 2], logits[:, 10] = 1.0, 1.0
    assert soft_argmax(logits).item() == pytest.approx(6)
    assert local_soft_argmax(logits).item() in (pytest.approx(2), pytest.approx(10))


def test_bilinear_upsampling_goes_straight_from_pixel_to_pixel():
    row = torch.tensor([0.0, 4.0]).view(1, 1, 1, 2)
    found = upsample_bilinear(row, torch.ones(1, 16, 1, 2))
    torch.testing.assert_close(found, torch.tensor([0.0, 1.0, 3.0, 4.0]).expand(1, 1, 2, 4))


def test_the_correlation_of_all_groups_together_is_that_without_groups():
    grouped, small = (stages_of(network).correlation for network in alike("weave_small_grouped"))
    assert small.std() > 0.01
    torch.testing.assert_close(grouped, small, atol=1e-5, rtol=1e-4)


def test_each_group_is_used_separately():
    """Scores change if one group decreases and another increases, although their sum stays the same."""
    network = untrained("weave_small_grouped")
    volume, features = torch.zeros(2, network.levels, 8, 16), network.encoder(torch.rand(2, 3, 32, 64))
    with torch.no_grad():
        one, other = (
            network.aggregation(volume, features._replace(quarter=torch.cat([features.quarter, *groups], 1)))[
                0
            ]
            for groups in ([volume + 1, volume, volume], [volume, volume + 1, volume])
        )
    assert (one - other).abs().max() > 1e-4


def test_undilated_blocks_look_one_pixel_to_each_side():
    for name, dilations in (("weave_small", [1, 2, 4]), ("weave_small_undilated", [1, 1, 1])):
        blocks = untrained(name).aggregation.dense.blocks
        assert [block[1][0].dilation[0] for block in blocks] == dilations


def test_a_level_at_an_eighth_is_8_px():
    network = untrained("weave_small_eighth")
    with torch.no_grad():
        network.aggregation.scores.bias[5] = 1e6
    stages = stages_of(network)
    assert stages.correlation.shape == stages.scores.shape == (4, 24, 4, 8)
    torch.testing.assert_close(stages.coarse_px, torch.full((4, 1, 16, 32), 40.0))
