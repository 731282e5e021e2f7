"""GA-Net's layers: both against written-out references, and examples worked out by hand."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from plain_guided_aggregation import plain_local, plain_semi_global

from stereoweave.learn.models.guided_aggregation import (
    aggregate_locally,
    aggregate_semi_globally,
    filter_in_torch,
    follow_in_torch,
)
from stereoweave.learn.models.guided_functions import FilterWindows, FollowPaths

torch.set_num_threads(1)

DOWN, UP, RIGHT, LEFT = range(4)
OWN, SAME, LOWER, HIGHER, BEST = range(5)


def weights_of(height, width, **shares):
    """Return weights of one channel: of paths to the right as given, of the others only the own cost."""
    weights = torch.zeros(1, 4, 1, 5, height, width)
    weights[:, [DOWN, UP, LEFT], :, OWN] = 1
    for name, share in shares.items():
        weights[:, RIGHT, :, globals()[name.upper()]] = share
    return weights.flatten(1, 3)


@pytest.mark.parametrize("size", [(3, 4, 5, 6), (2, 1, 3, 4), (1, 3, 1, 4), (1, 2, 4, 1), (1, 5, 9, 2)])
def test_semi_global_aggregation_equals_the_written_out_one(size):
    torch.manual_seed(0)
    channels, _, height, width = size
    costs, weights = torch.randn(2, *size), torch.randn(2, 20 * channels, height, width)
    shares = F.normalize(weights.view(2, 4, channels, 5, height, width), p=1, dim=3)
    expected = [plain_semi_global(*both) for both in zip(costs.numpy(), shares.numpy(), strict=True)]
    found = aggregate_semi_globally(costs, weights)
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize(
    ("shares", "expected"),
    [
        ({"own": 1}, [[0, 2, 0], [4, 0, 0], [0, 0, 6]]),
        # At the first column, whose predecessors lie outside, each share is of the own cost.
        ({"same": 1}, [[0, 2, 0], [4, 4, 4], [0, 0, 6]]),
        # The lowest candidate has none below: it starts again from its own cost.
        ({"lower": 1}, [[0, 2, 0], [4, 0, 2], [0, 4, 6]]),
        ({"higher": 1}, [[0, 4, 0], [4, 0, 0], [0, 0, 6]]),
        ({"own": 1, "best": 1}, [[0, 3, 1.5], [4, 2, 1.5], [0, 2, 6]]),
    ],
)
def test_a_path_to_the_right_carries_its_costs(shares, expected):
    # One row of three columns with three candidates, of which the other three directions keep the costs.
    costs = torch.tensor([[0.0, 2, 0], [4, 0, 0], [0, 0, 6]]).view(1, 1, 3, 1, 3)
    found = aggregate_semi_globally(costs, weights_of(1, 3, **shares))
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float32).view(1, 1, 3, 1, 3))


@pytest.mark.parametrize("size", [(4, 11, 6), (1, 3, 4), (3, 8, 2), (2, 17, 1)])
def test_local_aggregation_equals_the_written_out_one(size):
    torch.manual_seed(0)
    costs, weights = torch.randn(2, *size), torch.randn(2, 75, *size[1:])
    shares = F.normalize(weights, p=1, dim=1).view(2, 3, 5, 5, *size[1:])
    expected = [plain_local(*both) for both in zip(costs.numpy(), shares.numpy(), strict=True)]
    np.testing.assert_allclose(aggregate_locally(costs, weights), expected, atol=1e-5)


def results_and_gradients(function, *given):
    """Return a function's result, and the gradients of its random projection, of all tensors given."""
    torch.manual_seed(1)
    inputs = [value.clone().requires_grad_() if torch.is_tensor(value) else value for value in given]
    result = function(*inputs)
    (result * torch.randn_like(result)).sum().backward()
    return [result.detach(), *(value.grad for value in inputs if torch.is_tensor(value))]


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("size", [(4, 7, 6), (1, 3, 4), (2, 1, 3), (5, 4, 1)])
def test_numba_follows_paths_as_pytorch_does(size, backwards):
    torch.manual_seed(0)
    shares = F.normalize(torch.randn(2, 3, 5, *size[1:]), p=1, dim=2)  # else, costs grow along the path
    given = torch.randn(2, 3, *size), shares, backwards
    compiled = results_and_gradients(FollowPaths.apply, *given)
    torch.testing.assert_close(compiled, results_and_gradients(follow_in_torch, *given))


