"""Accuracy and speed of the shipped networks in every variant and runtime, compared with PyTorch."""

import contextlib
import math
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnx
import onnxruntime  # type: ignore[import-untyped]
import torch
from jaxtyping import Float32
from onnx import numpy_helper

from stereoweave.errors import MatcherError
from stereoweave.learn import checkpoint
from stereoweave.learn.checkpoint import find_commit
from stereoweave.learn.data.collage import paint_collage
from stereoweave.learn.export.fixed_size import fix_size
from stereoweave.learn.export.float16 import convert_to_float16
from stereoweave.learn.export.from_checkpoint import load_matcher_network
from stereoweave.learn.export.int8 import quantise
from stereoweave.learn.models.weave import WeaveNet
from stereoweave.matching.matcher import model_file
from stereoweave.matching.providers import CPU, PROVIDERS, open_session
from stereoweave.system.threads import thread_count

# Different from the seeds of recipes, validation, confidence and the variants' own checks.
_SEED, _PAIRS = 7_000_003, 4
# Height and width of the pairs. Times are measured at the last size, which is that of the fixed-size file.
SIZES = ((256, 320), (320, 512), (480, 640))
_TURNS = 21


@dataclass(frozen=True, kw_only=True)
class ParityRow:
    """Differences between one variant and PyTorch in float32, over all pixels of painted pairs.

    Attributes:
        network: Name of the shipped network.
        variant: Name of the variant.
        provider: Execution provider, a name in PROVIDERS.
        onnxruntime: Version of ONNX Runtime.
        file_mb: Size of the file in 10^6 bytes.
        pairs: Number of pairs compared.
        left_mean_px, left_max_px: Mean and largest absolute difference in the left view's disparity.
        right_mean_px, right_max_px: Mean and largest absolute difference in the right view's disparity.
        confidence_mean, confidence_max: Mean and largest absolute difference in confidence, a probability.
        time_ms: Shortest time for a 640x480 pair over several runs.
        time_relative: Time divided by that of float32 on the same provider, measured in alternating runs.
        commit: Commit of the code.
    """

    network: str
    variant: str
    provider: str
    onnxruntime: str
    file_mb: float
    pairs: int
    left_mean_px: float
    left_max_px: float
    right_mean_px: float
    right_max_px: float
    confidence_mean: float
    confidence_max: float
    time_ms: float
    time_relative: float
    commit: str


class MatcherVariant(NamedTuple):
    """A matcher file, the batch size at which it is run, and the entries of SIZES that it accepts."""

    file: Path
    batch: int
    sizes: Sequence[tuple[int, int]]


class NetworkMaps(NamedTuple):
    """A network's outputs: the disparities of both views, and the left view's confidence in 0..1."""

    left_px: Float32[np.ndarray, "b 1 h w"]
    right_px: Float32[np.ndarray, "b 1 h w"]
    confidence: Float32[np.ndarray, "b 1 h w"]


def measure_parity(checkpoints: Sequence[Path]) -> list[ParityRow]:
    """Compare every variant of every network on every provider of the installed ONNX Runtime.

    Args:
        checkpoints: Checkpoints of the shipped networks.
    """
    with tempfile.TemporaryDirectory() as folder:
        return [row for path in checkpoints for row in _measure_network(path, Path(folder))]


def format_markdown(rows: Sequence[ParityRow]) -> str:
    """Format the rows as a Markdown table."""
    what = ["network", "variant", "provider"]
    numbers = ["file, MB", "left, px", "right, px", "confidence", "time / float32"]
    lines = [what + numbers, ["---"] * 3 + ["---:"] * 5]
    lines += [
        [
            row.network,
            row.variant,
            f"{row.provider}, {row.onnxruntime}",
            f"{row.file_mb:.2f}",
            f"{row.left_mean_px:.5f} / {row.left_max_px:.3f}",
            f"{row.right_mean_px:.5f} / {row.right_max_px:.3f}",
            f"{row.confidence_mean:.5f} / {row.confidence_max:.3f}",
            f"{row.time_relative:.2f}",
        ]
        for row in rows
    ]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _measure_network(path: Path, folder: Path) -> list[ParityRow]:
    kept = checkpoint.load(path)
    file = model_file(kept.recipe.name)
    network = apply_shipped_calibration(load_matcher_network(kept), file)
    made = make_variants(file, folder)
    inputs = {size: paint_pairs(size, _PAIRS) for size in SIZES}
    expected = {size: run_in_pytorch(network, views) for size, views in inputs.items()}
    rows = []
    for provider in list_providers():
        sessions = _open_sessions(made, provider)
        times_ms = _measure_times_ms(sessions, made, inputs[SIZES[-1]])
        for name, session in sessions.items():
            variant = made[name]
            found = {
                size: run_in_onnx_runtime(session, variant.batch, inputs[size]) for size in variant.sizes
            }
            rows.append(
                ParityRow(
                    network=kept.recipe.name,
                    variant=name,
                    provider=provider,
                    onnxruntime=onnxruntime.__version__,
                    file_mb=variant.file.stat().st_size / 1e6,
                    pairs=_PAIRS * len(found),
                    **summarise_differences(expected, found),
                    time_ms=times_ms[name],
                    time_relative=times_ms[name] / times_ms.get("float32", math.nan),
                    commit=find_commit(),
                )
            )
    return rows


