import json
from importlib.resources import files
from pathlib import Path

import numpy as np
import onnx
import pytest
from learn_examples import PAIR_SIZE, box_before_a_wall, complaint
from onnx import TensorProto, helper

from stereoweave.learn.export import int8 as quantise
from stereoweave.matching.matcher import Matcher

SMALL = Path(str(files("stereoweave") / "weights" / "small.onnx"))


@pytest.fixture
def small_pairs(monkeypatch):
    monkeypatch.setattr(quantise, "_SIZE", PAIR_SIZE)
    monkeypatch.setattr(quantise, "_RANGES_PAIRS", 2)
    monkeypatch.setattr(quantise, "_PROOF_PAIRS", 2)
    # The loss varies more on pictures this small than at the network's own size.
    monkeypatch.setattr(quantise, "LARGEST_LOSS_PX", 1.0)


def conv(value, weights, given):
    return helper.make_node("Conv", [value, weights], [given], f"conv_{given}")


def node(operation, read, given):
    return helper.make_node(operation, read, [given], f"{operation}_{given}")


def test_only_convolutions_and_nodes_between_them_take_8_bits():
    nodes = [
        conv("image", "encoder.weight", "a"),
        node("Relu", ["a"], "b"),
        conv("b", "body.weight", "c"),
        node("Add", ["b", "c"], "d"),
        node("Concat", ["d", "b"], "e"),
        conv("e", "scores.weight", "f"),
        node("Relu", ["f"], "g"),  # follows a convolution, though other nodes read it
        node("Add", ["g", "image"], "h"),  # no convolution reads it
        node("Concat", ["h", "g"], "i"),  # read by a convolution that stays in float32
        conv("i", "refinement.join.weight", "j"),
        conv("j", "enlargement.join.weight", "k"),
    ]
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, None)
    last = helper.make_tensor_value_info("k", TensorProto.FLOAT, None)
    graph = helper.make_model(helper.make_graph(nodes, "graph", [image], [last]))
    assert quantise.select_int8_nodes(graph) == [
        "conv_a", "Relu_b", "conv_c", "Add_d", "Concat_e", "conv_f", "Relu_g",
    ]  # fmt: skip


def test_an_8_bit_file_is_smaller_and_its_card_has_the_small_loss(small_pairs, tmp_path):
    out = tmp_path / "weights" / "small8.onnx"
    card = quantise.quantise(SMALL, out)
    assert out.stat().st_size < SMALL.stat().st_size / 2
    sample = box_before_a_wall(np.random.default_rng(0))
    before, after = (Matcher(file).estimate(sample.left, sample.right) for file in (SMALL, out))
    change_px = np.abs(after.disparity_px - before.disparity_px)
    assert 0 < np.median(change_px) < 0.25
    assert Matcher(out).max_disparity_px == Matcher(SMALL).max_disparity_px
    assert json.loads(out.with_suffix(".json").read_text()) == card
    assert card["bits"] == 8
    assert card["epe_px"] - card["epe_px_of_32_bits"] < 1
    assert card["parameters"] == json.loads(SMALL.with_suffix(".json").read_text())["parameters"]


def test_only_the_refinements_keep_weights_of_32_bits(small_pairs, tmp_path):
    quantise.quantise(SMALL, tmp_path / "small8.onnx")
    graph = onnx.load(tmp_path / "small8.onnx").graph
    kept = [
        value.name
        for value in graph.initializer
        if value.name.endswith("weight") and value.data_type == TensorProto.FLOAT
    ]
    assert {name.split(".")[0] for name in kept} == {"refinement", "enlargement"}


def test_wider_ranges_are_tried_where_narrow_ones_lose_too_much(small_pairs, tmp_path, monkeypatch):
    monkeypatch.setattr(quantise, "_RANGE_PERCENTILES", (1.0, 99.99))
    assert quantise.quantise(SMALL, tmp_path / "small8.onnx")["range_percentile"] == 99.99


def test_nothing_is_written_if_8_bits_lose_too_much(small_pairs, tmp_path, monkeypatch):
    monkeypatch.setattr(quantise, "LARGEST_LOSS_PX", -10.0)
    message = complaint(quantise.quantise, SMALL, tmp_path / "small8.onnx")
    assert "expected 8 bits to increase the mean error by less than -10.0 px, found " in message
    assert message.endswith(" px; nothing was written")
    assert list(tmp_path.iterdir()) == []
