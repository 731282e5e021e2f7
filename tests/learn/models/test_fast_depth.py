"""The paper's network: its parameter count, its image sizes, its dropout, and its decoder's skips."""

import math

import pytest
import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from stereoweave.learn.models.fast_depth import FastDepthNet
from stereoweave.learn.models.layers import pad_to_multiple


@pytest.fixture(autouse=True)
def same_draws():
    torch.manual_seed(0)


def parameters(network):
    return sum(parameter.numel() for parameter in network.parameters())


def test_the_network_has_the_papers_number_of_parameters():
    network = FastDepthNet()
    assert parameters(network) == 314_722
    statistics = [
        values for name, values in network.named_buffers() if name.endswith(("running_mean", "running_var"))
    ]
    assert parameters(network) + sum(values.numel() for values in statistics) == 317_638
    assert "314,722 parameters" in FastDepthNet.__doc__


def test_the_network_takes_7_giga_multiply_adds():
    network, image = FastDepthNet().to("meta"), torch.empty(1, 3, 480, 640, device="meta")
    with FlopCounterMode(display=False) as counter:
        network(image, image)
    count = counter.get_total_flops() / 2
    assert round(count / 1e9, 2) == 7.39
    assert "7.39 G multiply-adds" in FastDepthNet.__doc__


def test_without_skips_exactly_the_skips_channels_are_missing():
    # Two decoder steps lack 16 channels of the left view. Each channel has 5x5 weights to 16 outputs, and a
    # scale and a shift in the batch norm.
    assert 2 * 16 * (5 * 5 * 16 + 2) == 12_864
    plain = FastDepthNet(skips=False)
    assert parameters(plain) == 314_722 - 12_864 == 301_858
    shapes = {name: values.shape for name, values in FastDepthNet().state_dict().items()}
    narrower = {name for name, values in plain.state_dict().items() if values.shape != shapes[name]}
    assert {name.split(".")[0] for name in narrower} == {"decode_quarter", "decode_half"}


def test_the_decoder_sees_the_left_view_at_a_quarter_and_a_half_only_with_skips():
    left, right = torch.rand(2, 1, 3, 16, 24)
    for skips, inputs in ((True, [(48, 4, 6), (32, 8, 12)]), (False, [(32, 4, 6), (16, 8, 12)])):
        network, seen = FastDepthNet(skips), []
        for step in (network.decode_quarter, network.decode_half):
            step.register_forward_pre_hook(lambda _, x, seen=seen: seen.append(x[0]))
        features = network.matching.left_features(left)
        network(left, right)
        assert [tuple(x.shape[1:]) for x in seen] == inputs
        if skips:
            # The last 16 channels are the largest features of 4x4 and of 2x2 pixels.
            for x, pool in zip(seen, (4, 2), strict=True):
                blocks = features.unflatten(3, (-1, pool)).unflatten(2, (-1, pool))
                torch.testing.assert_close(x[:, -16:], blocks.amax((3, 5)))


@pytest.mark.parametrize("size", [(37, 53), (1, 1), (8, 9), (16, 24)])
def test_the_code_has_the_size_of_the_pictures_and_is_between_0_and_1(size):
    code = FastDepthNet().eval()(*torch.rand(2, 2, 3, *size))
    assert code.shape == (2, 1, *size)
    assert code.dtype == torch.float32
    assert ((code > 0) & (code < 1)).all()


def test_a_picture_of_odd_size_gives_the_result_of_the_picture_padded_by_its_border():
    network = FastDepthNet().eval()
    left, right = torch.rand(2, 1, 3, 37, 53)
    rows, columns = torch.arange(40).clamp(max=36), torch.arange(56).clamp(max=52)
    padded = (view[:, :, rows][..., columns] for view in (left, right))
    with torch.no_grad():
        torch.testing.assert_close(network(left, right), network(*padded)[..., :37, :53], rtol=0, atol=0)


def test_padding_repeats_the_last_row_and_column_up_to_the_next_multiple():
    image = torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]])[None, None]
    expected = torch.tensor([[1, 2, 3, 3], [4, 5, 6, 6], [7, 8, 9, 9], [7, 8, 9, 9.0]])
    torch.testing.assert_close(pad_to_multiple(image, 4)[0, 0], expected)
    torch.testing.assert_close(pad_to_multiple(image[..., :2], 2)[0, 0], expected[:, :2])


def test_an_image_that_already_fits_is_not_padded():
    image = torch.rand(1, 3, 16, 24)
    assert pad_to_multiple(image, 8) is image


def test_training_supervises_one_output_which_is_the_answer():
    network = FastDepthNet().eval()
    left, right = torch.rand(2, 1, 3, 16, 16)
    outputs = network.outputs(left, right)
    assert len(outputs) == len(network.output_weights) == 1
    assert network.predicts == "code"
    assert network.multiple_of == 8
    torch.testing.assert_close(outputs[-1], network(left, right))


def test_dropout_removes_a_fifth_of_the_values_of_eight_maps_in_training_only():
    network = FastDepthNet()
    assert [type(m) for m in network.modules() if "Dropout" in type(m).__name__] == [nn.Dropout]
    kept = []
    network.matching.dropout.register_forward_hook(lambda _, x, y: kept.append((x[0], y)))
    left, right = torch.rand(2, 1, 3, 64, 64)
    with torch.no_grad():
        first, second = network(left, right), network(left, right)
        assert (first - second).abs().max() > 1e-3
        assert [y.shape[1] for _, y in kept] == 2 * [32, 32, 32, 32, 16, 16, 16, 16]
        dropped = torch.cat([(y == 0).float().flatten() for _, y in kept])
        # With 24,576 values the share has a standard deviation of 0.26 %.
        assert dropped.mean().item() == pytest.approx(0.2, abs=0.01)
        # Dropout is elementwise: hardly any channel would keep all or none of its 64 values.
        assert all(0 < (y[0, 0] == 0).float().mean() < 0.5 for _, y in kept)
        torch.testing.assert_close(kept[0][1][kept[0][1] != 0] * 0.8, kept[0][0][kept[0][1] != 0])
        network.eval()
        torch.testing.assert_close(network(left, right), network(left, right), rtol=0, atol=0)
        assert all(torch.equal(x, y) for x, y in kept[-16:])


def test_batch_norm_has_the_constants_of_keras():
    norms = [layer for layer in FastDepthNet().modules() if isinstance(layer, nn.BatchNorm2d)]
    assert len(norms) == 14
    assert {(norm.eps, norm.momentum) for norm in norms} == {(1e-3, 0.01)}


def test_weights_start_with_glorots_initialisation_and_biases_at_0():
    network = FastDepthNet()
    # sqrt(6 / (25 * 32 inputs + 25 * 32 outputs)), and sqrt(6 / (81 * 33 + 81)) for the head.
    for layer, bound in (
        (network.matching.correspondence[2], math.sqrt(6 / 1600)),
        (network.head.to_code, math.sqrt(6 / 2754)),
    ):
        assert 0.95 * bound < layer.weight.abs().max() <= bound
    biases = [layer.bias for layer in network.modules() if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d)]
    assert len(biases) == 20
    assert not any(bias.any() for bias in biases)
