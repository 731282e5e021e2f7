from collections import Counter

import numpy as np
import onnx
import pytest
import torch
from learn_examples import RECIPE, recipe_of, untrained

from experiments.speed import timing as speed

HEIGHT, WIDTH = 64, 96
SHARE = HEIGHT * WIDTH / (480 * 640)


@pytest.fixture(scope="module")
def timed():
    """Return the rows of the two cheap networks at a small size, the calls made, and the graphs."""
    graphs, calls = [], {}
    with pytest.MonkeyPatch.context() as patch:
        exported, measure_ms = speed.export_fixed_graph, speed._measure_ms
        patch.setattr(speed, "HEIGHT_PX", HEIGHT)
        patch.setattr(speed, "WIDTH_PX", WIDTH)
        patch.setattr(speed, "thread_count", lambda _: 1)
        patch.setattr(
            speed, "export_fixed_graph", lambda *arguments: graphs.append(exported(*arguments)) or graphs[-1]
        )
        patch.setattr(
            speed, "_measure_ms", lambda given, turns: calls.update(given) or measure_ms(given, turns)
        )
        # A recipe with another loss, on which timing does not depend.
        rows = speed.measure_run_times(RECIPE, ("fast_depth", "densemapnet"), turns=2)
        torch.manual_seed(0)
    return {row.network: row for row in rows}, calls, graphs


def test_a_ratio_is_to_densemapnet(timed):
    rows, _, _ = timed
    ours, reference = rows["fast_depth"], rows["densemapnet"]
    assert (reference.eager_relative, reference.onnx_relative) == (1, 1)
    assert ours.eager_relative == ours.eager_ms / reference.eager_ms
    assert ours.onnx_relative == ours.onnx_ms / reference.onnx_ms
    assert min(ours.eager_ms, ours.onnx_ms) > 0


def test_a_row_has_the_published_parameters_and_multiply_adds(timed):
    rows, _, _ = timed
    assert {name: row.parameters for name, row in rows.items()} == {
        "fast_depth": 314_722,
        "densemapnet": 290_290,
    }
    # 7.39 and 8.41 billion at 640x480.
    assert rows["fast_depth"].multiply_adds == pytest.approx(7.39e9 * SHARE, rel=2e-3)
    assert rows["densemapnet"].multiply_adds == pytest.approx(8.41e9 * SHARE, rel=2e-3)


def test_what_is_timed_in_both_runtimes_gives_the_same_disparity(timed):
    _, calls, _ = timed
    for eager, in_onnx in calls.values():
        (expected_px,), (found_px,) = eager(), in_onnx()
        assert expected_px.shape == (1, 1, HEIGHT, WIDTH)
        np.testing.assert_allclose(found_px, expected_px.numpy(), atol=0.01)
    # The two networks have different random weights, so their outputs differ.
    assert np.abs(calls["fast_depth"][1]()[0] - calls["densemapnet"][1]()[0]).max() > 1


def test_the_graph_is_for_that_size_alone(timed):
    _, _, graphs = timed
    for graph in graphs:
        onnx.checker.check_model(graph)
        shapes = {
            value.name: [side.dim_value for side in value.type.tensor_type.shape.dim]
            for value in (*graph.graph.input, *graph.graph.output)
        }
        assert shapes == {
            "left": [1, 3, HEIGHT, WIDTH],
            "right": [1, 3, HEIGHT, WIDTH],
            "disparity_px": [1, 1, HEIGHT, WIDTH],
        }


def test_a_network_without_a_graph_has_no_time_in_onnx_runtime(monkeypatch):
    monkeypatch.setattr(speed, "HEIGHT_PX", HEIGHT)
    monkeypatch.setattr(speed, "WIDTH_PX", WIDTH)
    network = speed.DisparityNetwork(untrained("densemapnet"), recipe_of("densemapnet"))
    times_ms = {"densemapnet": [20.0, 10.0], "ganet_11": [500.0]}
    found = speed._make_row("ganet_11", network, times_ms)
    assert (found.eager_ms, found.eager_relative, found.onnx_ms, found.onnx_relative) == (500, 25, None, None)


def test_every_network_is_warmed_up_and_psmnet_is_called_a_third_as_often():
    called = []
    calls = {name: (lambda name=name: called.append(name),) * 2 for name in ("densemapnet", "psmnet")}
    times_ms = speed._measure_ms(calls, turns=7)
    # Turns 0, 3 and 6 of seven, and one before that is not timed; both runtimes each.
    assert Counter(called) == {"densemapnet": 2 * 8, "psmnet": 2 * 4}
    assert called[:4] == ["densemapnet"] * 2 + ["psmnet"] * 2
    assert {name: len(both) for name, both in times_ms.items()} == {"densemapnet": 2, "psmnet": 2}
