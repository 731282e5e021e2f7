import csv
import json
from pathlib import Path
from unittest.mock import patch

import pytest
import torch
from learn_examples import RECIPE, checkpoint_of, complaint, recipe_of, untrained
from onnx import TensorProto, helper

from experiments.ablations.networks import VARIANTS
from experiments.stage_costs import profiling as costs
from experiments.stage_costs.__main__ import main
from stereoweave.learn import checkpoint
from stereoweave.learn.export.from_checkpoint import count_multiply_adds
from stereoweave.learn.models import MODELS

HEIGHT, WIDTH = 32, 64


def noted(operation, read, given, *modules):
    """Return a node as the exporter writes it, annotated with the modules that called it."""
    node = helper.make_node(operation, read, [given], f"node_{given}")
    note = node.metadata_props.add()
    note.key, note.value = "pkg.torch.onnx.name_scopes", str(["", *modules, given])
    return node


def graph_of(nodes, shapes, given, constants=()):
    """Return a graph of these nodes, with `shapes` as its inputs."""
    inputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in shapes.items()]
    outputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in given]
    graph = helper.make_graph(nodes, "graph", inputs, outputs, list(constants))
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=9)


def measure_small_pairs(run):
    """Return the rows of a run for pairs of WIDTH x HEIGHT; MODELS is restored."""
    with pytest.MonkeyPatch.context() as monkeypatch, patch.dict(MODELS):
        monkeypatch.setattr(costs, "HEIGHT_PX", HEIGHT)
        monkeypatch.setattr(costs, "WIDTH_PX", WIDTH)
        monkeypatch.setattr(costs, "PRODUCT_SIDE", 64)
        return costs.measure_stage_costs([run], turns=2)


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    """Return the network of a small run, and its rows."""
    file = tmp_path_factory.mktemp("run") / "last.pt"
    network = untrained()
    checkpoint.save(checkpoint_of(network), file)
    return network, measure_small_pairs(file.parent)


def test_an_operation_belongs_to_the_stage_of_its_module_or_of_what_ran_before_it():
    graph = graph_of(
        [
            noted("Concat", ["left", "right"], "both"),
            noted("Relu", ["both"], "maps", "encoder", "encoder.down"),
            noted("Neg", ["maps"], "mirror"),
            noted("Relu", ["mirror"], "features", "to_match"),
            noted("Neg", ["features"], "products"),
            noted("Add", ["products", "maps"], "scores", "aggregation"),
            noted("Neg", ["scores"], "coarse"),
            noted("Neg", ["coarse"], "handed", "to_half"),
            noted("Neg", ["handed"], "shuffled"),
            noted("Neg", ["shuffled"], "looked_up", "refinement"),
            noted("Relu", ["looked_up"], "joined", "refinement", "refinement.join"),
            noted("Neg", ["joined"], "fine", "refinement"),
            noted("Relu", ["both"], "context", "stem"),
            noted("Add", ["fine", "context"], "enlarged"),
            noted("Neg", ["context"], "compared", "to_match_stem"),
            noted("Add", ["compared", "enlarged"], "looked_up_again", "enlargement"),
            noted("Relu", ["looked_up_again"], "joined_again", "enlargement", "enlargement.join"),
            noted("Neg", ["joined_again"], "finest", "enlargement"),
            noted("Neg", ["finest"], "disparity"),
        ],
        {"left": [1], "right": [1]},
        ["disparity"],
    )
    stages = costs.find_stages(graph)
    assert {name: stage for name, stage in stages.items() if not name.startswith("node_")} == {
        "both": "encoder",
        "maps": "encoder",
        "mirror": "mirroring",
        "features": "correlation",
        "products": "correlation",
        "scores": "aggregation",
        "coarse": "disparity from scores",
        "handed": "refinement",
        "shuffled": "refinement",
        "looked_up": "local matching",
        "joined": "refinement",
        "fine": "refinement",
        "context": "encoder",
        "enlarged": "upsampling",
        "compared": "local matching",
        "looked_up_again": "local matching",
        "joined_again": "refinement",
        "finest": "refinement",
        "disparity": "upsampling",
    }
    assert stages["node_coarse"] == stages["coarse"]


def test_multiply_adds_are_of_convolutions_products_and_sums_of_products():
    ones = helper.make_tensor("axis", TensorProto.INT64, [1], [1])
    graph = graph_of(
        [
            helper.make_node("Conv", ["image", "kernel"], ["maps"], "conv", pads=[1, 1, 1, 1]),
            helper.make_node("MatMul", ["first", "second"], ["product"], "matmul"),
            helper.make_node("Mul", ["a", "b"], ["summed"], "mul"),
            helper.make_node("ReduceSum", ["summed", "axis"], ["sum"], "sum"),
            helper.make_node("Mul", ["a", "b"], ["kept"], "mul_alone"),
            helper.make_node("Mul", ["a", "a"], ["added"], "mul_of_column"),
            helper.make_node("Add", ["added", "a"], ["both"], "add"),
        ],
        {
            "image": [1, 2, 5, 6],
            "kernel": [4, 2, 3, 3],
            "first": [2, 3, 4],
            "second": [4, 5],
            "a": [7, 1],
            "b": [1, 8],
        },
        ["maps", "product", "sum", "kept", "both"],
        [ones],
    )
    counts = costs.count_multiply_adds(graph)
    # 4 maps of 5x6 from 2 at 3x3; 2x3x5 sums of 4 products; 7x8 products; 7 products.
    assert counts == {
        "conv": 4 * 5 * 6 * 2 * 9,
        "matmul": 2 * 3 * 5 * 4,
        "mul": 7 * 8,
        "mul_of_column": 7,
    }


