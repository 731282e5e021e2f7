"""CUDA graphs of gradients: a small network's kernels take less time than a processor needs to start them."""

from collections.abc import Callable

import torch
from torch import Tensor

Tensors = dict[str, Tensor]

# A graph must not record first-time work, such as the choice of a convolution's algorithm.
_EAGER_CALLS = 3


class StepGraph:
    """A function of a batch that is recorded on the GPU at its fourth call, and replayed from then on.

    The function must run the same operations for every batch, without waiting for the GPU. It may also write
    to other tensors, such as gradients. Each call overwrites the tensors that the call before returned.
    """

    def __init__(self, compute: Callable[[Tensors], Tensors]) -> None:
        self._compute = compute
        self._calls = 0
        # One stream for all calls, because gradients are accumulated in the stream of their first use.
        self._stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        self._graph: torch.cuda.CUDAGraph | None = None
        self._inputs: Tensors = {}
        self._outputs: Tensors = {}

    def __call__(self, batch: Tensors) -> Tensors:
        self._calls += 1
        if self._calls <= _EAGER_CALLS:
            return self._call_on_own_stream(batch)
        if self._graph is None:
            self._record(batch)
            assert self._graph is not None
        # Copying would broadcast a smaller batch without an error.
        assert _shapes(batch) == _shapes(self._inputs), "all batches must have the same shapes"
        for name, value in batch.items():
            self._inputs[name].copy_(value)
        self._graph.replay()
        return self._outputs

    def _call_on_own_stream(self, batch: Tensors) -> Tensors:
        self._stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._stream):
            outputs = self._compute(batch)
        torch.cuda.current_stream().wait_stream(self._stream)
        return outputs

    def _record(self, batch: Tensors) -> None:
        self._inputs = {name: value.clone() for name, value in batch.items()}
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph, stream=self._stream):
            self._outputs = self._compute(self._inputs)


def _shapes(tensors: Tensors) -> dict[str, torch.Size]:
    return {name: value.shape for name, value in tensors.items()}
