"""A checkpoint becomes a matcher file: calibrated, exported, and proved to answer as PyTorch does."""

import json
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from stereoweave.errors import StereoweaveError
from stereoweave.io import make_folder, replacing
from stereoweave.learn import calibrate, checkpoint
from stereoweave.learn.checkpoint import Checkpoint
from stereoweave.learn.models import MODELS
from stereoweave.learn.models.weave import WeaveNet
from stereoweave.matcher import Matcher
from stereoweave.stereo import StereoPair

OUTPUTS = ["disparity_px", "right_disparity_px", "confidence_logit"]
# The two runtimes may differ by rounding; more than this is another network.
LARGEST_DIFFERENCE_PX = 0.01
LARGEST_DIFFERENCE_OF_CONFIDENCE = 0.01


def export(trained: Path, out: Path, pairs: Iterable[StereoPair] = ()) -> dict[str, Any]:
    """Write the averaged network of a checkpoint as a matcher file, and its card as .json; returns the card.

    Args:
        trained: A checkpoint, or the folder of a run, whose last one is taken.
        out: The .onnx file.
        pairs: Pairs on which ONNX Runtime and PyTorch must agree, beside one of the project's own.

    Raises:
        StereoweaveError: If they differ by 0.01 px, or by 0.01 of confidence, or more; nothing is written
            then.
    """
    kept = checkpoint.load(trained / "last.pt" if trained.is_dir() else trained)
    network = MODELS[kept.recipe.model]()
    network.load_state_dict(kept.averaged)
    network.eval()
    reliability = calibrate.calibrate(network)
    make_folder(out.parent)
    with replacing(out) as temporary:
        onnx.save(graph_of(network, kept), temporary)
        matcher = Matcher(temporary)
        found = [differences(network, matcher, pair) for pair in [calibrate.unseen_pair(), *pairs]]
        px, of_confidence = np.max(found, axis=0).tolist()
        if not (px < LARGEST_DIFFERENCE_PX and of_confidence < LARGEST_DIFFERENCE_OF_CONFIDENCE):
            raise StereoweaveError(
                f"{trained}: ONNX Runtime and PyTorch differ by {px:.3f} px and {of_confidence:.3f} of "
                f"confidence, expected under {LARGEST_DIFFERENCE_PX} and {LARGEST_DIFFERENCE_OF_CONFIDENCE}; "
                "nothing was written"
            )
    agreement = {
        "onnx_differs_px": px,
        "onnx_differs_confidence": of_confidence,
        "compared_pairs": len(found),
    }
    card = _card(kept, network) | agreement | {"confidence": reliability}
    with replacing(out.with_suffix(".json")) as card_file:
        card_file.write_text(json.dumps(card, indent=2) + "\n", encoding="utf-8")
    return card


def graph_of(network: WeaveNet, kept: Checkpoint) -> onnx.ModelProto:
    """The network as an ONNX graph for any height and width that it can divide, with a matcher's metadata."""
    # Two tensors: given the same one twice, the exporter would take both inputs to be one.
    left, right = torch.rand(2, 1, 3, 4 * network.multiple_of, 8 * network.multiple_of)
    height, width = (network.multiple_of * torch.export.Dim(name, min=2, max=1024) for name in ("h", "w"))
    with warnings.catch_warnings():
        # The exporter warns of what it is not asked for: torchvision's operators, names of repeated axes.
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            network,
            (left, right),
            dynamo=True,
            opset_version=20,
            input_names=["left", "right"],
            output_names=OUTPUTS,
            dynamic_shapes=({2: height, 3: width}, {2: height, 3: width}),
            verbose=False,
        )
    assert program is not None
    program.optimize()
    graph = program.model_proto
    # The exporter notes where each part comes from, with this machine's paths.
    for part in (graph.graph, *graph.graph.node, *graph.graph.value_info):
        del part.metadata_props[:]
    for part in (*graph.graph.input, *graph.graph.output):
        del part.metadata_props[:]
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


def differences(network: WeaveNet, matcher: Matcher, pair: StereoPair) -> tuple[float, float]:
    """The largest differences of PyTorch and ONNX Runtime: of both disparities in px, and of confidence."""
    multiple = network.multiple_of
    height, width = (side // multiple * multiple for side in pair.left.shape[:2])
    left, right = pair.left[:height, :width], pair.right[:height, :width]
    tensors = [torch.from_numpy(x).permute(2, 0, 1)[None].float() / 255 for x in (left, right)]
    with torch.no_grad():
        expected = [x[0, 0] for x in network(*tensors)]
    # In one piece, because the strips of a large pair answer a little differently.
    found = [torch.from_numpy(x) for x in matcher._run(left, right)]
    left_px, right_px = (float((found[i] - expected[i]).abs().max()) for i in (0, 1))
    return max(left_px, right_px), float((found[2].sigmoid() - expected[2].sigmoid()).abs().max())


def multiply_adds(network: nn.Module, height: int = 480, width: int = 640) -> int:
    """Multiply-adds of the whole graph, both views and every comparison of features included."""
    image = torch.rand(1, 3, height, width)
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        network(image, image)
    # The counter sees convolutions and matrix products; the refinement compares 16 features of both views
    # at 6 columns a pixel by a plain product.
    return counter.get_total_flops() // 2 + 2 * (height // 2) * (width // 2) * 16 * 6


def _card(kept: Checkpoint, network: nn.Module) -> dict[str, Any]:
    return {
        "name": kept.recipe.name,
        "licence": "Apache-2.0",
        "recipe": vars(kept.recipe),
        "commit": kept.commit,
        "steps": kept.step,
        "origin": kept.origin,
        "hours": round(kept.hours, 2),
        "data": "collage pairs of the project's own making (docs/training-data.md)",
        "parameters": sum(parameter.numel() for parameter in network.parameters()),
        "multiply_adds_640x480": multiply_adds(network),
        "validation": kept.scores,
    }
