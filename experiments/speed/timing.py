"""Run times of the paper's network and its rivals, measured together and compared with DenseMapNet's."""

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime  # type: ignore[import-untyped]
import torch

from stereoweave.learn.export.from_checkpoint import DisparityNetwork, count_multiply_adds, export_fixed_graph
from stereoweave.learn.models import build_network
from stereoweave.learn.recipe import Recipe
from stereoweave.system.threads import thread_count

REFERENCE = "densemapnet"
NETWORKS = ("fast_depth", REFERENCE, "dispnet", "psmnet", "scvnet", "ganet_11")
# Networks that take seconds for a pair, and are timed a third as often.
_SLOW = "psmnet", "scvnet", "ganet_11"
# Without a graph: its recursions over rows and columns would be unrolled into 20,000 nodes.
_RECURSIVE = "ganet_11"
HEIGHT_PX, WIDTH_PX = 480, 640
DISPARITIES = 192.0
TURNS = 7


@dataclass(frozen=True, kw_only=True)
class SpeedRow:
    """Cost of a 640x480 pair for one network of the paper's comparison.

    Attributes:
        eager_ms, onnx_ms: Median time in PyTorch and in ONNX Runtime, in float32, on all cores. GA-Net, which
            is not exported, has no time in ONNX Runtime.
        eager_relative, onnx_relative: The same times as multiples of DenseMapNet's.
        multiply_adds: Of convolutions and matrix products; GA-Net's aggregations are neither.
    """

    network: str
    parameters: int
    multiply_adds: int
    eager_ms: float
    eager_relative: float
    onnx_ms: float | None
    onnx_relative: float | None


def measure_run_times(
    recipe: Recipe, networks: Sequence[str] = NETWORKS, turns: int = TURNS
) -> list[SpeedRow]:
    """Return a row per network. Networks take turns, so that slow phases affect all alike.

    Args:
        recipe: Recipe of the networks, except that the target becomes disparity up to 192 px.
        networks: Names in MODELS, including DenseMapNet's.
        turns: Number of repetitions; the slow networks are timed a third as often.
    """
    torch.set_num_threads(thread_count(None))
    pair = torch.rand(2, 1, 3, HEIGHT_PX, WIDTH_PX)
    recipe = replace(recipe, target="disparity", max_disparity_px=DISPARITIES, loss="l2")
    built = {
        name: DisparityNetwork(build_network(replace(recipe, model=name)).eval(), recipe) for name in networks
    }
    with tempfile.TemporaryDirectory() as folder:
        calls = {name: [_make_eager_call(network, pair)] for name, network in built.items()}
        for name, network in built.items():
            if name != _RECURSIVE:
                calls[name].append(_make_onnx_call(network, pair, Path(folder) / f"{name}.onnx"))
        times_ms = _measure_ms(calls, turns)
    return [_make_row(name, network, times_ms) for name, network in built.items()]


def _make_row(name: str, network: DisparityNetwork, times_ms: Mapping[str, Sequence[float]]) -> SpeedRow:
    eager_ms, *onnx = times_ms[name]
    onnx_ms = onnx[0] if onnx else None
    eager_reference_ms, onnx_reference_ms = times_ms[REFERENCE]
    return SpeedRow(
        network=name,
        parameters=sum(parameter.numel() for parameter in network.parameters()),
        multiply_adds=count_multiply_adds(network, HEIGHT_PX, WIDTH_PX),
        eager_ms=eager_ms,
        eager_relative=eager_ms / eager_reference_ms,
        onnx_ms=onnx_ms,
        onnx_relative=None if onnx_ms is None else onnx_ms / onnx_reference_ms,
    )


def _make_eager_call(network: DisparityNetwork, pair: torch.Tensor) -> Callable[[], object]:
    def call() -> object:
        with torch.inference_mode():
            return network(*pair)

    return call


def _make_onnx_call(network: DisparityNetwork, pair: torch.Tensor, file: Path) -> Callable[[], object]:
    onnx.save(export_fixed_graph(network, HEIGHT_PX, WIDTH_PX), file)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = thread_count(None)
    session = onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
    inputs = {"left": pair[0].numpy(), "right": pair[1].numpy()}
    return lambda: session.run(None, inputs)


def _measure_ms(calls: Mapping[str, Sequence[Callable[[], object]]], turns: int) -> dict[str, list[float]]:
    """Return the median time of each call in milliseconds, by network."""
    taken: dict[str, list[list[float]]] = {name: [[] for _ in both] for name, both in calls.items()}
    for turn in range(-1, turns):  # the first turn warms up
        for name, both in calls.items():
            if name in _SLOW and max(turn, 0) % 3:
                continue
            for times, call in zip(taken[name], both, strict=True):
                start_s = time.perf_counter()
                call()
                if turn >= 0:
                    times.append(1000 * (time.perf_counter() - start_s))
    return {name: [float(np.median(times)) for times in both] for name, both in taken.items()}
