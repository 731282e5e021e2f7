"""PSMNet: its published size and its three outputs."""

import math

import pytest
import torch
import torch.nn.functional as F

from stereoweave.errors import StereoweaveError
from stereoweave.learn.models.psmnet import PSMNet, _disparity_px

# For volumes this small, sharing the work among threads costs more than computing.
torch.set_num_threads(1)


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return PSMNet(max_disparity_px=32)


def random_pair(batch, height, width):
    torch.manual_seed(1)
    return torch.rand(batch, 3, height, width), torch.rand(batch, 3, height, width)


def test_the_network_has_its_published_number_of_parameters(network):
    count = sum(parameter.numel() for parameter in network.parameters())
    assert count == 5_224_768
    assert f"{count:,} parameters" in PSMNet.__doc__


def test_192_disparities_are_candidates_by_default():
    with torch.device("meta"):
        assert PSMNet().max_disparity_px == 192


def test_a_level_of_the_quarter_volume_stands_for_its_four_candidates():
    costs = torch.zeros(1, 1, 8, 2, 3)
    costs[:, :, 3] = -60
    # These are candidates 12 to 15, with a mean of 13.5.
    torch.testing.assert_close(
        _disparity_px(costs, torch.zeros(1, 3, 8, 12)), torch.full((1, 1, 8, 12), 13.5)
    )


@pytest.mark.parametrize("training", [True, False])
def test_the_answer_is_the_last_of_three_weighted_outputs(network, training):
    network.train(training)
    pair = random_pair(2, 16, 32)
    with torch.no_grad():
        outputs = network.outputs(*pair)
        torch.testing.assert_close(network(*pair), outputs[-1])
    assert len(outputs) == 3
    assert network.output_weights == (0.5, 0.7, 1.0)
    for output in outputs:
        assert output.shape == (2, 1, 16, 32)
        assert ((output >= 0) & (output <= 31)).all()


def test_other_sizes_are_padded_by_their_border_and_cropped_again(network):
    network.train()
    pair = random_pair(1, 18, 35)
    padded = [F.pad(image, (0, 48 - 35, 0, 32 - 18), mode="replicate") for image in pair]
    with torch.no_grad():
        torch.testing.assert_close(network(*pair), network(*padded)[..., :18, :35])


def test_each_parameter_gets_a_gradient_from_the_supervised_outputs(network):
    network.train().zero_grad()
    outputs = network.outputs(*random_pair(1, 32, 48))
    sum(
        weight * output.mean() for weight, output in zip(network.output_weights, outputs, strict=True)
    ).backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.any(), name


def test_weights_start_normal_with_the_variance_of_their_fan_out():
    torch.manual_seed(0)
    network = PSMNet(max_disparity_px=16)
    shortcut = network.features.conv3[0].shortcut[0].weight  # 1x1 to 128 channels
    expansion = network.hourglasses[0].out[0].weight  # 3x3x3 to 32 channels
    assert shortcut.std().item() == pytest.approx(math.sqrt(2 / 128), rel=0.05)
    assert expansion.std().item() == pytest.approx(math.sqrt(2 / (27 * 32)), rel=0.05)


@pytest.mark.parametrize("max_disparity_px", [-16, 0, 8, 100])
def test_candidates_that_the_hourglass_cannot_halve_are_refused(max_disparity_px):
    with pytest.raises(StereoweaveError, match=f"^PSMNet: .*multiple of 16.*found {max_disparity_px}$"):
        PSMNet(max_disparity_px)
