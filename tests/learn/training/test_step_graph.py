"""When a step is recorded and replayed. The GPU is replaced: tests run on machines without one."""

from contextlib import contextmanager, nullcontext

import pytest
import torch

from stereoweave.learn.training.step_graph import StepGraph


class Stream:
    def wait_stream(self, other):
        pass


class Doubling:
    """A function whose work can be replayed: it doubles `x` into the tensor that it returned first."""

    def __init__(self):
        self.seen, self.inputs, self.outputs = [], None, None

    def __call__(self, batch):
        self.seen.append(batch["x"].tolist())
        self.inputs, self.outputs = batch, [2 * batch["x"]]
        return self.outputs

    def replay(self):
        self.outputs[0].copy_(2 * self.inputs["x"])


@pytest.fixture
def doubling(monkeypatch):
    """Replace the GPU's streams and graphs; a graph repeats what was called while it was recorded."""
    compute = Doubling()
    monkeypatch.setattr(torch.cuda, "Stream", Stream)
    monkeypatch.setattr(torch.cuda, "current_stream", Stream)
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: nullcontext())
    monkeypatch.setattr(torch.cuda, "CUDAGraph", lambda: compute)
    monkeypatch.setattr(torch.cuda, "graph", lambda graph, stream: nullcontext())
    return compute


def results_of(graph, count):
    return [graph({"x": torch.tensor([float(i)])})[0].tolist() for i in range(count)]


def test_three_steps_are_computed_the_fourth_is_recorded_and_all_later_ones_are_replayed(doubling):
    assert results_of(StepGraph(doubling), 6) == [[0.0], [2.0], [4.0], [6.0], [8.0], [10.0]]
    # Batches 0 to 2 are computed, 3 is recorded, and none is computed after it.
    assert doubling.seen == [[0.0], [1.0], [2.0], [3.0]]


def test_a_replay_leaves_the_batch_that_was_recorded_alone(doubling):
    graph = StepGraph(doubling)
    results_of(graph, 3)
    recorded = {"x": torch.tensor([3.0])}
    graph(recorded)
    graph({"x": torch.tensor([4.0])})
    assert recorded["x"].tolist() == [3.0]


def test_what_cannot_be_recorded_is_computed_and_said_once(doubling, monkeypatch, caplog):
    @contextmanager
    def refuse(graph, stream):
        yield
        raise RuntimeError("operation not permitted when stream is capturing")

    monkeypatch.setattr(torch.cuda, "graph", refuse)
    assert results_of(StepGraph(doubling), 6) == [[0.0], [2.0], [4.0], [6.0], [8.0], [10.0]]
    assert [record.getMessage() for record in caplog.records] == [
        "steps are computed without a CUDA graph: operation not permitted when stream is capturing"
    ]
