"""SCV-Net: its published layers, its sparse slices, and the disparities for which their scores stand."""

import pytest
import torch
import torch.nn.functional as F
from learn_examples import recipe_of
from torch import nn

from stereoweave.errors import StereoweaveError
from stereoweave.learn.models import build_network
from stereoweave.learn.models.scvnet import SCVNet

torch.set_num_threads(1)


class Peak(nn.Module):
    """Scores of 0, but 60 at one of the six outputs of one slice."""

    def __init__(self, at, output):
        super().__init__()
        self.at, self.output = at, output

    def forward(self, volume):
        slices, _, height, width = volume.shape
        scores = torch.zeros(slices, 6, 2 * height, 2 * width)
        scores[self.at, self.output] = 60
        return scores


@pytest.fixture
def network():
    torch.manual_seed(0)
    return SCVNet(max_disparity_px=24).eval()


def count(part):
    return sum(parameter.numel() for parameter in part.parameters())


def test_each_part_has_the_parameters_of_the_authors_layers(network):
    features, hourglass = network.features, network.hourglass
    assert count(features.first) == 25 * 3 * 32 + 2 * 32
    assert count(features.early) + count(features.late) == 16 * (9 * 32 * 32 + 2 * 32)
    assert count(features.last) == 9 * 64 * 32 + 32
    assert count(hourglass.skip) == 15 * 64 * 32 + 2 * 15 * 32 * 32 + 3 * 2 * 32
    levels = [
        count(halve) + count(skip) for halve, skip in zip(hourglass.halvings, hourglass.skips, strict=True)
    ]
    assert levels == [287_232, 287_232, 287_232, 943_104]
    assert count(hourglass.expansions) == 276_928
    assert count(hourglass.scores) == 15 * 32 * 6 + 6


@pytest.mark.parametrize(("max_disparity_px", "slices"), [(192, 32), (96, 16), (64, 11), (6, 1), (1, 1)])
def test_there_is_a_slice_for_each_6_px(max_disparity_px, slices):
    with torch.device("meta"):
        assert SCVNet(max_disparity_px).slices == slices


def test_the_range_is_that_of_the_recipe():
    assert build_network(recipe_of("scvnet", max_disparity_px=64.0)).slices == 11


def test_a_slice_compares_features_that_are_three_columns_apart(network):
    volumes = []
    network.hourglass.register_forward_pre_hook(lambda _, given: volumes.append(given[0]))
    torch.manual_seed(1)
    scene = torch.rand(1, 3, 32, 76)
    # In the right image everything is 12 px, or 6 columns of the features, further left: as in slice 2.
    with torch.no_grad():
        network(scene[..., :64], scene[..., 12:])
    left, right = volumes[0].chunk(2, 1)
    assert left.shape == (4, 32, 16, 32)
    # Not equal there, because the borders of the two images differ.
    different = (left - right).abs().mean((1, 2, 3))
    assert different.argmin() == 2


@pytest.mark.parametrize(
    ("at", "output", "disparity_px"), [(0, 3, 0), (0, 5, 2), (1, 0, 3), (2, 1, 10), (3, 5, 20)]
)
def test_the_outputs_of_a_slice_stand_for_the_3_px_below_it_and_the_3_px_from_it(
    network, at, output, disparity_px
):
    network.hourglass = Peak(at, output)
    found = network(*torch.rand(2, 1, 3, 32, 64))
    torch.testing.assert_close(found, torch.full((1, 1, 32, 64), float(disparity_px)))


def test_scores_below_0_px_are_dropped(network):
    network.hourglass = Peak(0, 2)
    pair = torch.rand(2, 1, 3, 32, 64)
    assert network.compute_scores(*pair).shape == (1, 6 * 4 - 3, 32, 64)
    # All candidates 0 to 20 are equal.
    torch.testing.assert_close(network(*pair), torch.full((1, 1, 32, 64), 10.0))


def test_a_filter_of_twice_the_size_has_the_length_that_was_learned(network):
    pair = torch.rand(2, 1, 3, 32, 64)
    with torch.no_grad():
        before = network(*pair)
        length, direction = network.features.first[0].parametrizations.weight.parameters()
        direction *= 2
        torch.testing.assert_close(network(*pair), before)
        length *= 2
        assert (network(*pair) - before).abs().max() > 1e-3


def test_other_sizes_are_padded_by_their_border_and_cropped_again(network):
    torch.manual_seed(1)
    pair = torch.rand(2, 1, 3, 18, 35)
    padded = [F.pad(image, (0, 64 - 35, 0, 32 - 18), mode="replicate") for image in pair]
    with torch.no_grad():
        torch.testing.assert_close(network(*pair), network(*padded)[..., :18, :35])


@pytest.mark.parametrize("max_disparity_px", [0, -6])
def test_a_range_without_candidates_is_refused(max_disparity_px):
    with pytest.raises(
        StereoweaveError, match=f"^SCVNet: .*positive whole number, found {max_disparity_px}$"
    ):
        SCVNet(max_disparity_px)