@pytest.mark.parametrize("size", [(4, 7, 6), (1, 3, 4), (2, 1, 1)])
def test_numba_filters_windows_as_pytorch_does(size):
    torch.manual_seed(0)
    levels, height, width = size
    given = torch.randn(2, levels + 2, height + 4, width + 4), torch.randn(2, 3, 5, 5, height, width)
    compiled = results_and_gradients(FilterWindows.apply, *given)
    torch.testing.assert_close(compiled, results_and_gradients(filter_in_torch, *given))


def test_local_aggregation_twice_is_that_of_the_first_result():
    torch.manual_seed(0)
    costs, weights = torch.randn(1, 3, 4, 5), torch.randn(1, 75, 4, 5)
    once = aggregate_locally(costs, weights)
    torch.testing.assert_close(aggregate_locally(costs, weights, times=2), aggregate_locally(once, weights))


def test_equal_local_weights_keep_a_constant_volume_and_spread_a_single_cost():
    weights = torch.full((1, 75, 9, 10), 2.0)
    torch.testing.assert_close(
        aggregate_locally(torch.full((1, 4, 9, 10), 3.0), weights), torch.full((1, 4, 9, 10), 3.0)
    )
    costs = torch.zeros(1, 5, 9, 10)
    costs[0, 2, 4, 5] = 75
    expected = torch.zeros(1, 5, 9, 10)
    expected[0, 1:4, 2:7, 3:8] = 1
    torch.testing.assert_close(aggregate_locally(costs, weights), expected)


def test_both_aggregations_have_the_gradients_of_their_differences():
    torch.manual_seed(0)
    for aggregate, costs, weights in (
        (aggregate_semi_globally, torch.randn(1, 2, 3, 4, 5), torch.randn(1, 40, 4, 5)),
        (aggregate_locally, torch.randn(1, 3, 4, 5), torch.randn(1, 75, 4, 5)),
    ):
        weights += weights.sign()  # away from 0, where magnitudes have a corner
        for given in (costs, weights):
            given.requires_grad_()
            onto = torch.randn_like(costs)
            (gradient,) = torch.autograd.grad((aggregate(costs, weights) * onto).sum(), given)
            given.requires_grad_(False)
            towards = torch.randn_like(given)
            step = 1e-3 * towards
            ends = [
                aggregate(*(value + sign * step if value is given else value for value in (costs, weights)))
                for sign in (1, -1)
            ]
            difference = ((ends[0] - ends[1]).double() * onto).sum() / 2e-3
            assert difference.item() == pytest.approx((gradient * towards).sum().item(), rel=0.02, abs=0.02)


@pytest.mark.parametrize(
    ("aggregate", "costs", "weights"),
    [
        (aggregate_semi_globally, torch.rand(1, 2, 3, 4, 5), torch.rand(1, 40, 4, 5)),
        (aggregate_locally, torch.rand(1, 3, 4, 5), torch.rand(1, 75, 4, 5)),
    ],
)
def test_costs_of_16_bits_are_aggregated_in_float32_and_have_no_second_derivative(aggregate, costs, weights):
    given = costs.bfloat16().requires_grad_(), weights.requires_grad_()
    aggregated = aggregate(*given)
    assert aggregated.dtype == torch.float32
    (gradient,) = torch.autograd.grad(aggregated.square().sum(), given[:1], create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()
