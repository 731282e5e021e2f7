"""CUDA graphs of gradients: a small network's kernels take less time than a processor needs to start them."""

import logging
from collections.abc import Callable

import torch
from torch import Tensor

Batch = dict[str, Tensor]

# A graph records no first-time work, such as the choice of a convolution's algorithm.
_EAGER_CALLS = 3

_LOGGER = logging.getLogger(__name__)


class StepGraph:
    """A function of a batch that is recorded once on the GPU, and replayed for all later batches.

    The function must do the same work on the GPU for every batch, without waiting for it; all batches have
    the same shapes. It returns tensors, and may leave others behind, such as gradients. Each call overwrites
    the tensors of the call before. If recording fails, a warning is logged, and the function is called as it
    is.
    """

    def __init__(self, compute: Callable[[Batch], list[Tensor]]) -> None:
        self._compute = compute
        self._calls = 0
        self._stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        self._graph: torch.cuda.CUDAGraph | None = None
        self._inputs: Batch = {}
        self._outputs: list[Tensor] = []

    def __call__(self, batch: Batch) -> list[Tensor]:
        self._calls += 1
        if self._calls == _EAGER_CALLS + 1:
            self._record(batch)
        if self._graph is None:
            return self._call_aside(batch)
        for name, value in batch.items():
            self._inputs[name].copy_(value)
        self._graph.replay()
        return self._outputs

    def _call_aside(self, batch: Batch) -> list[Tensor]:
        """Call the function in a stream of its own, as recording does."""
        self._stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._stream):
            outputs = self._compute(batch)
        torch.cuda.current_stream().wait_stream(self._stream)
        return outputs

    def _record(self, batch: Batch) -> None:
        self._inputs = {name: value.clone() for name, value in batch.items()}
        graph = torch.cuda.CUDAGraph()
        try:
            with torch.cuda.graph(graph, stream=self._stream):
                self._outputs = self._compute(self._inputs)
        except RuntimeError as error:
            _LOGGER.warning("steps are computed without a CUDA graph: %s", error)
            return
        self._graph = graph
