"""Matcher files with 8-bit convolutions: a third the size, and faster on CPUs with 8-bit dot products."""

import io
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
from onnxruntime.quantization import (  # type: ignore[import-untyped]
    CalibrationDataReader,
    CalibrationMethod,
    QuantType,
    quant_pre_process,
    quantize_static,
)

from stereoweave.errors import StereoweaveError
from stereoweave.io.files import make_folder, replacing
from stereoweave.learn.data.collage import paint_collage
from stereoweave.learn.export.graph import add_nodes_between, read_graph, write_card
from stereoweave.matching.matcher import Matcher
from stereoweave.stereo import Sample

LARGEST_LOSS_PX = 0.05
# Different from the seeds of recipes, validation and confidence.
_RANGES_SEED, _PROOF_SEED = 4_000_037, 5_000_011
_RANGES_PAIRS, _PROOF_PAIRS = 6, 24
_SIZE = (320, 512)
# Percentiles of a map's values that the quantisation range covers, tried in turn. Outliers are clipped to
# keep steps small; some networks lose too much by that.
_RANGE_PERCENTILES = (99.99, 99.999)
# The refinements' layers stay in float32, because they resolve fractions of a pixel. In 8 bits they would
# double the loss of accuracy.
_KEPT = ("refinement.", "enlargement.")


def quantise(source: Path, out: Path) -> dict[str, Any]:
    """Write a WeaveNet's matcher file with 8-bit convolutions, and its card as .json. Returns the card.

    Activations use 8 bits. Weights have one scale per channel and use 7 of their 8 bits, because with all 8
    bits, sums of two products would overflow on CPUs that have AVX2 but no 8-bit dot products (ONNX Runtime,
    "Quantize ONNX Models"). The ranges of activations leave out their outliers; where that costs too much,
    they leave out fewer.

    Args:
        source: Matcher file in float32 for pairs of any size.
        out: The .onnx file to write.

    Raises:
        StereoweaveError: The source is not such a file, or the mean error grows by 0.05 px or more on pairs
            from which no range was taken. Nothing is written in either case.
    """
    graph = read_graph(source)
    make_folder(out.parent)
    with replacing(out) as temporary:
        before_px = _mean_error_px(Matcher(source))
        for percentile in _RANGE_PERCENTILES:
            _write(graph, temporary, percentile)
            after_px = _mean_error_px(Matcher(temporary))
            if after_px - before_px < LARGEST_LOSS_PX:
                break
        else:
            raise StereoweaveError(
                f"{source}: expected 8 bits to increase the mean error by less than {LARGEST_LOSS_PX} px, "
                f"found {after_px - before_px:.3f} px; nothing was written"
            )
    return write_card(
        source,
        out,
        {
            "bits": 8,
            "range_percentile": percentile,
            "epe_px_of_32_bits": before_px,
            "epe_px": after_px,
            "compared_pairs": _PROOF_PAIRS,
        },
    )


def select_int8_nodes(graph: onnx.ModelProto) -> list[str]:
    """Return the names of the nodes to compute in 8 bits.

    They are all convolutions except those of the refinements, the nodes between these convolutions,
    and the ReLUs after them. Disparities, correlations and their inputs stay in float32, because 8 bits would
    round a disparity to whole pixels.
    """
    convolutions = (
        node.name
        for node in graph.graph.node
        if node.op_type == "Conv" and not node.input[1].startswith(_KEPT)
    )
    chosen = add_nodes_between(graph, convolutions, ("Concat", "Resize", "Relu", "Add"))
    return [node.name for node in graph.graph.node if node.name in chosen]


class _CalibrationPairs(CalibrationDataReader):  # type: ignore[misc]
    """Pairs in the format that ONNX Runtime's calibration reads."""

    def __init__(self, pairs: Iterable[Sample]) -> None:
        self._pairs = iter(pairs)

    def get_next(self) -> dict[str, np.ndarray] | None:
        pair = next(self._pairs, None)
        if pair is None:
            return None
        return {
            "left": cv2.dnn.blobFromImage(pair.left, 1 / 255),
            "right": cv2.dnn.blobFromImage(pair.right, 1 / 255),
        }


def _write(graph: onnx.ModelProto, out: Path, percentile: float) -> None:
    nodes = select_int8_nodes(graph)
    # Redirected to suppress ONNX Runtime's progress messages.
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(io.StringIO()):
        with_shapes = Path(folder, "with_shapes.onnx")
        quant_pre_process(graph, with_shapes, skip_optimization=True, skip_symbolic_shape=True)
        quantize_static(
            with_shapes,
            out,
            _CalibrationPairs(_paint_pairs(_RANGES_SEED, _RANGES_PAIRS)),
            op_types_to_quantize=["Conv", "Concat", "Resize", "Relu", "Add"],
            nodes_to_quantize=nodes,
            per_channel=True,
            reduce_range=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            calibrate_method=CalibrationMethod.Percentile,
            extra_options={"CalibPercentile": percentile},
        )


def _paint_pairs(seed: int, count: int) -> Iterator[Sample]:
    return (paint_collage(seed, 0, index, *_SIZE) for index in range(count))


def _mean_error_px(matcher: Matcher) -> float:
    """Return the mean disparity error on held-out pairs, over pixels visible in both views."""
    errors_px = [
        np.abs(matcher.estimate(pair.left, pair.right).disparity_px - pair.disparity_px)[
            ~pair.occluded
        ].mean()
        for pair in _paint_pairs(_PROOF_SEED, _PROOF_PAIRS)
    ]
    return float(np.mean(errors_px))
