"""Matcher files with handwritten graphs, and images for them."""

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper

from stereoweave.matching.matcher import model_file

ANY_SIZE = ("b", "h", "w")
PROPERTIES = {"name": "by_hand", "multiple_of": 16, "max_disparity_px": 255}


def matcher_file(
    path: Path, nodes, outputs, properties=PROPERTIES, inputs=("left", "right"), size=ANY_SIZE
) -> Path:
    """Write a matcher file from graph nodes, which may use the constants below.

    `size` holds batch, height and width of the inputs as numbers, or as names for dynamic dimensions.
    """
    batch, height, width = size
    graph = helper.make_graph(
        nodes,
        "by_hand",
        [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, [batch, 3, height, width])
            for name in inputs
        ],
        [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, [batch, 1, height, width])
            for name in outputs
        ],
        [
            helper.make_tensor("red", TensorProto.INT64, [1], [0]),
            helper.make_tensor("last", TensorProto.INT64, [1], [-1]),
            helper.make_tensor("scale", TensorProto.FLOAT, [1], [255.0]),
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    helper.set_model_props(model, {f"stereoweave.{key}": str(value) for key, value in properties.items()})
    onnx.save(model, path)
    return path


def red_of(image: str, output: str):
    """Return nodes that output an image's red channel in 0..255, in which tests encode disparity."""
    return [
        helper.make_node("Gather", [image, "red"], [f"{output}_red"], axis=1),
        helper.make_node("Mul", [f"{output}_red", "scale"], [output]),
    ]


def of_fixed_size(model: str, path: Path, height: int, width: int) -> Path:
    """Write a shipped network as a matcher file for a fixed input size."""
    graph = onnx.load(model_file(model))
    for value in (*graph.graph.input, *graph.graph.output):
        dims = value.type.tensor_type.shape.dim
        for dim, side in ((dims[0], 1), (dims[2], height), (dims[3], width)):
            dim.dim_value = side
    del graph.graph.value_info[:]
    onnx.save(graph, path)
    return path


def painted(disparity_px) -> np.ndarray:
    return np.repeat(np.asarray(disparity_px, np.uint8)[:, :, None], 3, axis=2)
