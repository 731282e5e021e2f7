"""Matcher files whose graphs are written by hand, and the pictures that they read."""

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper

IMAGE = ["b", 3, "h", "w"]
MAP = ["b", 1, "h", "w"]
PROPERTIES = {"name": "by_hand", "multiple_of": 16, "max_disparity_px": 255}


def matcher_file(path: Path, nodes, outputs, properties=PROPERTIES, inputs=("left", "right")) -> Path:
    """A matcher file whose graph is written by hand; the constants below are there to use."""
    graph = helper.make_graph(
        nodes,
        "by_hand",
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, IMAGE) for name in inputs],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, MAP) for name in outputs],
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
    """Nodes that give the red channel of an image in 0..255: a disparity that the test paints."""
    return [
        helper.make_node("Gather", [image, "red"], [f"{output}_red"], axis=1),
        helper.make_node("Mul", [f"{output}_red", "scale"], [output]),
    ]


def painted(disparity_px) -> np.ndarray:
    return np.repeat(np.asarray(disparity_px, np.uint8)[:, :, None], 3, axis=2)
