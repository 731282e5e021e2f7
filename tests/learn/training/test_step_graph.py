"""When a step is recorded and replayed. The GPU is replaced: tests run on machines without one."""

from contextlib import nullcontext

import pytest
import torch
from learn_examples import recipe_of

from stereoweave.learn.models import MODELS, build_network
from stereoweave.learn.training.objective import build_objective
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
        self.inputs, self.outputs = batch, {"y": 2 * batch["x"]}
        return self.outputs

    def replay(self):
        self.outputs["y"].copy_(2 * self.inputs["x"])


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
    return [graph({"x": torch.tensor([float(i)])})["y"].tolist() for i in range(count)]


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


def test_a_batch_of_another_shape_is_refused_rather_than_broadcast(doubling):
    graph = StepGraph(doubling)
    for _ in range(4):
        graph({"x": torch.zeros(2)})
    with pytest.raises(AssertionError, match="same shapes"):
        graph({"x": torch.zeros(1)})


@pytest.mark.parametrize("name", [name for name in MODELS if not name.startswith(("weave", "mc_cnn"))])
def test_the_steps_of_every_network_of_the_papers_comparison_can_be_recorded(name):
    """Tensors without values raise where Python would have to wait for the GPU to read one."""
    recipe = recipe_of(name, crop_size=(64, 96), max_disparity_px=48.0)
    with torch.device("meta"):
        network = build_network(recipe).train()
        objective = build_objective(recipe, network)
        batch = {
            "left": torch.rand(2, 3, 96, 96),
            "right": torch.rand(2, 3, 96, 96),
            "disparity_px": torch.rand(4, 1, 96, 96),
        }
        terms = objective.losses(objective.predict(network, batch), batch)
        torch.stack(list(terms.values())).sum().backward()
    assert objective.recordable


def test_steps_whose_work_depends_on_the_batch_are_not_recorded():
    for name, loss in (("weave_small", "weave"), ("mc_cnn", "hinge")):
        recipe = recipe_of(name, loss=loss)
        assert not build_objective(recipe, build_network(recipe)).recordable
