"""How much WeaveNet's upsamplings amplify small changes of their inputs.

Two runtimes round differently. Where a pixel at a depth edge lies between two surfaces, its disparity changes
by the step between them times the change of its weights, which may be much more than the rounding.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from stereoweave.learn.models.layers import upsample_convex
from stereoweave.learn.models.weave import Refinement, WeaveNet, WeaveStages

# Disturbance of the disparity before a refinement, in pixels of its maps, and of the disparity (in
# levels) and the features after the aggregation: far above float32's rounding, and too small to move a match.
_COARSE_DISTURBANCE_PX, _QUARTER_DISTURBANCE = 0.05, 0.01
# An upsampled disparity may change by this much per unit of the disturbance. Most pixels stay below it. The
# slope is that of the mixture that training uses; `upsample_to_a_side` is up to twice as steep.
_LARGEST_AMPLIFICATION = 2.0


def predict_with_amplification(
    network: WeaveNet, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
) -> tuple[WeaveStages, Float[Tensor, ""]]:
    """Return the results of every stage, and the mean excess of the upsamplings' slopes over 2.

    A slope is the change of an upsampled disparity, divided by the disturbance of the disparity before a
    refinement, and for the first upsampling of what leaves the aggregation; all in pixels of the same size.
    The excess is summed over all upsamplings. It is computed in float32, since bfloat16 would round the
    changes away. The first upsampling counts only if the network has a completion.
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
    def enlarge(disparity: Tensor) -> Tensor:
        fine, logits, _ = refinement(disparity, *others)
        return upsample_convex(fine, logits)

    moved = disparity + _COARSE_DISTURBANCE_PX * torch.randn_like(disparity).sign()
    return _mean_excess((enlarge(moved) - enlarge(disparity)) / _COARSE_DISTURBANCE_PX)


def _measure_coarse(
    network: WeaveNet, disparity: Tensor, other: Tensor, quarter: Tensor, decoded: Tensor
) -> Tensor:
    def enlarge(disparity: Tensor, other: Tensor, decoded: Tensor) -> Tensor:
        assert network.completion is not None
        spread, features = network.completion(disparity, other, quarter, decoded)
        if network.propagation is not None:
            spread, features = network.propagation(spread, quarter, features)
        return upsample_convex(spread, network.weights(features))

    before = (disparity, other, decoded)
    after = (x + _QUARTER_DISTURBANCE * torch.randn_like(x) for x in before)
    return _mean_excess((enlarge(*after) - enlarge(*before)) / _QUARTER_DISTURBANCE)


def _mean_excess(slope: Tensor) -> Tensor:
    return (slope.abs() - _LARGEST_AMPLIFICATION).clamp(min=0).mean()
