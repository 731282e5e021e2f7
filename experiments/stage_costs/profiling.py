"""Costs of WeaveNet's stages under ONNX Runtime: multiply-adds, bytes moved and time on the CPU."""

import ast
import json
import tempfile
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime  # type: ignore[import-untyped]
from onnx import TensorProto, helper

from experiments.ablations.networks import register_variants
from stereoweave.errors import StereoweaveError
from stereoweave.learn import checkpoint
from stereoweave.learn.export.from_checkpoint import export_annotated_graph, load_matcher_network
from stereoweave.learn.models.weave import WeaveNet

HEIGHT_PX, WIDTH_PX = 480, 640
PRODUCT_SIDE = 2048
TURNS = 15
PRODUCT = f"product of two {PRODUCT_SIDE}x{PRODUCT_SIDE} matrices"
TOTAL = "total"

# Stages by module, where the two names differ.
_STAGES = {
    "to_match": "correlation",
    "weights": "upsampling",
    "to_match_half": "local matching",
    "to_half": "refinement",
    "stem": "encoder",
    "to_match_stem": "local matching",
    "enlargement": "refinement",
}
# Stages of operations between the parts of a module, by that module ("" for the network itself) and by the
# part of the network that ran last.
_STAGES_BETWEEN = {
    ("", ""): "encoder",
    ("", "encoder"): "mirroring",
    ("", "aggregation"): "disparity from scores",
    ("", "completion"): "completion",
    ("", "propagation"): "upsampling",
    ("", "stem"): "upsampling",
    ("", "refinement"): "upsampling",
    ("", "enlargement"): "upsampling",
    ("refinement", "to_half"): "local matching",
    ("enlargement", "to_match_stem"): "local matching",
}
# Kernels that only change shapes, and move no data.
_VIEWS = {"Reshape", "Squeeze", "Unsqueeze", "Flatten", "Identity"}


@dataclass(frozen=True, kw_only=True)
class StageCost:
    """Cost of one stage for both views of a 640x480 pair, in float32.

    Attributes:
        network: Name of the recipe; "" for PRODUCT.
        stage: Name of the stage; TOTAL for all stages; PRODUCT for the matrix product that measures the peak.
        multiply_adds: Multiply-adds of convolutions, matrix products and sums of products.
        moved_mb: 10^6 bytes that kernels read and write, weights included; much of it stays in caches.
        one_thread_ms, two_threads_ms: Minimum time over the turns, because other work can only add time.
        one_thread_peak_percent, two_threads_peak_percent: Multiply-adds per second, in percent of PRODUCT's.
    """

    network: str
    stage: str
    multiply_adds: int
    moved_mb: float
    one_thread_ms: float
    two_threads_ms: float
    one_thread_peak_percent: float
    two_threads_peak_percent: float


@dataclass(frozen=True)
class StageMeasurement:
    """A stage's multiply-adds, bytes moved, and milliseconds with one and with two threads."""

    multiply_adds: int
    moved: int
    times_ms: tuple[float, float]


@dataclass(frozen=True)
class Profile:
    """Profile of a graph under ONNX Runtime.

    Attributes:
        optimised: ONNX Runtime's optimised graph, with the kernels as its nodes.
        moved: Bytes moved by each kernel.
        kernels_ms: Milliseconds of each kernel in every turn.
        total_ms: Milliseconds of every turn.
    """

    optimised: onnx.ModelProto
    moved: dict[str, int]
    kernels_ms: dict[str, list[float]]
    total_ms: list[float]


def measure_stage_costs(runs: Sequence[Path], turns: int = TURNS) -> list[StageCost]:
    """Measure a large matrix product, then each network's stages in the order of execution and their total.

    Args:
        runs: Checkpoints of WeaveNets or of their ablations, or run folders, whose last checkpoints are used.
        turns: Number of repetitions of each measurement.

    Raises:
        StereoweaveError: If a network is not a WeaveNet.
    """
    register_variants()
    networks = [_load_weave_net(run) for run in runs]
    peak = measure(_make_matrix_product(PRODUCT_SIDE), {}, turns)[TOTAL]
    rows = [_make_row("", PRODUCT, peak, peak)]
    for name, network in networks:
        graph = trace(network)
        found = measure(graph, find_stages(graph), turns)
        rows += [_make_row(name, stage, cost, peak) for stage, cost in found.items()]
    return rows


