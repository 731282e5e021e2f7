"""Tests of WeaveNet at half the resolution, in addition to the tests of every network in test_models.py."""

import pytest
import torch
import torch.nn.functional as F
from learn_examples import overfitted, random_pair, untrained

from stereoweave.learn.export.from_checkpoint import count_multiply_adds
from stereoweave.learn.models.weave import WeaveNet
from stereoweave.learn.models.weave_half import HALF, WeaveHalfNet


@pytest.mark.parametrize("size", [(32, 32), (64, 160), (96, 64)])
def test_any_size_that_is_a_multiple_of_32_gives_maps_of_that_size(size):
    with torch.no_grad():
        maps = untrained("weave_half")(*random_pair(1, *size))
    for values in maps:
        assert values.shape == (1, 1, *size)
        assert values.dtype == torch.float32
        assert values.isfinite().all()


def test_the_whole_graph_of_both_views_takes_no_more_multiply_adds_than_promised():
    count = count_multiply_adds(untrained("weave_half"))
    assert count <= 3e9
    assert f"{count / 1e9:.2f} G multiply-adds" in WeaveHalfNet.__doc__


def test_before_the_last_refinement_the_results_are_those_of_a_weavenet_for_the_halved_images():
    # In training, because at inference each network selects surfaces in its own last upsampling alone.
    network, inner = untrained("weave_half").train(), WeaveNet(HALF).train()
    inner.load_state_dict({name: network.state_dict()[name] for name in inner.state_dict()})
    pair = random_pair(2, 64, 96)
    with torch.no_grad():
        stages = network.stages(*pair)
        halved = inner.stages(*(F.avg_pool2d(view, 2) for view in pair))
    # A pixel of the halved images is two pixels wide.
    assert torch.equal(stages.coarse_px, 2 * halved.disparity_px)
    assert torch.equal(stages.scores, halved.scores)
    assert stages.scores.shape == (4, 48, 8, 12)


@pytest.mark.parametrize(("least", "moved_px"), [(0, -4.0), (4, 4.0)])
def test_the_last_refinement_moves_a_disparity_by_at_most_two_pixels_of_the_halved_images(least, moved_px):
    network = untrained("weave_half")
    # Equal weights everywhere: an enlarged pixel is the mean of the four around it.
    for layer in (network.enlargement.scores, network.enlargement.weights):
        torch.nn.init.zeros_(layer.weight)
        torch.nn.init.zeros_(layer.bias)
    with torch.no_grad():
        network.enlargement.scores.bias[least] = 1e4
        stages = network.stages(*random_pair(1, 64, 96))
        unmoved_px = network.upsample(stages.coarse_px, torch.zeros(2, 16, 32, 48))
    torch.testing.assert_close(stages.disparity_px, unmoved_px + moved_px, atol=1e-3, rtol=0)


def test_the_range_ends_at_256_px_or_with_the_levels():
    assert untrained("weave_half").max_disparity_px == 256
    assert WeaveHalfNet(HALF, levels=16).max_disparity_px == 128


def test_the_network_overfits_one_pair():
    trained = overfitted("weave_half")
    assert trained.error_after_px < 1
    assert trained.error_after_px < trained.error_before_px / 5


def test_only_the_last_upsampling_selects_a_surface_at_inference():
    network = untrained("weave_half").eval()
    # The corner of three pixels at 10 px and one at 50 px, with equal weights.
    surfaces, logits = torch.tensor([[10.0, 10.0], [10.0, 50.0]]).view(1, 1, 2, 2), torch.zeros(1, 16, 2, 2)
    assert network.upsample_coarse(surfaces, logits)[0, 0, 1, 1].item() == pytest.approx(20, abs=0.01)
    assert network.upsample(surfaces, logits)[0, 0, 1, 1].item() == pytest.approx(10, abs=0.01)
