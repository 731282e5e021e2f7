"""GA-Net: its candidates, its cost volume and its padding; its layers are in test_guided_aggregation.py."""

import pytest
import torch
import torch.nn.functional as F
from learn_examples import recipe_of

from stereoweave.errors import StereoweaveError
from stereoweave.learn.models import build_network
from stereoweave.learn.models.ganet import GANET_11, GANET_DEEP, GANet, _masked_volume

torch.set_num_threads(1)


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return GANet(GANET_11, max_disparity_px=24).eval()


def convolutions_of(size, kinds):
    with torch.device("meta"):
        return sum(isinstance(layer, kinds) for layer in GANet(size).modules())


def test_the_networks_have_as_many_3d_convolutions_as_their_authors_count():
    kinds = torch.nn.Conv3d, torch.nn.ConvTranspose3d
    # Without those that reduce the costs to one channel for an output, which the authors do not count.
    assert convolutions_of(GANET_11, kinds) - len(GANET_11.output_weights) == 11
    assert convolutions_of(GANET_DEEP, kinds) - len(GANET_DEEP.output_weights) == 22


@pytest.mark.parametrize(
    ("max_disparity_px", "levels"), [(192, 65), (96, 33), (64, 25), (49, 21), (48, 17), (1, 5)]
)
def test_candidates_are_3_px_apart_up_to_the_next_multiple_of_12(max_disparity_px, levels):
    with torch.device("meta"):
        assert GANet(GANET_11, max_disparity_px).levels == levels


def test_the_range_is_that_of_the_recipe():
    assert build_network(recipe_of("ganet_11", max_disparity_px=36.0)).levels == 13


def test_the_cost_volume_is_empty_where_the_match_lies_outside():
    left, right = torch.tensor([1.0, 2, 3]), torch.tensor([4.0, 5, 6])
    volume = _masked_volume(left.view(1, 1, 1, 3), right.view(1, 1, 1, 3), levels=4)
    expected = [[[1, 2, 3], [0, 2, 3], [0, 0, 3], [0, 0, 0]], [[4, 5, 6], [0, 4, 5], [0, 0, 4], [0, 0, 0]]]
    assert volume.view(2, 4, 3).tolist() == expected


def test_the_costs_of_the_lowest_and_highest_level_are_those_of_the_ends_of_the_range(network):
    costs = torch.arange(9.0).view(1, 1, 9, 1, 1).expand(1, 1, 9, 2, 3)
    full = network._full_costs(costs)
    assert full.shape == (1, 25, 6, 9)
    # Nine levels stand for 25 candidates: candidate k is at level (k + 0.5) * 9 / 25 - 0.5.
    torch.testing.assert_close(full[0, 12], torch.full((6, 9), 4.0))
    torch.testing.assert_close(full[0, 3], torch.full((6, 9), 3.5 * 9 / 25 - 0.5))
    assert (full[0, 0] == 0).all() and (full[0, 24] == 8).all()


def test_other_sizes_are_padded_by_their_border_and_cropped_again(network):
    torch.manual_seed(1)
    pair = torch.rand(2, 1, 3, 38, 55)
    padded = [F.pad(image, (0, 96 - 55, 0, 48 - 38), mode="replicate") for image in pair]
    with torch.no_grad():
        torch.testing.assert_close(network(*pair), network(*padded)[..., :38, :55])


@pytest.mark.parametrize("max_disparity_px", [0, -12])
def test_a_range_without_candidates_is_refused(max_disparity_px):
    with pytest.raises(StereoweaveError, match=f"^GANet: .*positive whole number, found {max_disparity_px}$"):
        GANet(GANET_11, max_disparity_px)