def test_a_product_of_matrices_moves_both_and_the_result_and_runs_every_turn():
    found = costs.profile(costs._make_matrix_product(16), threads=1, turns=3)
    assert found.moved == {"product": 3 * 16 * 16 * 4}
    assert len(found.kernels_ms["product"]) == len(found.total_ms) == 3
    for kernel_ms, total_ms in zip(found.kernels_ms["product"], found.total_ms, strict=True):
        assert 0 < kernel_ms < total_ms


def test_the_least_time_of_a_stage_is_that_of_its_kernels_in_one_turn():
    profiled = costs.Profile(
        costs._make_matrix_product(2), {}, {"a": [1.0, 5.0], "b": [4.0, 1.0], "c": [9.0, 9.0]}, [14.0, 15.0]
    )
    stages = {"a": "encoder", "b": "encoder", "c": "refinement"}
    assert costs._min_ms(profiled, stages, "encoder") == 5
    assert costs._min_ms(profiled, stages, "mirroring") == 0


def test_the_first_turn_warms_up_and_views_move_nothing():
    sizes = {"activation_size": "8", "parameter_size": "4", "output_size": "2"}
    events = [
        {"name": name, "dur": dur, "args": {"op_name": operation, **sizes}}
        for dur in (9000, 1000, 2000)
        for name, operation in (("a_kernel_time", "Conv"), ("b_kernel_time", "Reshape"), ("model_run", ""))
    ]
    found = costs._parse_profile(costs._make_matrix_product(2), json.loads(json.dumps(events)))
    assert found.moved == {"a": 14, "b": 0}
    assert found.kernels_ms == {"a": [1, 2], "b": [1, 2]}
    assert found.total_ms == [1, 2]


def test_the_product_is_the_peak_and_the_stages_come_in_order_with_their_total(rows):
    _, (product, *stages, total) = rows
    assert (product.network, product.stage) == ("", costs.PRODUCT)
    assert product.multiply_adds == 64**3
    assert product.one_thread_peak_percent == pytest.approx(100)
    assert product.two_threads_peak_percent == pytest.approx(100)
    assert {row.network for row in (*stages, total)} == {RECIPE.name}
    assert total.stage == costs.TOTAL
    assert [row.stage for row in stages] == [
        "encoder",
        "mirroring",
        "correlation",
        "aggregation",
        "disparity from scores",
        "upsampling",
        "local matching",
        "refinement",
    ]


def test_the_total_is_what_the_stages_sum_to(rows):
    network, (product, *stages, total) = rows
    assert sum(row.multiply_adds for row in stages) == total.multiply_adds
    # Every kernel belongs to a stage.
    assert sum(row.moved_mb for row in stages) == pytest.approx(total.moved_mb)
    assert total.one_thread_ms >= max(row.one_thread_ms for row in stages) > 0
    # The network's card does not count the sums of weighted neighbours.
    assert total.multiply_adds == pytest.approx(count_multiply_adds(network, HEIGHT, WIDTH), rel=0.02)
    speed, peak = total.multiply_adds / total.one_thread_ms, product.multiply_adds / product.one_thread_ms
    assert total.one_thread_peak_percent == pytest.approx(100 * speed / peak)


def test_the_convolutions_of_the_encoder_are_counted_there(rows):
    network, (_, encoder, *_) = rows
    with torch.no_grad(), torch.utils.flop_counter.FlopCounterMode(display=False) as counter:
        network.encoder(torch.rand(2, 3, HEIGHT, WIDTH))
    assert encoder.multiply_adds == counter.get_total_flops() // 2


def test_the_table_has_a_line_for_each_row(rows):
    _, found = rows
    lines = costs.format_table(found).splitlines()
    assert len(lines) == 2 + len(found)
    assert {line.count("|") for line in lines} == {9}
    assert lines[2].startswith(f"|  | {costs.PRODUCT} | 0.3 | 0.0 | ")
    assert lines[2].endswith("| 100 % |")


def test_an_ablations_checkpoint_is_measured_too(rows, tmp_path):
    name = "weave_small_without_context"
    assert name not in MODELS
    checkpoint.save(checkpoint_of(VARIANTS[name](), recipe_of(name)), tmp_path / "last.pt")
    counts, of_small = (
        {row.stage: row.multiply_adds for row in found} for found in (measure_small_pairs(tmp_path), rows[1])
    )
    assert counts.keys() == of_small.keys()
    assert {stage for stage in counts if counts[stage] < of_small[stage]} == {"aggregation", costs.TOTAL}


def test_another_network_is_one_line_that_says_where_it_is_timed(tmp_path):
    recipe = recipe_of("fast_depth", target="disparity")
    checkpoint.save(checkpoint_of(untrained("fast_depth"), recipe), tmp_path / "last.pt")
    assert "expected a WeaveNet" in complaint(costs.measure_stage_costs, [tmp_path / "last.pt"])


def test_the_command_prints_the_table_and_writes_the_rows(rows, monkeypatch, tmp_path, capsys):
    _, found = rows
    asked = []
    monkeypatch.setattr(costs, "measure_stage_costs", lambda runs: asked.append(runs) or found)
    assert main(["a", "b.pt", "-o", str(tmp_path / "costs.csv")]) == 0
    assert asked == [[Path("a"), Path("b.pt")]]
    assert capsys.readouterr().out == costs.format_table(found) + "\n"
    with (tmp_path / "costs.csv").open(newline="") as file:
        assert [row["stage"] for row in csv.DictReader(file)] == [row.stage for row in found]
