"""Functions shared by the exports of float16, 8-bit and fixed-size matcher files."""

import json
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import onnx
from onnx import TensorProto

from stereoweave.errors import StereoweaveError
from stereoweave.io.files import replacing
from stereoweave.matching.matcher import Matcher


def read_graph(source: Path) -> onnx.ModelProto:
    """Read the graph of a float32 matcher file for pairs of any size.

    Raises:
        StereoweaveError: The file is not a matcher file, or is already a variant.
    """
    fixed_size = Matcher(source).fixed_size
    graph = onnx.load(source)
    found = None
    if fixed_size:
        found = f"one for {fixed_size[1]}x{fixed_size[0]} only"
    elif any(node.op_type == "QuantizeLinear" for node in graph.graph.node):
        found = "one in 8 bits"
    elif any(value.data_type == TensorProto.FLOAT16 for value in graph.graph.initializer):
        found = "one in float16"
    if found:
        raise StereoweaveError(
            f"{source}: expected a matcher file in float32 for pairs of any size, found {found}; "
            "use the file from which it was made"
        )
    return graph


def write_card(source: Path, out: Path, facts: dict[str, Any]) -> dict[str, Any]:
    """Write a derived file's card, the source's card updated with `facts`. Returns the new card."""
    file = source.with_suffix(".json")
    card = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    card |= facts
    with replacing(out.with_suffix(".json")) as temporary:
        temporary.write_text(json.dumps(card, indent=2) + "\n", encoding="utf-8")
    return card


def add_nodes_between(graph: onnx.ModelProto, names: Iterable[str], operations: tuple[str, ...]) -> set[str]:
    """Return the names of the given nodes, the nodes between them, and the ReLUs after convolutions.

    A node with one of `operations` counts as between the given nodes if its outputs are read only by given
    nodes or by others between them. The returned ReLUs read the output of a returned convolution.
    """
    readers = defaultdict(list)
    for node in graph.graph.node:
        for value in node.input:
            readers[value].append(node)
    chosen = set(names)
    # In reverse order, so that the readers of a node are decided before the node itself.
    for node in reversed(graph.graph.node):
        following = {reader.name for value in node.output for reader in readers[value]}
        if node.op_type in operations and following and following <= chosen:
            chosen.add(node.name)
    relus = {
        reader.name
        for node in graph.graph.node
        if node.op_type == "Conv" and node.name in chosen
        for reader in readers[node.output[0]]
        if reader.op_type == "Relu"
    }
    return chosen | relus
