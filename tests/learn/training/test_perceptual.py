import math

import pytest
import torch

from stereoweave.errors import FormatError
from stereoweave.learn.training.perceptual import PerceptualLoss

# The first four convolutions of VGG-16 (configuration D) under torchvision's names.
SHAPES = {"0": (64, 3), "2": (64, 64), "5": (128, 64), "7": (128, 128)}


def weights(seed=0):
    """Return random weights of the true shapes, and those of a later layer that the loss does not need."""
    generator = torch.Generator().manual_seed(seed)
    state = {"features.10.weight": torch.zeros(256, 128, 3, 3), "classifier.6.bias": torch.zeros(1000)}
    for layer, shape in SHAPES.items():
        state[f"features.{layer}.weight"] = (
            torch.randn(*shape, 3, 3, generator=generator) / 3 / shape[1] ** 0.5
        )
        state[f"features.{layer}.bias"] = torch.randn(shape[0], generator=generator) / 10
    return state


def a_wire():
    """Return weights that pass the red channel on, raised by 3 so that no ReLU cuts it; all others are 0."""
    state = {name: torch.zeros_like(tensor) for name, tensor in weights().items()}
    for layer in SHAPES:
        state[f"features.{layer}.weight"][0, 0, 1, 1] = 1
    state["features.0.bias"][0] = 3
    return state


def saved(folder, state, **options):
    torch.save(state, folder / "vgg16.pth", **options)
    return folder / "vgg16.pth"


@pytest.fixture
def loss(tmp_path):
    return PerceptualLoss(saved(tmp_path, weights()))


def random_maps(*shape):
    generator = torch.Generator().manual_seed(1)
    return tuple(torch.rand(*shape, generator=generator) for _ in range(2))


def test_through_a_wire_the_loss_is_the_squared_normalised_error_over_128_channels(tmp_path):
    loss = PerceptualLoss(saved(tmp_path, a_wire()))
    found = loss(torch.full((2, 1, 8, 8), 0.5), torch.full((2, 1, 8, 8), 0.3))
    assert found.item() == pytest.approx((0.2 / 0.229) ** 2 / 128, rel=1e-5)


def test_features_are_pooled_once(tmp_path):
    loss = PerceptualLoss(saved(tmp_path, a_wire()))
    code, truth = torch.zeros(1, 1, 8, 8), torch.zeros(1, 1, 8, 8)
    code[0, 0, 3, 5] = 0.5  # one pixel of 64 is the largest of one block of 16
    assert loss(code, truth).item() == pytest.approx((0.5 / 0.229) ** 2 / 128 / 16, rel=1e-5)


def test_black_is_normalised_as_imagenet_is(tmp_path):
    state = a_wire()
    state["features.0.bias"][0] = 0  # values below the mean, 0.485 in red, are cut
    loss = PerceptualLoss(saved(tmp_path, state))
    found = loss(torch.full((1, 1, 8, 8), 0.585), torch.zeros(1, 1, 8, 8))
    assert found.item() == pytest.approx((0.1 / 0.229) ** 2 / 128, rel=1e-4)


def test_a_code_equal_to_the_truth_has_no_loss(loss):
    code, other = random_maps(2, 1, 12, 10)
    assert loss(code, code).item() == 0
    assert loss(code, other).item() > 0


def test_the_gradient_is_that_of_the_value(loss):
    code, truth = (values.double() for values in random_maps(1, 1, 4, 4))
    truth[0, 0, 1, 2] = math.nan
    # The replaced pixel is the detached prediction, a constant here, because it is not moved.
    held = code.clone()
    known = truth.isfinite()
    loss.double()
    assert torch.autograd.gradcheck(
        lambda moved: loss(moved.where(known, held), truth), code.requires_grad_(), eps=1e-7
    )


