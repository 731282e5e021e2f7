"""A matcher file in numbers of 16 bits: half of the size, and faster where a processor computes in them."""

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
# Apart from the seeds of recipes, of validation, of the confidence and of 8 bits.
_PROOF_SEED, _PROOF_PAIRS = 6_000_011, 8
_SIZE = (320, 512)


def convert_to_float16(source: Path, out: Path) -> dict[str, Any]:
    """Write a WeaveNet's matcher file that computes in 16 bits, and its card as .json; returns the card.

    Its inputs and outputs keep 32 bits, and so do disparities on their way.

    Args:
        source: A matcher file in float32 for pairs of any size.
        out: The .onnx file to write.

    Raises:
        StereoweaveError: The source is no such file, or the two differ by 0.02 px or more in the mean;
            nothing is written then.
    """
    graph = read_graph(source)
    make_folder(out.parent)
    with replacing(out) as temporary:
        onnx.save(cast_to_float16(graph, select_float16_nodes(graph)), temporary)
        mean_px = _mean_difference_px(Matcher(source), Matcher(temporary))
        if not mean_px < LARGEST_MEAN_DIFFERENCE_PX:
            raise StereoweaveError(
                f"{source}: 16 bits change disparity by {mean_px:.3f} px in the mean, expected under "
                f"{LARGEST_MEAN_DIFFERENCE_PX}; nothing was written"
            )
    return write_card(
        source, out, {"bits": 16, "differs_px_from_32_bits": mean_px, "compared_pairs": _PROOF_PAIRS}
    )


def select_float16_nodes(graph: onnx.ModelProto) -> set[str]:
    """The names of the nodes that compute in 16 bits.

    They are the convolutions, the products that compare the views, and what stands between them alone. All
    that reads a disparity or gives one keeps 32: at 192 px the numbers of 16 bits are 1/8 px apart. So does
    the sum of matching scores that it is read from. Measured on painted pairs, with all else in 16 bits too
    the mean difference is the same and the largest one grows.
    """
    products = (node.name for node in graph.graph.node if node.op_type in ("Conv", "MatMul"))
    between = ("Concat", "Resize", "Relu", "Add", "Slice", "Pad", "Transpose")
    return add_nodes_between(graph, products, between)


def cast_to_float16(graph: onnx.ModelProto, names: Set[str]) -> onnx.ModelProto:
    """The graph with its weights and values in 16 bits at the named nodes, and casts to them and from them.

    ONNX Runtime's converter is not used: it rounds to 16 bits between any two nodes that keep 32.
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
    """Whether a node takes an input in 16 bits, if it is no whole number; how much it resizes by never is."""
    return node.name in names and not (node.op_type == "Resize" and place > 0)


class _Casts:
    """The nodes, and the weights, that turn values into 16 bits and back, each once."""

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
        """The name of the value in 16 bits; its own where it is no float or is in them already."""
        if value in self._stored:
            return self._weight(value)
        if value in self._floats - self._halves:
            return self._cast(value, "half", TensorProto.FLOAT16)
        return value

    def single(self, value: str) -> str:
        """The same in 32 bits."""
        return self._cast(value, "single", TensorProto.FLOAT) if value in self._halves else value

    def take(self) -> list[onnx.NodeProto]:
        """The casts that were asked for since the last time."""
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
    """Of two matchers' disparities, on fresh pairs."""
    pairs = (paint_collage(_PROOF_SEED, 0, index, *_SIZE) for index in range(_PROOF_PAIRS))
    differences_px = [
        np.abs(
            first.estimate(pair.left, pair.right).disparity_px
            - second.estimate(pair.left, pair.right).disparity_px
        ).mean()
        for pair in pairs
    ]
    return float(np.mean(differences_px))
