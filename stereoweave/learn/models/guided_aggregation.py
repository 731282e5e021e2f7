"""Layers of GA-Net that aggregate matching costs with weights predicted from the image.

F. Zhang, V. Prisacariu, R. Yang and P. H. S. Torr, GA-Net: Guided Aggregation Net for End-to-end Stereo
Matching, CVPR 2019, arXiv:1904.06587. Where the paper is silent, the layers do what the authors' code does
(github.com/feihuzhang/GANet, MIT licence): a cost whose neighbour lies outside the volume is weighted in the
neighbour's place. Written-out references of both layers are in tests/helpers/plain_guided_aggregation.py.

On a processor both layers run in Numba (guided_functions.py), elsewhere in PyTorch's operations.
"""

import itertools

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from stereoweave.learn.models.guided_functions import FilterWindows, FollowPaths

# Weights per pixel and direction: own cost; before it on the path, the costs of the same candidate, the
# candidates one lower and one higher, and the largest of all candidates.
SEMI_GLOBAL_WEIGHTS = 5
DIRECTIONS = 4
LOCAL_RADIUS = 2
_WINDOW = 2 * LOCAL_RADIUS + 1
LOCAL_WEIGHTS = 3 * _WINDOW**2
_LEAST_SUM = 1e-12  # least divisor of weights, by the sum of their magnitudes


def aggregate_semi_globally(
    costs: Float[Tensor, "b c d h w"], weights: Float[Tensor, "b k h w"]
) -> Float[Tensor, "b c d h w"]:
    """Return the largest of the costs aggregated downwards, upwards, rightwards and leftwards (equation 5).

    A differentiable form of semi-global matching: its minimum over the candidates is replaced by a maximum,
    and its penalties by weights. Of each direction, the gradient needs one volume beside the costs.

    Args:
        costs: Matching cost [B, C, D, H, W].
        weights: For each direction, channel and pixel, five weights [B, 4 * C * 5, H, W]. They are divided by
            the sum of their magnitudes.
    """
    batch, channels, _, height, width = costs.shape
    # In float32, because bfloat16 would round the costs at every step of the path.
    costs = costs.float()
    shared = weights.float().view(batch, DIRECTIONS, channels, SEMI_GLOBAL_WEIGHTS, height, width)
    down, up, right, left = _share(shared, 3).unbind(1)
    vertical = _follow_both_ways(costs, down, up)
    horizontal = _follow_both_ways(*(volume.transpose(3, 4).contiguous() for volume in (costs, right, left)))
    return _larger(vertical, horizontal.transpose(3, 4))


def aggregate_locally(
    costs: Float[Tensor, "b d h w"], weights: Float[Tensor, "b 75 h w"], times: int = 1
) -> Float[Tensor, "b d h w"]:
    """Return each cost as a weighted sum over 5x5 pixels and three neighbouring candidates (equation 7).

    Args:
        costs: Cost, or likelihood, of each candidate [B, D, H, W].
        weights: For the next lower, the same and the next higher candidate, the weights of the window's rows
            [B, 3 * 5 * 5, H, W]. They are divided by the sum of their magnitudes.
        times: How often the costs are aggregated with these weights.
    """
    costs = costs.float()
    batch, levels, height, width = costs.shape
    shares = _share(weights.float(), 1).view(batch, 3, _WINDOW, _WINDOW, height, width)
    inside = F.unfold(costs.new_ones(1, 1, height, width), _WINDOW, padding=LOCAL_RADIUS)
    inner = shares * inside.view(_WINDOW, _WINDOW, height, width)
    lower, _, higher = inner.sum((2, 3)).unbind(1)
    # What lies outside the volume has the pixel's own cost.
    own = (shares - inner).sum((1, 2, 3)).unsqueeze(1).repeat(1, levels, 1, 1)
    own[:, 0] += lower
    own[:, -1] += higher
    for _ in range(times):
        padded = F.pad(costs, (LOCAL_RADIUS,) * 4 + (1, 1))
        costs = _filter(padded, shares) + own * costs
    return costs


def follow_in_torch(
    costs: Float[Tensor, "b c d n m"], weights: Float[Tensor, "b c 5 n m"], backwards: bool
) -> Float[Tensor, "b c d n m"]:
    """Return the costs aggregated along the fourth axis, from its start to its end, or against it."""
    if backwards:
        return follow_in_torch(costs.flip(3), weights.flip(3), False).flip(3)
    paths, shares = costs.unbind(3), weights.unsqueeze(3).unbind(4)
    aggregated = [paths[0] * shares[0].sum(2)]
    for cost, share in zip(paths[1:], shares[1:], strict=True):
        before = aggregated[-1]
        own, same, lower, higher, best = share.unbind(2)
        # The products are shifted instead of the costs, so that no shifted costs are kept for the gradient.
        from_lower = torch.cat([lower * cost[:, :, :1], (lower * before)[:, :, :-1]], 2)
        from_higher = torch.cat([(higher * before)[:, :, 1:], higher * cost[:, :, -1:]], 2)
        most = before.max(2, keepdim=True).values
        aggregated.append(own * cost + same * before + from_lower + from_higher + best * most)
    return torch.stack(aggregated, 3)


def filter_in_torch(
    padded: Float[Tensor, "b d2 h2 w2"], shares: Float[Tensor, "b 3 5 5 h w"]
) -> Float[Tensor, "b d h w"]:
    """Return the sum over 5x5 pixels and three candidates, given costs with two pixels and one more."""
    height, width = shares.shape[4:]
    levels = padded.shape[1] - 2
    sums = torch.zeros_like(padded[:, 1:-1, LOCAL_RADIUS:-LOCAL_RADIUS, LOCAL_RADIUS:-LOCAL_RADIUS])
    for k, i, j in itertools.product(range(3), range(_WINDOW), range(_WINDOW)):
        shifted = padded[:, k : k + levels, i : i + height, j : j + width]
        sums = sums + shifted * shares[:, k, i, j].unsqueeze(1)
    return sums


def _share(weights: Tensor, axis: int) -> Tensor:
    """Divide the weights by the sum of their magnitudes; half the time of PyTorch's `normalize`."""
    return weights / weights.abs().sum(axis, keepdim=True).clamp_min(_LEAST_SUM)


def _follow_both_ways(costs: Tensor, there: Tensor, back: Tensor) -> Tensor:
    """Return the larger of the costs aggregated along the fourth axis and against it."""
    if costs.device.type == "cpu":
        return _larger(_follow_on_cpu(costs, there, False), _follow_on_cpu(costs, back, True))
    # In one batch, which halves the number of small operations.
    both = torch.cat([costs, costs.flip(3)]), torch.cat([there, back.flip(3)])
    forwards, backwards = follow_in_torch(*both, backwards=False).chunk(2)
    return _larger(forwards, backwards.flip(3))


def _larger(costs: Tensor, others: Tensor) -> Tensor:
    """Return the larger costs. Of equal ones, `others` have the gradient, which `torch.maximum` halves.

    The gradient takes a third of the time of that of `torch.maximum`.
    """
    return torch.where(costs > others, costs, others)


def _follow_on_cpu(costs: Tensor, weights: Tensor, backwards: bool) -> Tensor:
    followed: Tensor = FollowPaths.apply(costs, weights, backwards)  # type: ignore[no-untyped-call]
    return followed


def _filter(padded: Tensor, shares: Tensor) -> Tensor:
    if padded.device.type == "cpu":
        filtered: Tensor = FilterWindows.apply(padded, shares)  # type: ignore[no-untyped-call]
        return filtered
    return filter_in_torch(padded, shares)
