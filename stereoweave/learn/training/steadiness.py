"""How much WeaveNet's upsampling logits amplify small changes of their inputs.

At a depth edge, a logit decides between surfaces that may be 100 px apart. Two runtimes round differently; a
logit that amplifies the difference gives single pixels other disparities in each of them.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from jaxtyping import Float
from torch import Tensor, nn

from stereoweave.learn.models.weave import WeaveNet, WeaveStages

# Disturbance of the disparity before the refinement, in half-resolution pixels, and of the disparity and the
# features after the aggregation: far above float32's rounding, and too small to move a match.
_OF_COARSE, _OF_QUARTER = 0.05, 0.01
# Logits may change by this much per unit of the disturbance.
_LARGEST_AMPLIFICATION = 1.0


def predict_with_amplification(
    network: WeaveNet, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
) -> tuple[WeaveStages, Float[Tensor, ""]]:
    """Return the results of every stage, and the amplification of the upsampling logits.

    That is the mean square by which the logits' difference quotients exceed 1. They are computed in float32,
    since bfloat16 would round the differences away.
    """
    watched = [module for module in (network.refinement, network.completion) if module is not None]
    with _record_inputs(watched) as inputs:
        stages = network.stages(left, right)
    with torch.autocast(left.device.type, enabled=False):
        excess = _amplify_fine(network, *(x.float() for x in inputs[0]))
        if network.completion is not None:
            excess = excess + _amplify_coarse(network, *(x.float() for x in inputs[1]))
    return stages, excess


@contextmanager
def _record_inputs(modules: Sequence[nn.Module]) -> Iterator[list[tuple[Tensor, ...]]]:
    """Yield a list that holds the inputs of each module's last call."""
    inputs: list[tuple[Tensor, ...]] = [()] * len(modules)
    hooks = [
        module.register_forward_pre_hook(lambda _, given, place=i: inputs.__setitem__(place, given))
        for i, module in enumerate(modules)
    ]
    try:
        yield inputs
    finally:
        for hook in hooks:
            hook.remove()


def _amplify_fine(network: WeaveNet, disparity: Tensor, *others: Tensor) -> Tensor:
    moved = disparity + _OF_COARSE * torch.randn_like(disparity).sign()
    _, before, _ = network.refinement(disparity, *others)
    _, after, _ = network.refinement(moved, *others)
    return _mean_excess((after - before) / _OF_COARSE)


def _amplify_coarse(
    network: WeaveNet, disparity: Tensor, other: Tensor, quarter: Tensor, decoded: Tensor
) -> Tensor:
    def weigh(*moved: Tensor) -> Tensor:
        assert network.completion is not None
        spread, features = network.completion(moved[0], moved[1], quarter, moved[2])
        if network.propagation is not None:
            _, features = network.propagation(spread, quarter, features)
        logits: Tensor = network.weights(features)
        return logits

    before = (disparity, other, decoded)
    after = (x + _OF_QUARTER * torch.randn_like(x) for x in before)
    return _mean_excess((weigh(*after) - weigh(*before)) / _OF_QUARTER)


def _mean_excess(amplification: Tensor) -> Tensor:
    return (amplification.abs() - _LARGEST_AMPLIFICATION).clamp(min=0).square().mean()
