"""Tests of WeaveNet at half the resolution, in addition to the tests of every network in test_models.py."""

import pytest
import torch
import torch.nn.functional as F
from learn_examples import overfitted, untrained

from stereoweave.learn.export.from_checkpoint import count_multiply_adds
from stereoweave.learn.models.layers import mirror
from stereoweave.learn.models.weave import WeaveNet
from stereoweave.learn.models.weave_half import HALF, WeaveHalfNet


def random_pair(batch, height, width):
    torch.manual_seed(1)
    return torch.rand(batch, 3, height, width), torch.rand(batch, 3, height, width)


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
    network = untrained("weave_half")
    inner = WeaveNet(HALF).eval()
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


def test_in_training_the_right_view_is_the_left_view_of_the_mirrored_pair():
    network = untrained("weave_half").double()
    with torch.no_grad():
        for part in (network.encoder, network.stem):
            for layer in part.modules():
                if isinstance(layer, torch.nn.Conv2d):
                    layer.weight += mirror(layer.weight.clone())
        left, right = (image.double() for image in random_pair(1, 64, 96))
        left_px, right_px = network.stages(left, right).disparity_px
        mirrored_right_px, mirrored_left_px = network.stages(mirror(right), mirror(left)).disparity_px
    # The stages of a right view are mirrored.
    torch.testing.assert_close(left_px, mirrored_left_px, atol=1e-3, rtol=0)
    torch.testing.assert_close(right_px, mirrored_right_px, atol=1e-3, rtol=0)
    assert (left_px - right_px).abs().max() > 0.1


def test_the_right_view_alone_is_that_of_the_halved_images_at_twice_their_size():
    network = untrained("weave_half")
    pair = random_pair(2, 64, 96)
    with torch.no_grad():
        stages = network.stages(*pair)
        left_px, right_px, logit = network(*pair)
    torch.testing.assert_close(left_px, stages.disparity_px[:2].clamp(min=0))
    torch.testing.assert_close(logit, stages.confidence_logit[:2])
    coarse_px = mirror(stages.coarse_px[2:]).clamp(min=0)
    assert torch.equal(right_px, coarse_px.repeat_interleave(2, 2).repeat_interleave(2, 3))


def test_the_range_ends_at_256_px_or_with_the_levels():
    assert untrained("weave_half").max_disparity_px == 256
    assert WeaveHalfNet(HALF, levels=16).max_disparity_px == 128


def test_the_network_overfits_one_pair():
    trained = overfitted("weave_half")
    assert trained.error_after_px < 1
    assert trained.error_after_px < trained.error_before_px / 5
