"""GA-Net's two layers as functions with gradients on a processor; guided_kernels.py computes both."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from stereoweave.learn.models import guided_kernels


class FollowPaths(torch.autograd.Function):
    """`guided_aggregation.follow_in_torch`, computed by Numba."""

    @staticmethod
    def forward(ctx: Any, costs: Tensor, weights: Tensor, backwards: bool) -> Tensor:
        """Return the costs [B, C, D, N, M] aggregated with weights [B, C, 5, N, M] along N, or against it."""
        costs, weights = costs.contiguous(), weights.contiguous()
        aggregated = torch.empty_like(costs)
        _run(
            lambda *volumes: guided_kernels.follow(*volumes[:2], int(backwards), *volumes[2:]),
            *(volume.flatten(0, 1) for volume in (costs, weights, aggregated)),
        )
        ctx.save_for_backward(costs, weights, aggregated)
        ctx.backwards = backwards
        return aggregated

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        """Return the gradients of the costs and of the weights."""
        costs, weights, aggregated = ctx.saved_tensors
        found = torch.empty_like(costs), torch.zeros_like(weights)
        volumes = (costs, weights, aggregated, gradient.contiguous(), *found)
        _run(
            lambda *volumes: guided_kernels.follow_gradients(*volumes[:2], int(ctx.backwards), *volumes[2:]),
            *(volume.flatten(0, 1) for volume in volumes),
        )
        return *found, None


class FilterWindows(torch.autograd.Function):
    """`guided_aggregation.filter_in_torch`, computed by Numba."""

    @staticmethod
    def forward(ctx: Any, padded: Tensor, shares: Tensor) -> Tensor:
        """Return the costs, padded to [B, D + 2, H + 4, W + 4], summed with shares [B, 3, 5, 5, H, W]."""
        padded, shares = padded.contiguous(), shares.contiguous()
        batch, levels = padded.shape[:2]
        filtered = padded.new_empty(batch, levels - 2, *shares.shape[4:])
        _run(guided_kernels.filter_windows, padded, shares, filtered)
        ctx.save_for_backward(padded, shares)
        return filtered

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gradients of the padded costs and of the shares."""
        padded, shares = ctx.saved_tensors
        found = torch.zeros_like(padded), torch.zeros_like(shares)
        _run(guided_kernels.filter_gradients, padded, shares, gradient.contiguous(), *found)
        return found


def _run(kernel: Callable[..., None], *volumes: Tensor) -> None:
    """Run a kernel for each element of the first axis, in at most PyTorch's number of threads."""
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        list(pool.map(kernel, *(volume.detach().numpy() for volume in volumes)))
