"""Matcher files, which are ONNX graphs with metadata."""

from pathlib import Path

from onnx import TensorProto, helper

from fuzz.targets import Target
from fuzz.targets.pictures import eyes
from stereoweave.matching.matcher import Matcher

_PROPERTIES = {"name": "by_rule", "multiple_of": "16", "max_disparity_px": "192"}


def _starts() -> dict[str, bytes]:
    return {"any.onnx": _matcher("b", "h", "w"), "fixed.onnx": _matcher(1, 48, 80)}


def _matcher(*size: int | str) -> bytes:
    """Return a matcher file whose disparity is the red channel of the left image."""
    batch, height, width = size
    pictures = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, [batch, 3, height, width])
        for name in ("left", "right")
    ]
    maps = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, [batch, 1, height, width])
        for name in ("disparity_px", "right_disparity_px", "confidence_logit")
    ]
    red = helper.make_tensor("red", TensorProto.INT64, [1], [0])
    nodes = [
        helper.make_node("Gather", [eye, "red"], [output], axis=1)
        for eye, output in zip(("left", "right", "left"), (value.name for value in maps), strict=True)
    ]
    graph = helper.make_graph(nodes, "by_rule", pictures, maps, [red])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    helper.set_model_props(model, {f"stereoweave.{key}": value for key, value in _PROPERTIES.items()})
    return model.SerializeToString()


def _read(path: Path) -> None:
    Matcher(path, threads=1).estimate(*eyes())


TARGET = Target(
    starts=_starts,
    read=_read,
    tokens=(
        *b"stereoweave.multiple_of stereoweave.max_disparity_px stereoweave.name disparity_px left".split(),
        *b"16 192 nan -1 999999999 Gather Loop Tile Resize ConstantOfShape \xff\xff\xff\xff\x0f".split(),
        *(b"\x08", b"\x12", b"\x1a", b"\x72"),
    ),
)
