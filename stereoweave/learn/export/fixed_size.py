"""Matcher files with a batch size of 1 and a fixed image size, as TensorRT and small devices require."""

import copy
from pathlib import Path
from typing import Any

import onnx
from onnxscript import optimizer

from stereoweave.errors import StereoweaveError
from stereoweave.io.files import make_folder, replacing
from stereoweave.io.images import SMALLEST_SIDE_PX
from stereoweave.learn.export.graph import write_card
from stereoweave.matching.matcher import Matcher

# Operators whose shapes or control flow depend on values; runtimes with fixed shapes cannot plan them.
SHAPES_BY_VALUE = ("If", "Loop", "NonZero", "Range", "Scan", "Shape", "Unique")


def fix_size(source: Path, out: Path, width: int, height: int) -> dict[str, Any]:
    """Write a matcher file for single pairs of the given size, and its card as .json. Returns the card.

    The new file computes the same values as the source. All shapes in its graph are constants, so it contains
    no operators that compute shapes.

    Args:
        source: Matcher file for pairs of any size, in float32, float16 or 8 bits.
        out: The .onnx file to write; it may be the source.
        width: Width in pixels.
        height: Height in pixels.

    Raises:
        StereoweaveError: The network does not accept the size, or the source already has a fixed size.
    """
    matcher = Matcher(source)
    if matcher.fixed_size:
        found = f"{matcher.fixed_size[1]}x{matcher.fixed_size[0]}"
        raise StereoweaveError(
            f"{source}: expected a matcher file for pairs of any size, found one for {found} only; "
            "use the file from which it was made"
        )
    check_size(width, height, matcher.multiple_of)
    make_folder(out.parent)
    graph = fix_graph_size(onnx.load(source), width, height)
    with replacing(out) as temporary:
        onnx.save(graph, temporary)
        Matcher(temporary)
    return write_card(source, out, {"size": [width, height]})


def check_size(width: int, height: int, multiple_of: int) -> None:
    """Raise StereoweaveError if the network does not accept the size."""
    if min(width, height) < SMALLEST_SIDE_PX or width % multiple_of or height % multiple_of:
        sides = (max(side, SMALLEST_SIDE_PX) for side in (width, height))
        suggested = "x".join(str(-(-side // multiple_of) * multiple_of) for side in sides)
        raise StereoweaveError(
            f"expected multiples of {multiple_of} that are at least {SMALLEST_SIDE_PX}, "
            f"found {width}x{height}; choose {suggested}; smaller pictures are padded to it",
            setting="size",
        )


def fix_graph_size(graph: onnx.ModelProto, width: int, height: int) -> onnx.ModelProto:
    """Return the graph for single pairs of the given size, with all shapes as constants."""
    graph = copy.deepcopy(graph)
    for value in (*graph.graph.input, *graph.graph.output):
        sides = value.type.tensor_type.shape.dim
        for side, length in zip(sides, (1, sides[1].dim_value, height, width), strict=True):
            side.dim_value = length
    del graph.graph.value_info[:]  # it describes shapes for any size
    made = optimizer.optimize(graph)
    onnx.checker.check_model(made, full_check=True)
    left = sorted({node.op_type for node in made.graph.node} & set(SHAPES_BY_VALUE))
    assert not left, f"operators with dynamic shapes remain: {left}"
    return made
