"""How much WeaveNet's upsampling logits amplify small changes of their inputs.

Two runtimes round differently. Where a logit amplifies the difference at a depth edge, a single pixel may get
disparities that differ by much more than the rounding.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from stereoweave.learn.models.weave import Refinement, WeaveNet, WeaveStages

# Disturbance of the disparity before a refinement, in pixels of its maps, and of the disparity (in
# levels) and the features after the aggregation: far above float32's rounding, and too small to move a match.
_COARSE_DISTURBANCE_PX, _QUARTER_DISTURBANCE = 0.05, 0.01
# Logits may change by this much per unit of the disturbance.
_LARGEST_AMPLIFICATION = 1.0


def predict_with_amplification(
    network: WeaveNet, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
) -> tuple[WeaveStages, Float[Tensor, ""]]:
    """Return the results of every stage, and the mean squared excess of the logits' slopes over 1.

    A slope is a logit's change, divided by the disturbance of the disparity before a refinement, and for the
    first upsampling of what leaves the aggregation. The excess is summed over all upsamplings. It is computed
    in float32, since bfloat16 would round the changes away. The logits of the first upsampling count only if
    the network has a completion.
    """
    watched = [*network.refinements, *([network.completion] if network.completion is not None else [])]
    with _record_inputs(watched) as inputs:
        stages = network.stages(left, right)
    with torch.autocast(left.device.type, enabled=False), _keep_statistics(network):
        excess = torch.zeros((), device=left.device)
        for refinement in network.refinements:
            excess = excess + _measure_fine(refinement, *(x.float() for x in inputs[refinement]))
        if network.completion is not None:
            excess = excess + _measure_coarse(network, *(x.float() for x in inputs[network.completion]))
    return stages, excess


@contextmanager
def _record_inputs(modules: Sequence[nn.Module]) -> Iterator[dict[nn.Module, tuple[Tensor, ...]]]:
    """Yield a dictionary that holds the inputs of each module's last call."""
    inputs: dict[nn.Module, tuple[Tensor, ...]] = {}

    def record(module: nn.Module, given: tuple[Any, ...]) -> None:
        inputs[module] = given

    hooks = [module.register_forward_pre_hook(record) for module in modules]
    try:
        yield inputs
    finally:
        for hook in hooks:
            hook.remove()


@contextmanager
def _keep_statistics(network: nn.Module) -> Iterator[None]:
    """Let batch norms in training mode normalise by the batch, without changing their running statistics."""
    kinds = (nn.BatchNorm2d, nn.SyncBatchNorm)
    norms = [layer for layer in network.modules() if isinstance(layer, kinds) and layer.training]
    for norm in norms:
        norm.track_running_stats = False
    try:
        yield
    finally:
        for norm in norms:
            norm.track_running_stats = True


def _measure_fine(refinement: Refinement, disparity: Tensor, *others: Tensor) -> Tensor:
    def compute_logits(disparity: Tensor) -> Tensor:
        _, logits, _ = refinement(disparity, *others)
        return logits

    moved = disparity + _COARSE_DISTURBANCE_PX * torch.randn_like(disparity).sign()
    return _mean_excess((compute_logits(moved) - compute_logits(disparity)) / _COARSE_DISTURBANCE_PX)


def _measure_coarse(
    network: WeaveNet, disparity: Tensor, other: Tensor, quarter: Tensor, decoded: Tensor
) -> Tensor:
    def compute_logits(disparity: Tensor, other: Tensor, decoded: Tensor) -> Tensor:
        assert network.completion is not None
        spread, features = network.completion(disparity, other, quarter, decoded)
        if network.propagation is not None:
            _, features = network.propagation(spread, quarter, features)
        return network.weights(features)

    before = (disparity, other, decoded)
    after = (x + _QUARTER_DISTURBANCE * torch.randn_like(x) for x in before)
    return _mean_excess((compute_logits(*after) - compute_logits(*before)) / _QUARTER_DISTURBANCE)


def _mean_excess(slope: Tensor) -> Tensor:
    return (slope.abs() - _LARGEST_AMPLIFICATION).clamp(min=0).square().mean()
