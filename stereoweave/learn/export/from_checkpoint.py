"""Export of a checkpoint as a matcher file, with calibration, conversion and a check against PyTorch."""

import json
import logging
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from stereoweave.errors import StereoweaveError
from stereoweave.io.files import make_folder, replacing
from stereoweave.learn import checkpoint
from stereoweave.learn.checkpoint import Checkpoint
from stereoweave.learn.export import confidence as calibrate
from stereoweave.learn.models import CodeNetwork
from stereoweave.learn.models.ganet import GANet
from stereoweave.learn.models.mc_cnn import MCCNN
from stereoweave.learn.models.psmnet import PSMNet
from stereoweave.learn.models.weave import WeaveNet
from stereoweave.learn.recipe import Recipe
from stereoweave.learn.training.objective import CodeObjective
from stereoweave.matching.matcher import Matcher
from stereoweave.stereo import StereoPair

# WeaveNet has all of these outputs; each `CodeNetwork` has only the first.
OUTPUTS = ["disparity_px", "right_disparity_px", "confidence_logit"]
# Rounding makes PyTorch and ONNX Runtime differ, but by less than these limits.
LARGEST_DIFFERENCE_PX = 0.01
LARGEST_DIFFERENCE_OF_CONFIDENCE = 0.01
# Networks whose graph is for one size, and what depends on it.
_SIZED = {PSMNet: "pooling windows", GANet: "recursions over rows and columns"}


def export_matcher(trained: Path, out: Path, pairs: Iterable[StereoPair] = ()) -> dict[str, Any]:
    """Write a checkpoint's averaged network as a matcher file, and its card as .json. Returns the card.

    Args:
        trained: Checkpoint, or the run folder whose last checkpoint is exported.
        out: The .onnx file to write.
        pairs: Pairs on which ONNX Runtime and PyTorch must agree, in addition to one collage.

    Raises:
        StereoweaveError: ONNX Runtime and PyTorch differ by at least 0.01 px, or by at least 0.01 in
            confidence. Nothing is written.
    """
    kept = checkpoint.load(trained / "last.pt" if trained.is_dir() else trained)
    network = load_matcher_network(kept)
    reliability = (
        {"confidence": calibrate.calibrate_confidence(network)} if isinstance(network, WeaveNet) else {}
    )
    make_folder(out.parent)
    with replacing(out) as temporary:
        onnx.save(export_graph(network, kept), temporary)
        matcher = Matcher(temporary)
        found = [compare_runtimes(network, matcher, pair) for pair in [calibrate.paint_unseen_pair(), *pairs]]
        px, of_confidence = np.max(found, axis=0).tolist()
        if not (px < LARGEST_DIFFERENCE_PX and of_confidence < LARGEST_DIFFERENCE_OF_CONFIDENCE):
            raise StereoweaveError(
                f"{trained}: expected ONNX Runtime and PyTorch to differ by less than "
                f"{LARGEST_DIFFERENCE_PX} px and less than {LARGEST_DIFFERENCE_OF_CONFIDENCE} in confidence, "
                f"found {px:.3f} px and {of_confidence:.3f}; nothing was written"
            )
    agreement = {
        "onnx_differs_px": px,
        "onnx_differs_confidence": of_confidence,
        "compared_pairs": len(found),
    }
    card = _make_card(kept, network) | agreement | reliability
    with replacing(out.with_suffix(".json")) as card_file:
        card_file.write_text(json.dumps(card, indent=2) + "\n", encoding="utf-8")
    return card


class DisparityNetwork(nn.Module):
    """Wrapper of a `CodeNetwork` that outputs the left view's disparity in pixels [B, 1, H, W]."""

    def __init__(self, network: Any, recipe: Recipe) -> None:
        super().__init__()
        self.network, self.objective = network, CodeObjective(recipe, network)
        self.multiple_of = network.multiple_of
        self.max_disparity_px = int(recipe.max_disparity_px)

    def forward(self, left: torch.Tensor, right: torch.Tensor) -> tuple[torch.Tensor]:
        return (self.objective.disparity_px(self.network(left, right), {}),)


def load_matcher_network(kept: Checkpoint) -> Any:
    """Load a checkpoint's averaged network for matching.

    Raises:
        StereoweaveError: The network estimates depth, or is a PSMNet, a GANet or an MC-CNN.
    """
    network = kept.build_averaged()
    if isinstance(network, MCCNN):
        raise StereoweaveError(
            f"{kept.recipe.name}: expected a network that estimates disparities, found mc_cnn, which "
            "compares patches; score it with `stereoweave bench networks`"
        )
    if not isinstance(network, CodeNetwork):
        return network
    if kept.recipe.target != "disparity":
        raise StereoweaveError(
            f"{kept.recipe.name}: expected target = 'disparity', found {kept.recipe.target!r}; "
            "a matcher file has no camera with which to convert depth to disparity"
        )
    for kind, parts in _SIZED.items():
        if isinstance(network, kind):
            raise StereoweaveError(
                f"{kept.recipe.name}: expected a network for pairs of any size, found {kept.recipe.model}, "
                f"whose {parts} depend on the size; score it with `stereoweave bench networks`"
            )
    return DisparityNetwork(network, kept.recipe)