def test_unknown_pixels_have_no_gradient_and_all_known_ones_have(loss):
    code, truth = random_maps(1, 1, 16, 16)
    truth[:, :, 4:9, 3:7] = math.nan
    loss(code.requires_grad_(), truth).backward()
    assert torch.equal(code.grad != 0, truth.isfinite())


def test_unknown_truth_is_what_was_predicted_there(loss):
    code, truth = random_maps(1, 1, 16, 16)
    partly = truth.clone()
    partly[:, :, 4:9, 3:7] = math.nan  # 20 of 256
    truth[:, :, 4:9, 3:7] = code[:, :, 4:9, 3:7]
    assert loss(code, partly).item() == pytest.approx(loss(code, truth).item() * 256 / 236, rel=1e-5)


def test_half_of_the_pixels_known_weigh_as_much_as_all(tmp_path):
    loss = PerceptualLoss(saved(tmp_path, a_wire()))
    code, truth = torch.full((1, 1, 8, 8), 0.5), torch.full((1, 1, 8, 8), 0.3)
    truth[:, :, :4] = math.nan
    assert loss(code, truth).item() == pytest.approx((0.2 / 0.229) ** 2 / 128, rel=1e-5)


def test_truth_that_is_all_unknown_has_no_loss_and_no_gradient(loss):
    code, _ = random_maps(1, 1, 8, 8)
    found = loss(code.requires_grad_(), torch.full((1, 1, 8, 8), math.nan))
    found.backward()
    assert found.item() == 0
    assert not code.grad.any()


def test_the_weights_are_those_of_the_file_and_frozen(loss):
    expected = {name: tensor for name, tensor in weights().items() if name.split(".")[1] in SHAPES}
    state = loss.state_dict()
    assert state.keys() == expected.keys()
    assert all(torch.equal(state[name], tensor) for name, tensor in expected.items())
    assert not any(parameter.requires_grad for parameter in loss.parameters())
    assert sum(parameter.numel() for parameter in loss.parameters()) == 1_792 + 36_928 + 73_856 + 147_584


def test_choosing_this_loss_draws_no_random_number(tmp_path):
    path = saved(tmp_path, weights())
    before = torch.get_rng_state()
    PerceptualLoss(path)
    assert torch.equal(torch.get_rng_state(), before)


def test_a_file_in_the_older_format_of_the_published_one_is_read(tmp_path):
    path = saved(tmp_path, weights(), _use_new_zipfile_serialization=False)
    assert torch.equal(PerceptualLoss(path).state_dict()["features.7.bias"], weights()["features.7.bias"])


def refused(path):
    with pytest.raises(FormatError) as refusal:
        PerceptualLoss(path)
    message = str(refusal.value)
    assert message.startswith(f"{path}: ")
    assert "vgg16-397923af.pth" in message
    assert "\n" not in message
    return message


def test_the_error_for_a_missing_file_says_which_one_is_expected_and_never_downloaded(tmp_path):
    assert "never downloaded automatically" in refused(tmp_path / "none.pth")


def test_a_file_that_lacks_a_layer_is_refused_by_its_name(tmp_path):
    state = weights()
    del state["features.5.weight"]
    message = refused(saved(tmp_path, state))
    assert "features.5.weight: expected shape [128, 64, 3, 3], found none" in message


def test_a_layer_of_another_shape_is_refused_with_both_shapes(tmp_path):
    message = refused(saved(tmp_path, weights() | {"features.2.bias": torch.zeros(32)}))
    assert "features.2.bias: expected shape [64], found [32]" in message


def test_a_file_that_is_no_state_of_a_network_is_refused(tmp_path):
    assert "found a list" in refused(saved(tmp_path, [1, 2]))
    assert "found none" in refused(saved(tmp_path, {"features.0.weight": "text"}))


def test_a_file_of_other_bytes_is_refused(tmp_path):
    (tmp_path / "vgg16.pth").write_bytes(b"not weights")
    refused(tmp_path / "vgg16.pth")