def make_variants(file: Path, folder: Path) -> dict[str, MatcherVariant]:
    """Return every variant of a shipped matcher file, keyed by name; new files are written to `folder`."""
    height, width = SIZES[-1]
    half, eight_bits, fixed = (folder / f"{file.stem}_{x}.onnx" for x in ("fp16", "8bit", "fixed"))
    convert_to_float16(file, half)
    quantise(file, eight_bits)
    fix_size(file, fixed, width, height)
    return {
        "float32": MatcherVariant(file, 1, SIZES),
        "batch of 4": MatcherVariant(file, 4, SIZES),
        f"static {width}x{height}": MatcherVariant(fixed, 1, SIZES[-1:]),
        "fp16": MatcherVariant(half, 1, SIZES),
        "8-bit": MatcherVariant(eight_bits, 1, SIZES),
    }


def apply_shipped_calibration(network: WeaveNet, file: Path) -> WeaveNet:
    """Copy the calibrated confidence layers of a shipped matcher file into its network."""
    weights = {x.name: x for x in onnx.load(file).graph.initializer}
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            if ".confidence." in name:
                stored = numpy_helper.to_array(weights[name])
                parameter.copy_(torch.from_numpy(stored.copy()))
    return network


def paint_pairs(size: tuple[int, int], count: int) -> dict[str, Float32[np.ndarray, "b 3 h w"]]:
    """Paint held-out pairs as a network's inputs: a batch of left views and a batch of right views."""
    made = [paint_collage(_SEED, size[1], index, *size) for index in range(count)]
    return {
        side: np.stack([getattr(x, side).transpose(2, 0, 1) for x in made]).astype(np.float32) / 255
        for side in ("left", "right")
    }


def run_in_pytorch(network: Any, views: Mapping[str, np.ndarray]) -> NetworkMaps:
    """Run the network in float32, one pair at a time."""
    each = []
    with torch.inference_mode():
        for i in range(len(views["left"])):
            left_px, right_px, logit = network(*(torch.from_numpy(x[i : i + 1]) for x in views.values()))
            each.append(NetworkMaps(left_px.numpy(), right_px.numpy(), logit.sigmoid().numpy()))
    return NetworkMaps(*map(np.concatenate, zip(*each, strict=True)))


def run_in_onnx_runtime(session: Any, batch: int, views: Mapping[str, np.ndarray]) -> NetworkMaps:
    """Run a matcher file on the pairs, `batch` pairs at a time."""
    each = []
    for i in range(0, len(views["left"]), batch):
        taken = {side: x[i : i + batch] for side, x in views.items()}
        left_px, right_px, logit = session.run(None, taken)
        each.append(NetworkMaps(left_px, right_px, (1 + np.tanh(logit / 2)) / 2))
    return NetworkMaps(*map(np.concatenate, zip(*each, strict=True)))


def summarise_differences(
    expected: Mapping[tuple[int, int], NetworkMaps], found: Mapping[tuple[int, int], NetworkMaps]
) -> dict[str, float]:
    """Return the mean and largest absolute differences over all pixels, keyed by `ParityRow` field."""
    summary = {}
    for field, unit in (("left", "_px"), ("right", "_px"), ("confidence", "")):
        name = field + unit
        apart = [np.abs(getattr(found[x], name) - getattr(expected[x], name)).ravel() for x in found]
        summary[f"{field}_mean{unit}"] = float(np.concatenate(apart).mean())
        summary[f"{field}_max{unit}"] = float(np.concatenate(apart).max())
    return summary


def list_providers() -> list[str]:
    """Return the providers of the installed ONNX Runtime."""
    there = onnxruntime.get_available_providers()
    return [name for name, provider in PROVIDERS.items() if provider.name in there]


def _open_sessions(made: Mapping[str, MatcherVariant], provider: str) -> dict[str, Any]:
    """Open a session for each variant. Variants that the provider rejects are skipped, except on the CPU."""
    sessions = {}
    for name, variant in made.items():
        with contextlib.nullcontext() if provider == CPU else contextlib.suppress(MatcherError):
            sessions[name] = open_session(variant.file, provider, thread_count(None))
    return sessions


def _measure_times_ms(
    sessions: Mapping[str, Any], made: Mapping[str, MatcherVariant], views: Mapping[str, np.ndarray]
) -> dict[str, float]:
    """Return each variant's shortest time per pair.

    The variants run in alternation, so slow phases of the machine affect all of them alike.
    """
    times_ms: dict[str, list[float]] = {name: [] for name in sessions}
    for turn in range(-1, _TURNS):  # turn -1 is a warm-up
        for name, session in sessions.items():
            batch = {side: x[: made[name].batch] for side, x in views.items()}
            start_s = time.perf_counter()
            session.run(None, batch)
            if turn >= 0:
                times_ms[name].append(1000 * (time.perf_counter() - start_s) / len(batch["left"]))
    return {name: min(times) for name, times in times_ms.items()}