def export_graph(network: Any, kept: Checkpoint) -> onnx.ModelProto:
    """Export the network as an ONNX graph with a matcher's metadata, for any batch, height and width.

    Height and width must be multiples of `network.multiple_of`. The dynamic batch size increases the run time
    by less than 1 %, which is within measurement noise.
    """
    height, width = (network.multiple_of * torch.export.Dim(name, min=2, max=1024) for name in ("h", "w"))
    sides = {0: torch.export.Dim("batch"), 2: height, 3: width}
    graph = _export_clean_graph(network, 4 * network.multiple_of, 8 * network.multiple_of, (sides, sides))
    first, *_ = graph.graph.input[0].type.tensor_type.shape.dim
    # The exporter does not report whether a network's code fixes a dynamic dimension.
    assert first.dim_param, "the network's code fixes the batch size"
    properties = {
        "name": kept.recipe.name,
        "multiple_of": network.multiple_of,
        "max_disparity_px": network.max_disparity_px,
        "recipe": json.dumps(vars(kept.recipe)),
        "commit": kept.commit,
    }
    onnx.helper.set_model_props(
        graph, {f"stereoweave.{key}": str(value) for key, value in properties.items()}
    )
    return graph


def export_fixed_graph(network: Any, height: int, width: int) -> onnx.ModelProto:
    """Export the network as an ONNX graph for pairs of the given size."""
    return _export_clean_graph(network, height, width, None)


def export_annotated_graph(network: Any, height: int, width: int, dynamic_shapes: Any) -> onnx.ModelProto:
    """Export the network as an ONNX graph, with the exporter's notes on the origin of each node."""
    # Two tensors, because the exporter merges inputs that are the same tensor. Two pairs if the batch size is
    # dynamic, because the exporter would fix an axis of length 1.
    left, right = torch.rand(2, 1 if dynamic_shapes is None else 2, 3, height, width)
    with _mute_exporter(), torch.no_grad():
        program = torch.onnx.export(
            network,
            (left, right),
            dynamo=True,
            opset_version=20,
            input_names=["left", "right"],
            output_names=OUTPUTS[:1] if isinstance(network, DisparityNetwork) else OUTPUTS,
            dynamic_shapes=dynamic_shapes,
            verbose=False,
        )
    assert program is not None
    program.optimize()
    return program.model_proto


def _export_clean_graph(network: Any, height: int, width: int, dynamic_shapes: Any) -> onnx.ModelProto:
    graph = export_annotated_graph(network, height, width, dynamic_shapes)
    # The exporter's notes contain this machine's paths.
    for part in (graph.graph, *graph.graph.node, *graph.graph.value_info):
        del part.metadata_props[:]
    for part in (*graph.graph.input, *graph.graph.output):
        del part.metadata_props[:]
    return graph


@contextmanager
def _mute_exporter() -> Iterator[None]:
    """Suppress the exporter's warnings about torchvision's operators and about repeated axis names."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        logger.setLevel(level)


def compare_runtimes(network: Any, matcher: Matcher, pair: StereoPair) -> tuple[float, float]:
    """Return the largest differences between PyTorch and ONNX Runtime, in disparity (px) and confidence."""
    multiple = network.multiple_of
    height, width = (side // multiple * multiple for side in pair.left.shape[:2])
    left, right = pair.left[:height, :width], pair.right[:height, :width]
    tensors = [torch.from_numpy(x).permute(2, 0, 1)[None].float() / 255 for x in (left, right)]
    with torch.no_grad():
        expected = [x[0, 0] for x in network(*tensors)]
    # Run in one piece, because `estimate` would match large pairs in strips, with slightly different results.
    found = [torch.from_numpy(x) for x in matcher._run(left, right) if x is not None]
    largest_px = max(float((found[i] - x).abs().max()) for i, x in enumerate(expected[:2]))
    if len(expected) < len(OUTPUTS):
        return largest_px, 0.0
    return largest_px, float((found[2].sigmoid() - expected[2].sigmoid()).abs().max())


def count_multiply_adds(network: nn.Module, height: int = 480, width: int = 640) -> int:
    """Count the multiply-adds of the whole graph, including all correlations."""
    image = torch.rand(1, 3, height, width)
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        network(image, image)
    counted = counter.get_total_flops() // 2
    if isinstance(network, WeaveNet):
        # The last refinement is at 1/2 resolution, of the left view alone; those before it are of both views.
        for number, refinement in enumerate(reversed(network.refinements), 1):
            views = 1 if number == 1 else 2
            counted += views * refinement.products * height * width // 4**number
    return counted


def _make_card(kept: Checkpoint, network: nn.Module) -> dict[str, Any]:
    return {
        "name": kept.recipe.name,
        "licence": "Apache-2.0",
        "recipe": vars(kept.recipe),
        "commit": kept.commit,
        "steps": kept.step,
        "origin": kept.origin,
        "hours": round(kept.hours, 2),
        "data": "collages and rendered pairs of the project's own making (docs/training-data.md)",
        "parameters": sum(parameter.numel() for parameter in network.parameters()),
        "multiply_adds_640x480": count_multiply_adds(network),
        "validation": kept.scores,
    }