def format_table(rows: Sequence[StageCost]) -> str:
    """Return the rows as a Markdown table."""
    lines = [
        "| network | stage | million multiply-adds | MB moved | ms, one thread | of the peak "
        "| ms, two threads | of the peak |",
        "|---|---|---:|---:|---:|---:|---:|---:|",
    ]
    lines += [
        f"| {row.network} | {row.stage} | {row.multiply_adds / 1e6:.1f} | {row.moved_mb:.1f} "
        f"| {row.one_thread_ms:.2f} | {row.one_thread_peak_percent:.0f} % "
        f"| {row.two_threads_ms:.2f} | {row.two_threads_peak_percent:.0f} % |"
        for row in rows
    ]
    return "\n".join(lines)


def trace(network: WeaveNet) -> onnx.ModelProto:
    """Return the network's graph as `export_fixed_graph` makes it, annotated with the module of each node."""
    return export_annotated_graph(network, HEIGHT_PX, WIDTH_PX, None)


def find_stages(graph: onnx.ModelProto) -> dict[str, str]:
    """Return the stage of each node and of each node's outputs, by name, in the order of execution."""
    stages: dict[str, str] = {}
    last = ""
    for node in graph.graph.node:
        notes = {note.key: note.value for note in node.metadata_props}
        # A note lists the network, the nested modules and the operation.
        modules = ast.literal_eval(notes.get("pkg.torch.onnx.name_scopes", "['', '']"))[1:-1]
        inside = ".".join(modules[-1:])
        if inside in ("", "refinement", "enlargement"):
            part = inside or last
            stage = _STAGES_BETWEEN.get((inside, last), _STAGES.get(part, part))
        else:
            last = modules[0]
            stage = _STAGES.get(last, last)
        stages |= dict.fromkeys((node.name, *node.output), stage)
    return stages


# Operations that only add up what they read.
_SUMS = {"ReduceSum", "Add"}


def count_multiply_adds(graph: onnx.ModelProto) -> Counter[str]:
    """Return multiply-adds by node: convolutions, matrix products, and products that are only summed."""
    inferred = onnx.shape_inference.infer_shapes(graph).graph
    shapes = {tensor.name: list(tensor.dims) for tensor in inferred.initializer}
    for value in (*inferred.input, *inferred.value_info, *inferred.output):
        shapes[value.name] = [side.dim_value for side in value.type.tensor_type.shape.dim]
    readers = defaultdict(set)
    for node in inferred.node:
        for value in node.input:
            readers[value].add(node.op_type)
    counts: Counter[str] = Counter()
    for node in inferred.node:
        given = prod(shapes[node.output[0]])
        if node.op_type == "Conv":
            counts[node.name] = given * prod(shapes[node.input[1]][1:])
        elif node.op_type == "MatMul":
            counts[node.name] = given * shapes[node.input[0]][-1]
        elif node.op_type == "Mul" and readers[node.output[0]] and readers[node.output[0]] <= _SUMS:
            counts[node.name] = given
    return counts


def measure(graph: onnx.ModelProto, stages: Mapping[str, str], turns: int) -> dict[str, StageMeasurement]:
    """Measure each stage and TOTAL under ONNX Runtime, with one and with two threads.

    Args:
        graph: Graph with inputs of one fixed size.
        stages: Result of `find_stages`; if empty, only TOTAL is measured.
        turns: Number of timed repetitions, after one to warm up.
    """
    profiles = [profile(graph, threads, turns) for threads in (1, 2)]
    of_kernels = [_assign_kernels(each.optimised, stages) for each in profiles]
    counts = count_multiply_adds(graph)
    found = {
        stage: StageMeasurement(
            sum(count for node, count in counts.items() if stages[node] == stage),
            sum(size for kernel, size in profiles[0].moved.items() if of_kernels[0][kernel] == stage),
            (
                _min_ms(profiles[0], of_kernels[0], stage),
                _min_ms(profiles[1], of_kernels[1], stage),
            ),
        )
        for stage in dict.fromkeys(stages.values())
    }
    found[TOTAL] = StageMeasurement(
        counts.total(),
        sum(profiles[0].moved.values()),
        (min(profiles[0].total_ms), min(profiles[1].total_ms)),
    )
    return found


