"""DispNet: the size in Table 1, the sign of the correlation, and six outputs in full-resolution pixels."""

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from stereoweave.learn.models.dispnet import DispNet, _initialise, mean_correlation


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return DispNet().eval()


def random_pair(height, width):
    torch.manual_seed(1)
    return torch.rand(1, 3, height, width), torch.rand(1, 3, height, width)


def test_the_network_has_the_parameters_of_the_papers_table(network):
    count = sum(parameter.numel() for parameter in network.parameters())
    assert count == 42_174_022
    assert f"{count:,} parameters" in DispNet.__doc__


def test_features_shifted_by_three_columns_correlate_fully_at_level_three():
    torch.manual_seed(0)
    second = torch.randn(1, 32, 4, 60).sign()
    first = second.roll(3, dims=3)
    volume = mean_correlation(first, second)
    assert volume.shape == (1, 41, 4, 60)
    # The mean of 32 products of a sign with itself is 1.
    assert (volume[:, 3, :, 3:] == 1).all()
    assert (volume[..., 3:].argmax(1) == 3).all()


def test_a_pair_shifted_by_eight_pixels_correlates_best_at_level_two(network):
    torch.manual_seed(0)
    scene = torch.rand(1, 3, 64, 256 + 8)
    left, right = scene[..., :-8], scene[..., 8:]
    matched = []
    handle = network.conv3.register_forward_pre_hook(lambda _, inputs: matched.append(inputs[0]))
    with torch.no_grad():
        network(left, right)
    handle.remove()
    assert matched[0].shape == (1, 41 + 64, 16, 64)
    # Only in these columns are all 41 candidates inside the right image and away from its border.
    assert matched[0][0, :41, 2:-2, 44:60].mean((1, 2)).argmax() == 2


def test_the_answer_is_the_last_of_six_weighted_outputs(network):
    pair = random_pair(64, 128)
    with torch.no_grad():
        outputs = network.outputs(*pair)
        torch.testing.assert_close(network(*pair), outputs[-1])
    assert len(outputs) == len(network.output_weights) == 6
    assert all(output.shape == (1, 1, 64, 128) for output in outputs)


def test_a_prediction_is_in_pixels_of_the_full_resolution_at_every_level(network):
    heads = [network.prediction, *(expansion.prediction for expansion in network.expansions)]
    kept = [{name: values.clone() for name, values in head.state_dict().items()} for head in heads]
    for head in heads:
        nn.init.zeros_(head.weight)
        nn.init.constant_(head.bias, 7.0)
    with torch.no_grad():
        outputs = network.outputs(*random_pair(64, 64))
    for head, values in zip(heads, kept, strict=True):
        head.load_state_dict(values)
    for output in outputs:
        torch.testing.assert_close(output, torch.full((1, 1, 64, 64), 7.0))


def test_other_sizes_are_padded_by_their_border_and_cropped_again(network):
    pair = random_pair(50, 71)
    padded = [F.pad(image, (0, 128 - 71, 0, 64 - 50), mode="replicate") for image in pair]
    with torch.no_grad():
        torch.testing.assert_close(network(*pair), network(*padded)[..., :50, :71])


def test_each_parameter_gets_a_gradient_from_the_supervised_outputs(network):
    network.zero_grad()
    outputs = network.outputs(*random_pair(64, 128))
    sum(
        weight * output.mean() for weight, output in zip(network.output_weights, outputs, strict=True)
    ).backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.any(), name
    network.zero_grad()


@pytest.mark.parametrize(
    "layer", [nn.Conv2d(256, 64, 3), nn.ConvTranspose2d(256, 64, 4, stride=2)], ids=["plain", "transposed"]
)
def test_a_layer_starts_with_a_gain_that_its_leaky_relu_undoes(layer):
    torch.manual_seed(0)
    _initialise(layer)
    with torch.no_grad():
        after = layer(torch.randn(1, 256, 24, 24))[..., 3:-3, 3:-3]
    # A leaky ReLU of slope 0.1 keeps (1 + 0.01) / 2 of a symmetric signal's power.
    assert after.square().mean() == pytest.approx(2 / 1.01, rel=0.05)
