"""Layers of GA-Net that aggregate matching costs with weights predicted from the image.

F. Zhang, V. Prisacariu, R. Yang and P. H. S. Torr, GA-Net: Guided Aggregation Net for End-to-end Stereo
Matching, CVPR 2019, arXiv:1904.06587. Where the paper is silent, the layers do what the authors' code does
(github.com/feihuzhang/GANet, MIT licence): a cost whose neighbour lies outside the volume is weighted in the
neighbour's place. Written-out references of both layers are in tests/helpers/plain_guided_aggregation.py.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

# Weights per pixel and direction: own cost; before it on the path, the costs of the same candidate, the
# candidates one lower and one higher, and the largest of all candidates.
SEMI_GLOBAL_WEIGHTS = 5
DIRECTIONS = 4
LOCAL_RADIUS = 2
_WINDOW = 2 * LOCAL_RADIUS + 1
LOCAL_WEIGHTS = 3 * _WINDOW**2
# Rows that are filtered at a time, so that their costs stay in the processor's cache: half the time.
_BAND = 8


def aggregate_semi_globally(
    costs: Float[Tensor, "b c d h w"], weights: Float[Tensor, "b k h w"]
) -> Float[Tensor, "b c d h w"]:
    """Return the largest of the costs aggregated downwards, upwards, rightwards and leftwards (equation 5).

    A differentiable form of semi-global matching: its minimum over the candidates is replaced by a maximum,
    and its penalties by weights. Of each direction, the gradient needs one volume more than the costs.

    Args:
        costs: Matching cost [B, C, D, H, W].
        weights: For each direction, channel and pixel, five weights [B, 4 * C * 5, H, W]. They are divided by
            the sum of their magnitudes.
    """
    batch, channels, _, height, width = costs.shape
    # In float32, because bfloat16 would round the costs at every step of the path.
    costs = costs.float()
    shared = weights.float().view(batch, DIRECTIONS, channels, SEMI_GLOBAL_WEIGHTS, height, width)
    shared = F.normalize(shared, p=1, dim=3)
    down, up, right, left = shared.unbind(1)
    vertical = _follow_both_ways(costs.movedim(3, 0), down.movedim(3, 0), up.movedim(3, 0))
    horizontal = _follow_both_ways(costs.movedim(4, 0), right.movedim(4, 0), left.movedim(4, 0))
    return torch.maximum(vertical.movedim(0, 3), horizontal.movedim(0, 4))


def _follow_both_ways(costs: Tensor, there: Tensor, back: Tensor) -> Tensor:
    """Return the larger of the costs aggregated along the first axis and against it.

    Both ways are followed in one batch, which halves the number of small operations.
    """
    costs = torch.cat([costs, costs.flip(0)], 1)
    forwards, backwards = _follow(costs, torch.cat([there, back.flip(0)], 1)).chunk(2, 1)
    return torch.maximum(forwards, backwards.flip(0))


def _follow(
    costs: Float[Tensor, "n b c d m"], weights: Float[Tensor, "n b c 5 m"]
) -> Float[Tensor, "n b c d m"]:
    """Aggregate the costs along the first axis, from its start to its end."""
    paths, shares = costs.unbind(0), weights.unsqueeze(4).unbind(0)
    aggregated = [paths[0] * shares[0].sum(2)]
    for cost, share in zip(paths[1:], shares[1:], strict=True):
        before = aggregated[-1]
        own, same, lower, higher, best = share.unbind(2)
        # The products are shifted instead of the costs, so that no shifted costs are kept for the gradient.
        from_lower = torch.cat([lower * cost[:, :, :1], (lower * before)[:, :, :-1]], 2)
        from_higher = torch.cat([(higher * before)[:, :, 1:], higher * cost[:, :, -1:]], 2)
        most = before.max(2, keepdim=True).values
        aggregated.append(own * cost + same * before + from_lower + from_higher + best * most)
    return torch.stack(aggregated)


def aggregate_locally(
    costs: Float[Tensor, "b d h w"], weights: Float[Tensor, "b 75 h w"]
) -> Float[Tensor, "b d h w"]:
    """Return each cost as a weighted sum over 5x5 pixels and three neighbouring candidates (equation 7).

    Args:
        costs: Cost, or likelihood, of each candidate [B, D, H, W].
        weights: For the next lower, the same and the next higher candidate, the weights of the window's rows
            [B, 3 * 5 * 5, H, W]. They are divided by the sum of their magnitudes.
    """
    batch, _, height, width = costs.shape
    shares = F.normalize(weights.float(), p=1, dim=1).view(batch, 3, _WINDOW**2, height, width)
    inside = F.unfold(costs.new_ones(1, 1, height, width), _WINDOW, padding=LOCAL_RADIUS)
    inner = shares * inside.view(_WINDOW**2, height, width)
    padded = F.pad(costs, (LOCAL_RADIUS,) * 4)
    bands = [
        _filter_band(padded[:, :, top : top + _BAND + 2 * LOCAL_RADIUS], shares[..., top : top + _BAND, :])
        for top in range(0, height, _BAND)
    ]
    lower, same, higher = (torch.cat(parts, 2) for parts in zip(*bands, strict=True))
    at_bottom, at_top = (inner[:, side].sum(1, keepdim=True) for side in (0, 2))
    own = (shares - inner).sum((1, 2)).unsqueeze(1)
    from_lower = torch.cat([at_bottom * costs[:, :1], lower[:, :-1]], 1)
    from_higher = torch.cat([higher[:, 1:], at_top * costs[:, -1:]], 1)
    return from_lower + same + from_higher + own * costs


def _filter_band(padded: Float[Tensor, "b d h2 w2"], shares: Float[Tensor, "b 3 25 h w"]) -> list[Tensor]:
    """Filter the costs of a few rows with each of the three sets of weights."""
    height, width = shares.shape[3:]
    sums: list[Tensor] = []
    for place in range(_WINDOW**2):
        y, x = divmod(place, _WINDOW)
        shifted = padded[:, :, y : y + height, x : x + width]
        products = [shifted * share.unsqueeze(1) for share in shares[:, :, place].unbind(1)]
        sums = [total + product for total, product in zip(sums, products, strict=True)] if sums else products
    return sums
