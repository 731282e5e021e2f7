import json
from importlib.resources import files
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from learn_examples import complaint

from stereoweave.learn.export import fixed_size
from stereoweave.matching.matcher import Matcher, model_file

SMALL = Path(str(files("stereoweave") / "weights" / "small.onnx"))


@pytest.fixture(scope="module")
def fixed(tmp_path_factory):
    out = tmp_path_factory.mktemp("fixed") / "weights" / "small.onnx"
    fixed_size.fix_size(SMALL, out, 96, 64)
    return out


def run(file, views):
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    return session.run(None, views)


def test_a_file_for_one_size_computes_the_same_as_the_file_for_any_size(fixed, rng):
    views = {side: rng.random((1, 3, 64, 96), np.float32) for side in ("left", "right")}
    for found, expected in zip(run(fixed, views), run(SMALL, views), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-4)


def test_every_shape_in_the_file_is_constant_and_no_operator_computes_one(fixed):
    graph = onnx.load(fixed)
    assert {node.op_type for node in graph.graph.node} & set(fixed_size.SHAPES_BY_VALUE) == set()
    inferred = onnx.shape_inference.infer_shapes(graph, strict_mode=True).graph
    known = {x.name: x for x in (*inferred.value_info, *inferred.output)}
    for node in inferred.node:
        for value in node.output:
            assert all(side.HasField("dim_value") for side in known[value].type.tensor_type.shape.dim)
    properties = {x.key: x.value for x in graph.metadata_props}
    assert properties == {x.key: x.value for x in onnx.load(SMALL).metadata_props}
    card = json.loads(fixed.with_suffix(".json").read_text())
    assert card == json.loads(SMALL.with_suffix(".json").read_text()) | {"size": [96, 64]}


def test_a_matcher_pads_smaller_pictures_to_the_fixed_size(fixed, rng):
    left, right = rng.integers(0, 255, (2, 60, 90, 3), np.uint8)
    assert Matcher(fixed).fixed_size == (64, 96)
    assert Matcher(fixed).estimate(left, right).disparity_px.shape == (60, 90)


@pytest.mark.parametrize(
    ("width", "height", "suggested"), [(100, 64, "128x64"), (96, 16, "96x32"), (0, 64, "32x64")]
)
def test_a_size_that_the_network_cannot_take_is_refused(tmp_path, width, height, suggested):
    message = complaint(fixed_size.fix_size, SMALL, tmp_path / "out.onnx", width, height)
    expected = "size: expected multiples of 32 that are at least 32"
    assert message.startswith(f"{expected}, found {width}x{height}; ")
    assert suggested in message
    assert list(tmp_path.iterdir()) == []


def test_the_least_size_is_suggested_of_a_network_that_takes_multiples_of_32(tmp_path):
    base = model_file("base")
    message = complaint(fixed_size.fix_size, base, tmp_path / "out.onnx", 100, 16)
    assert "found 100x16; choose 128x32;" in message
    fixed_size.fix_size(base, tmp_path / "out.onnx", 128, 32)


def test_a_file_for_one_size_cannot_be_converted_to_another_size(fixed, tmp_path):
    message = complaint(fixed_size.fix_size, fixed, tmp_path / "out.onnx", 128, 64)
    assert message.endswith("found one for 96x64 only; use the file from which it was made")
