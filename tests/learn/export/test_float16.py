import json
from importlib.resources import files
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from learn_examples import PAIR_SIZE, box_before_a_wall, complaint
from onnx import TensorProto, helper, numpy_helper

from stereoweave.learn.export import float16 as halve
from stereoweave.matching.matcher import Matcher

SMALL = Path(str(files("stereoweave") / "weights" / "small.onnx"))


@pytest.fixture
def small_pairs(monkeypatch):
    monkeypatch.setattr(halve, "_SIZE", PAIR_SIZE)
    monkeypatch.setattr(halve, "_PROOF_PAIRS", 2)


def a_graph_that_reads_a_disparity():
    """Return a graph that convolves with 1.0001 (1 in 16 bits), multiplies by 192 and subtracts 0.03."""
    nodes = [
        helper.make_node("Conv", ["image", "weight"], ["a"], "conv"),
        helper.make_node("Relu", ["a"], ["b"], "relu"),
        helper.make_node("Mul", ["b", "levels"], ["c"], "read"),
        helper.make_node("Sub", ["c", "part"], ["d"], "part_of_a_px"),
    ]
    weights = {"weight": np.full((1, 1, 1, 1), 1.0001), "levels": np.array(192), "part": np.array(0.03)}
    image, last = (helper.make_tensor_value_info(x, TensorProto.FLOAT, [1, 1, 1, 2]) for x in ("image", "d"))
    stored = [numpy_helper.from_array(x.astype(np.float32), name) for name, x in weights.items()]
    graph = helper.make_graph(nodes, "graph", [image], [last], stored)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)


def test_convolutions_compute_in_16_bits_and_disparities_in_32():
    graph = a_graph_that_reads_a_disparity()
    assert halve.select_float16_nodes(graph) == {"conv", "relu"}
    made = halve.cast_to_float16(graph, {"conv", "relu"})
    assert [node.op_type for node in made.graph.node] == ["Cast", "Conv", "Relu", "Cast", "Mul", "Sub"]
    session = onnxruntime.InferenceSession(made.SerializeToString(), providers=["CPUExecutionProvider"])
    (found,) = session.run(None, {"image": np.array([[[[0.5, 1.0]]]], np.float32)})
    # At 192 px 16 bits resolve 1/8 px: they would give 95.9375 and 192.
    np.testing.assert_allclose(found[0, 0, 0], [95.97, 191.97], atol=1e-4)


def test_a_float16_file_is_half_as_large_and_its_card_has_the_small_difference(small_pairs, tmp_path):
    out = tmp_path / "weights" / "small16.onnx"
    card = halve.convert_to_float16(SMALL, out)
    assert out.stat().st_size < 0.55 * SMALL.stat().st_size
    sample = box_before_a_wall(np.random.default_rng(0))
    before, after = (Matcher(file).estimate(sample.left, sample.right) for file in (SMALL, out))
    assert 0 < np.abs(after.disparity_px - before.disparity_px).mean() < 0.02
    assert Matcher(out).max_disparity_px == Matcher(SMALL).max_disparity_px
    assert json.loads(out.with_suffix(".json").read_text()) == card
    assert card["bits"] == 16
    assert 0 < card["differs_px_from_32_bits"] < 0.02
    assert card["parameters"] == json.loads(SMALL.with_suffix(".json").read_text())["parameters"]

    # A variant cannot be the source of another one.
    message = complaint(halve.convert_to_float16, out, tmp_path / "again.onnx")
    assert message.endswith("found one in float16; use the file from which it was made")


def test_only_convolutions_and_products_have_weights_of_16_bits():
    graph = onnx.load(SMALL)
    made = halve.cast_to_float16(graph, halve.select_float16_nodes(graph)).graph
    of_32_bits = {x.name for x in made.initializer if x.data_type == TensorProto.FLOAT}
    readers = {node.op_type for node in made.node if of_32_bits & set(node.input)}
    assert readers & {"Conv", "MatMul", "Relu"} == set()
    assert [x.type.tensor_type.elem_type for x in (*made.input, *made.output)] == [TensorProto.FLOAT] * 5


def test_nothing_is_written_if_16_bits_change_disparity_too_much(small_pairs, tmp_path, monkeypatch):
    monkeypatch.setattr(halve, "LARGEST_MEAN_DIFFERENCE_PX", 0.0)
    message = complaint(halve.convert_to_float16, SMALL, tmp_path / "small16.onnx")
    assert "expected float16 to change disparity by less than 0.0 px on average, found 0.0" in message
    assert message.endswith(" px; nothing was written")
    assert list(tmp_path.iterdir()) == []
