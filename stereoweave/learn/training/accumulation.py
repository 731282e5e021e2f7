"""Sums over a step's micro-batches, independent of how many processes compute them."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from lightning_fabric import Fabric
from torch import Tensor, nn

_BATCH_NORMS = (nn.BatchNorm1d, nn.BatchNorm2d, nn.BatchNorm3d, nn.SyncBatchNorm)


class StepSums:
    """Losses, gradients and batch-norm statistics, summed over the micro-batches of one step.

    PyTorch's DistributedDataParallel adds gradients in float32. Such sums depend on the order of addition,
    and therefore on the number of processes: losses differ by 1 % after 50 steps of a small network. Here,
    gradients are added in float64. After rounding back to float32, only about one value in millions
    depends on the order.
    """

    def __init__(self, network: nn.Module) -> None:
        self.parameters = list(network.parameters())
        layers = (layer for layer in network.modules() if isinstance(layer, _BATCH_NORMS))
        self.norms = [layer for layer in layers if layer.training]
        found = [value for layer in self.norms for value in (layer.running_mean, layer.running_var)]
        self.statistics = [value for value in found if value is not None]
        self.before = [value.clone() for value in self.statistics]
        self.count, self.total = 0, torch.zeros(())

    def add(self, losses: Sequence[Float[Tensor, ""]]) -> None:
        """Add a micro-batch after its backward pass, and restore the statistics from before the step."""
        values = [*losses, *self._gradients(), *self.statistics]
        # Apple's GPUs have no float64, but they never train in several ranks either.
        exact = torch.float32 if losses[0].device.type == "mps" else torch.float64
        row = torch.cat([value.detach().flatten().to(exact) for value in values])
        # In place, as below, because a large network's sums take as much memory as the optimiser.
        self.total = self.total.add_(row) if self.count else row
        self.count += 1
        for value, before in zip(self.statistics, self.before, strict=True):
            value.copy_(before)

    def finish(self, fabric: Fabric, micro_batches: int) -> list[float]:
        """Set gradients and statistics to their means over all micro-batches. Returns the mean losses."""
        total = fabric.all_reduce(self.total, reduce_op="sum")
        assert isinstance(total, Tensor)
        into = [*self._gradients(), *self.statistics]
        sizes = [value.numel() for value in into]
        losses, *means = torch.split(total.div_(micro_batches), [len(total) - sum(sizes), *sizes])
        for value, mean in zip(into, means, strict=True):
            value.copy_(mean.view_as(value))
        for layer in self.norms:
            # Batch norms count a step as one batch.
            if layer.num_batches_tracked is not None:
                layer.num_batches_tracked -= self.count - 1
        return losses.tolist()

    def undo(self) -> None:
        """Restore the batch-norm statistics from before the step."""
        for value, before in zip(self.statistics, self.before, strict=True):
            value.copy_(before)
        for layer in self.norms:
            if layer.num_batches_tracked is not None:
                layer.num_batches_tracked -= 1

    def _gradients(self) -> list[Tensor]:
        return [value.grad for value in self.parameters if value.grad is not None]