def profile(graph: onnx.ModelProto, threads: int, turns: int) -> Profile:
    """Profile a graph on random float32 inputs, `turns` times after one run to warm up."""
    with tempfile.TemporaryDirectory() as folder:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 4  # hides a warning that the optimised graph suits only this machine
        options.optimized_model_filepath = str(Path(folder, "optimised.onnx"))
        options.enable_profiling = True
        options.profile_file_prefix = str(Path(folder, "profile"))
        session = onnxruntime.InferenceSession(
            graph.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )
        draws = np.random.default_rng(0)
        inputs = {value.name: draws.random(value.shape, np.float32) for value in session.get_inputs()}
        for _ in range(1 + turns):
            session.run(None, inputs)
        events = json.loads(Path(session.end_profiling()).read_text(encoding="utf-8"))
        return _parse_profile(onnx.load(options.optimized_model_filepath), events)


def _parse_profile(optimised: onnx.ModelProto, events: list[dict[str, Any]]) -> Profile:
    moved, kernels_ms = {}, defaultdict(list)
    for event in events:
        if event["name"].endswith("_kernel_time"):
            name, notes = event["name"].removesuffix("_kernel_time"), event["args"]
            sizes = ("activation_size", "parameter_size", "output_size")
            moved[name] = 0 if notes["op_name"] in _VIEWS else sum(int(notes[size]) for size in sizes)
            kernels_ms[name].append(event["dur"] / 1000)
    total_ms = [event["dur"] / 1000 for event in events if event["name"] == "model_run"]
    return Profile(optimised, moved, {name: times[1:] for name, times in kernels_ms.items()}, total_ms[1:])


def _assign_kernels(optimised: onnx.ModelProto, stages: Mapping[str, str]) -> dict[str, str]:
    """Return the stage of each kernel, by the kernel's name."""
    known, found = dict(stages), {}
    for node in optimised.graph.node:
        # A kernel fused from several nodes is named after its output. A kernel that ONNX Runtime adds to
        # reorder values belongs to its input.
        names = (node.name, node.name.removesuffix("_nchwc"), *node.output, *node.input)
        found[node.name] = next((known[name] for name in names if name in known), TOTAL)
        known |= dict.fromkeys(node.output, found[node.name])
    return found


def _min_ms(profiled: Profile, stages: Mapping[str, str], stage: str) -> float:
    """Return the minimum time of a stage over the turns, in milliseconds."""
    kernels = [times for name, times in profiled.kernels_ms.items() if stages[name] == stage]
    return min(map(sum, zip(*kernels, strict=True)), default=0.0)


def _load_weave_net(run: Path) -> tuple[str, WeaveNet]:
    """Return the name of a checkpoint's recipe, and its averaged network."""
    kept = checkpoint.load(run / "last.pt" if run.is_dir() else run)
    network = load_matcher_network(kept)
    if not isinstance(network, WeaveNet):
        raise StereoweaveError(
            f"{run}: expected a WeaveNet, found {kept.recipe.model}; "
            "time other networks with `python -m experiments.speed`"
        )
    return kept.recipe.name, network


def _make_matrix_product(side: int) -> onnx.ModelProto:
    """Return the graph of the product of two square float32 matrices."""
    first, second, result = (
        helper.make_tensor_value_info(name, TensorProto.FLOAT, [side, side])
        for name in ("first", "second", "result")
    )
    node = helper.make_node("MatMul", ["first", "second"], ["result"], "product")
    # The exporter's versions, because the onnx package's own may be too new for ONNX Runtime.
    return helper.make_model(
        helper.make_graph([node], "product", [first, second], [result]),
        opset_imports=[helper.make_opsetid("", 20)],
        ir_version=9,
    )


def _make_row(network: str, stage: str, cost: StageMeasurement, peak: StageMeasurement) -> StageCost:
    one_ms, two_ms = cost.times_ms
    shares = [
        100 * cost.multiply_adds / peak.multiply_adds * at_peak_ms / ms if ms else 0.0
        for ms, at_peak_ms in zip(cost.times_ms, peak.times_ms, strict=True)
    ]
    return StageCost(
        network=network,
        stage=stage,
        multiply_adds=cost.multiply_adds,
        moved_mb=cost.moved / 1e6,
        one_thread_ms=one_ms,
        two_threads_ms=two_ms,
        one_thread_peak_percent=shares[0],
        two_threads_peak_percent=shares[1],
    )
