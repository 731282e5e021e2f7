"""Matcher files in float16, which are half as large and faster on processors with native float16."""

from collections.abc import Set
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from stereoweave.errors import StereoweaveError
from stereoweave.io.files import make_folder, replacing
from stereoweave.learn.data.collage import paint_collage
from stereoweave.learn.export.graph import add_nodes_between, read_graph, write_card
from stereoweave.matching.matcher import Matcher

LARGEST_MEAN_DIFFERENCE_PX = 0.02
# Different from the seeds of recipes, validation, confidence calibration and quantisation.
_PROOF_SEED, _PROOF_PAIRS = 6_000_011, 8
_SIZE = (320, 512)


def convert_to_float16(source: Path, out: Path) -> dict[str, Any]:
    """Write a WeaveNet's matcher file in float16, and its card as .json. Returns the card.

    Inputs, outputs and all disparities stay in float32.

    Args:
        source: Matcher file in float32 for pairs of any size.
        out: The .onnx file to write.

    Raises:
        StereoweaveError: The source is not such a file, or the disparities differ by 0.02 px or more on
            average. Nothing is written in either case.
    """
    graph = read_graph(source)
    make_folder(out.parent)
    with replacing(out) as temporary:
        onnx.save(cast_to_float16(graph, select_float16_nodes(graph)), temporary)
        mean_px = _mean_difference_px(Matcher(source), Matcher(temporary))
        if not mean_px < LARGEST_MEAN_DIFFERENCE_PX:
            raise StereoweaveError(
                f"{source}: expected float16 to change disparity by less than "
                f"{LARGEST_MEAN_DIFFERENCE_PX} px on average, found {mean_px:.3f} px; nothing was written"
            )
    return write_card(
        source, out, {"bits": 16, "differs_px_from_32_bits": mean_px, "compared_pairs": _PROOF_PAIRS}
    )


def select_float16_nodes(graph: onnx.ModelProto) -> set[str]:
    """Return the names of the nodes to compute in float16.

    They are the convolutions, the matrix products that correlate the views, and the nodes between them.
    Everything that reads or writes a disparity stays in float32, because at 256 px float16 has a resolution
    of only 1/4 px. The sum of matching scores from which the disparity is read also stays in float32. On
    painted pairs, converting all other nodes as well leaves the mean difference unchanged but increases the
    largest difference.
    """
    products = (node.name for node in graph.graph.node if node.op_type in ("Conv", "MatMul"))
    between = ("Concat", "Resize", "Relu", "Add", "Slice", "Pad", "Transpose")
    return add_nodes_between(graph, products, between)


def cast_to_float16(graph: onnx.ModelProto, names: Set[str]) -> onnx.ModelProto:
    """Convert the weights and values of the named nodes to float16, and insert casts around the nodes.

    ONNX Runtime's own converter rounds to float16 between any two float32 nodes, so it is not used.
    """
    cast = _Casts(graph, names)
    nodes = []
    for node in graph.graph.node:
        taken = onnx.NodeProto.FromString(node.SerializeToString())
        for place, value in enumerate(node.input):
            taken.input[place] = (
                cast.half(value) if _takes_float16(node, place, names) else cast.single(value)
            )
        nodes += [*cast.take(), taken]
    used = {value for node in nodes for value in node.input}
    weights = [x for x in [*graph.graph.initializer, *cast.weights] if x.name in used]
    inner = helper.make_graph(nodes, graph.graph.name, graph.graph.input, graph.graph.output, weights)
    made = helper.make_model(inner, opset_imports=graph.opset_import, ir_version=graph.ir_version)
    made.metadata_props.extend(graph.metadata_props)
    onnx.checker.check_model(made, full_check=True)
    return made


def _takes_float16(node: onnx.NodeProto, place: int, names: Set[str]) -> bool:
    """Return whether a node takes this input in float16. The scale of a Resize stays in float32."""
    return node.name in names and not (node.op_type == "Resize" and place > 0)


class _Casts:
    """Cast nodes and converted weights, each created only once."""

    def __init__(self, graph: onnx.ModelProto, names: Set[str]) -> None:
        inferred = onnx.shape_inference.infer_shapes(graph).graph
        values = (*inferred.value_info, *inferred.input, *inferred.output)
        self._floats = {x.name for x in values if x.type.tensor_type.elem_type == TensorProto.FLOAT}
        self._stored = {x.name: x for x in graph.graph.initializer if x.data_type == TensorProto.FLOAT}
        made = {value for node in graph.graph.node if node.name in names for value in node.output}
        self._halves = made & self._floats
        self._done: set[str] = set()
        self._nodes: list[onnx.NodeProto] = []
        self.weights: list[TensorProto] = []

    def half(self, value: str) -> str:
        """Return the name of the value's float16 version, or its own name if it needs no conversion."""
        if value in self._stored:
            return self._weight(value)
        if value in self._floats - self._halves:
            return self._cast(value, "half", TensorProto.FLOAT16)
        return value

    def single(self, value: str) -> str:
        """Return the name of the value's float32 version."""
        return self._cast(value, "single", TensorProto.FLOAT) if value in self._halves else value

    def take(self) -> list[onnx.NodeProto]:
        """Return the Cast nodes requested since the last call."""
        taken, self._nodes = self._nodes, []
        return taken

    def _weight(self, value: str) -> str:
        name = f"{value}.half"
        if name not in self._done:
            array = numpy_helper.to_array(self._stored[value]).astype(np.float16)
            self.weights.append(numpy_helper.from_array(array, name))
            self._done.add(name)
        return name

    def _cast(self, value: str, suffix: str, to: int) -> str:
        name = f"{value}.{suffix}"
        if name not in self._done:
            self._nodes.append(helper.make_node("Cast", [value], [name], name, to=to))
            self._done.add(name)
        return name


def _mean_difference_px(first: Matcher, second: Matcher) -> float:
    """Return the mean absolute difference between two matchers' disparities on held-out pairs."""
    pairs = (paint_collage(_PROOF_SEED, 0, index, *_SIZE) for index in range(_PROOF_PAIRS))
    differences_px = [
        np.abs(
            first.estimate(pair.left, pair.right).disparity_px
            - second.estimate(pair.left, pair.right).disparity_px
        ).mean()
        for pair in pairs
    ]
    return float(np.mean(differences_px))
