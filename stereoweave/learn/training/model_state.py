"""Network, weight average, optimiser and objective: the state that both training loops share."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

from stereoweave.errors import FormatError
from stereoweave.learn.checkpoint import Checkpoint
from stereoweave.learn.models import build_network
from stereoweave.learn.recipe import Recipe
from stereoweave.learn.training.objective import Objective, build_objective

# A step with a loss or gradient that is not finite is skipped. A second such step within this many steps ends
# the run.
STEPS_BETWEEN_SKIPS = 500
_MAX_GRADIENT_NORM = 5.0


class ModelState:
    """Network, weight average, optimiser and objective, built from a checkpoint on a device.

    Args:
        start: Weights and recipe to start from.
        device: Device of the network and of its average.
        update_average: Function that moves the average towards the current weights, for `AveragedModel`.
        optimiser_state: State of the optimiser; {} for a new optimiser.
    """

    def __init__(
        self,
        start: Checkpoint,
        device: torch.device,
        update_average: Callable[..., None],
        optimiser_state: dict[str, Any],
    ) -> None:
        recipe = start.recipe
        self.start = start
        self.network: Any = build_network(recipe)
        self.network.load_state_dict(start.weights)
        self.objective: Objective = build_objective(recipe, self.network)
        for layer in self.network.modules():
            if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
                # bfloat16 convolutions on the CPU are three times as fast in this layout.
                layer.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.network.to(device)
        self.fixed = find_fixed_parts(self.network, recipe)
        for part in self.fixed:
            part.requires_grad_(False)
        self.averaged = AveragedModel(self.network, multi_avg_fn=update_average, use_buffers=True)
        self.averaged.module.load_state_dict(start.averaged)
        self.optimiser = torch.optim.AdamW(
            [value for value in self.network.parameters() if value.requires_grad],
            recipe.learning_rate,
            weight_decay=recipe.weight_decay,
            fused=True,
        )
        if optimiser_state:
            self.optimiser.load_state_dict(optimiser_state)

    def prepare_to_train(self) -> None:
        """Switch the network to training, except for the parts that keep their weights and statistics."""
        self.network.train()
        for part in self.fixed:
            part.eval()

    def clip_gradient(self) -> Tensor:
        """Scale the gradient down to a norm of at most 5. Returns the norm before scaling."""
        return nn.utils.clip_grad_norm_(self.network.parameters(), _MAX_GRADIENT_NORM)


def find_fixed_parts(network: nn.Module, recipe: Recipe) -> list[nn.Module]:
    """Return all parts of a network but those in `recipe.trained`; none if it is empty.

    Raises:
        FormatError: The network has no part of a name.
    """
    parts = dict(network.named_children())
    if unknown := set(recipe.trained) - parts.keys():
        raise FormatError(
            f"{recipe.name}: trained: expected parts of {recipe.model}, which are {', '.join(parts)}, "
            f"found {min(unknown)!r}"
        )
    return [part for name, part in parts.items() if recipe.trained and name not in recipe.trained]
