import math
from functools import partial

import pytest
import torch

from stereoweave.learn.training.losses import (
    CODE_LOSSES,
    cross_entropy_loss,
    l1_loss,
    l2_loss,
    projection_loss,
    smooth_l1_loss,
)

NAN = math.nan


def a_map(*values):
    """Return a map [1, 1, 1, W] of one row, with a gradient."""
    return torch.tensor(values, dtype=torch.float64).view(1, 1, 1, -1).requires_grad_()


def test_l2_is_the_mean_squared_error_of_the_known_pixels():
    found = l2_loss(a_map(0.5, 0.3, 0.9), a_map(0.1, 0.5, NAN))
    assert found.item() == pytest.approx((0.16 + 0.04) / 2)


def test_l1_is_the_mean_absolute_error_of_the_known_pixels():
    found = l1_loss(a_map(0.5, 0.3, 0.9), a_map(0.1, 0.5, NAN))
    assert found.item() == pytest.approx((0.4 + 0.2) / 2)


def test_smooth_l1_is_the_absolute_error_less_half_of_beta_and_a_parabola_below_beta():
    found = smooth_l1_loss(a_map(0.5, 0.35, 0.9), a_map(0.1, 0.3, NAN), beta=0.1)
    assert found.item() == pytest.approx((0.4 - 0.05 + 0.05**2 / (2 * 0.1)) / 2)


def test_smooth_l1_switches_at_one_pixel_of_192_by_default():
    # PSMNet's loss in pixels, 192 times this one: 0.5 px costs 0.125, 2 px cost 1.5.
    found = 192 * smooth_l1_loss(a_map(0.5 / 192, 2 / 192), a_map(0.0, 0.0))
    assert found.item() == pytest.approx((0.125 + 1.5) / 2)


def test_cross_entropy_is_that_of_two_coins():
    found = cross_entropy_loss(a_map(0.25, 0.5, 0.9), a_map(1.0, 0.3, NAN))
    assert found.item() == pytest.approx((math.log(4) + math.log(2)) / 2)


def test_cross_entropy_is_least_where_the_code_is_the_truth():
    code = a_map(0.3)
    cross_entropy_loss(code, a_map(0.3)).backward()
    assert code.grad.item() == 0


def test_cross_entropy_is_finite_at_codes_of_exactly_zero_and_one():
    code = a_map(0.0, 1.0, 0.0, 1.0)
    loss = cross_entropy_loss(code, a_map(0.0, 1.0, 1.0, 0.5))
    loss.backward()
    assert loss.item() == (100 + 50) / 4
    assert code.grad.isfinite().all()


@pytest.mark.parametrize("output", [-200.0, 200.0])
def test_a_saturated_sigmoid_gets_finite_gradients_from_cross_entropy(output):
    logit = torch.full((1, 1, 1, 2), output, requires_grad=True)
    cross_entropy_loss(logit.sigmoid(), torch.tensor([0.0, 1.0]).view(1, 1, 1, 2)).backward()
    assert logit.grad.isfinite().all()


@pytest.mark.parametrize("loss", [*CODE_LOSSES.values(), partial(smooth_l1_loss, beta=0.2)])
def test_the_gradients_of_the_code_losses_are_those_of_their_values(loss):
    truth = a_map(0.3, 0.31, NAN, 0.0, 1.0).detach()
    assert torch.autograd.gradcheck(lambda code: loss(code, truth), a_map(0.32, 0.9, 0.4, 0.05, 0.7))


@pytest.mark.parametrize("loss", CODE_LOSSES.values())
def test_unknown_truth_has_no_loss_and_no_gradient(loss):
    code = a_map(0.2, 0.4, 0.0, 1.0)
    loss(code, a_map(0.3, NAN, NAN, math.inf)).backward()
    assert code.grad.flatten()[0] != 0
    assert code.grad.flatten()[1:].tolist() == [0, 0, 0]


@pytest.mark.parametrize("loss", CODE_LOSSES.values())
def test_truth_that_is_all_unknown_gives_zero_loss_and_gradient(loss):
    code = a_map(0.2, 0.0, 1.0)
    found = loss(code, a_map(NAN, NAN, NAN))
    found.backward()
    assert found.item() == 0
    assert not code.grad.any()


def test_projection_is_the_squared_difference_of_the_left_image_and_its_reconstruction():
    # Read at -1 (outside), 0.5, 1, 1.75: 0.3, 0.4, 0.7 against 0.5, 0.4, 0.6.
    found = projection_loss(a_map(9.0, 0.5, 0.4, 0.6), a_map(0.2, 0.4, 0.8, 0.9), a_map(1.0, 0.5, 1.0, 1.25))
    assert found.item() == pytest.approx((0.04 + 0 + 0.01) / 3)


def test_projection_weighs_grey_and_colour_alike():
    left, right, disparity_px = a_map(0.5, 0.4, 0.6), a_map(0.2, 0.4, 0.8), a_map(0.0, 0.5, 1.0)
    colour = projection_loss(left.expand(1, 3, 1, 3), right.expand(1, 3, 1, 3), disparity_px)
    assert colour.item() == pytest.approx(projection_loss(left, right, disparity_px).item())


def test_projection_is_zero_at_the_disparity_that_made_the_pair():
    right = torch.rand(2, 3, 4, 12, generator=torch.Generator().manual_seed(0))
    left = right.roll(3, dims=3)  # columns 0 to 2 wrap around from the other side and are not used
    assert projection_loss(left, right, torch.full((2, 1, 4, 12), 3.0)).item() == 0


def test_projection_pulls_the_disparity_towards_the_match():
    ramp = torch.linspace(0, 1, 12).expand(1, 3, 4, 12)
    disparity_px = torch.full((1, 1, 4, 12), 1.5, requires_grad=True)
    projection_loss(ramp, ramp, disparity_px).backward()  # the match is at disparity 0
    assert (disparity_px.grad[..., 2:] > 0).all()


def test_the_gradient_of_projection_is_that_of_its_value(rng):
    left, right = (torch.from_numpy(rng.uniform(size=(2, 3, 2, 7))) for _ in range(2))
    whole_px = rng.integers(-3, 5, (2, 1, 2, 7))
    disparity_px = torch.from_numpy(whole_px + rng.uniform(0.1, 0.9, (2, 1, 2, 7))).requires_grad_()
    assert torch.autograd.gradcheck(lambda d: projection_loss(left, right, d), disparity_px)


@pytest.mark.parametrize("outside_px", [1e6, -1e6, math.inf])
def test_projection_is_zero_without_a_gradient_where_no_pixel_exists(outside_px):
    disparity_px = a_map(outside_px, outside_px)
    found = projection_loss(a_map(0.1, 0.2), a_map(0.3, 0.4), disparity_px)
    found.backward()
    assert found.item() == 0
    assert disparity_px.grad.flatten().tolist() == [0, 0]
