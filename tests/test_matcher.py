from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

import stereoweave as sw
from stereoweave import matcher
from stereoweave.matcher import Matcher

IMAGE = ["b", 3, "h", "w"]
MAP = ["b", 1, "h", "w"]
PROPERTIES = {"name": "by_hand", "multiple_of": 16, "max_disparity_px": 255}


def matcher_file(path: Path, nodes, outputs, properties=PROPERTIES, inputs=("left", "right")) -> Path:
    """A matcher file whose graph is written by hand; the constants `red` and `scale` are there to use."""
    graph = helper.make_graph(
        nodes,
        "by_hand",
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, IMAGE) for name in inputs],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, MAP) for name in outputs],
        [
            helper.make_tensor("red", TensorProto.INT64, [1], [0]),
            helper.make_tensor("scale", TensorProto.FLOAT, [1], [255.0]),
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    helper.set_model_props(model, {f"stereoweave.{key}": str(value) for key, value in properties.items()})
    onnx.save(model, path)
    return path


def red_of(image: str, output: str):
    """Nodes that give the red channel of an image in 0..255: a disparity that the test paints."""
    return [
        helper.make_node("Gather", [image, "red"], [f"{output}_red"], axis=1),
        helper.make_node("Mul", [f"{output}_red", "scale"], [output]),
    ]


def painted(disparity_px) -> np.ndarray:
    return np.repeat(np.asarray(disparity_px, np.uint8)[:, :, None], 3, axis=2)


@pytest.fixture
def both_views(tmp_path):
    nodes = red_of("left", "disparity_px") + red_of("right", "right_disparity_px")
    return Matcher(matcher_file(tmp_path / "both.onnx", nodes, ["disparity_px", "right_disparity_px"]))


@pytest.mark.parametrize(("height", "width"), [(32, 32), (33, 47), (96, 130)])
def test_the_shipped_network_takes_any_size_from_32_px_up(rng, height, width):
    left, right = rng.integers(0, 256, (2, height, width, 3), np.uint8)
    found = sw.estimate(left, right)
    for values in (found.disparity_px, found.right_disparity_px, found.confidence):
        assert values.shape == (height, width) and values.dtype == np.float32 and np.isfinite(values).all()
    assert found.occluded.shape == (height, width) and found.occluded.dtype == bool
    assert found.confidence.min() >= 0 and found.confidence.max() <= 1


def test_a_graph_of_one_output_runs_the_mirrored_pair_for_the_other_view(tmp_path, rng):
    file = matcher_file(tmp_path / "one.onnx", red_of("left", "disparity_px"), ["disparity_px"])
    left, right = (painted(rng.integers(0, 255, (40, 50))) for _ in range(2))
    found = Matcher(file).estimate(left, right)
    np.testing.assert_allclose(found.disparity_px, left[:, :, 0], atol=1e-4)
    np.testing.assert_allclose(found.right_disparity_px, right[:, :, 0], atol=1e-4)


def test_padding_repeats_the_border(tmp_path):
    lowest = helper.make_node("ReduceMin", ["all"], ["lowest"], keepdims=1)
    everywhere = helper.make_node("Max", ["all", "lowest"], ["spread"])
    difference = helper.make_node("Sub", ["all", "spread"], ["nothing"])
    answer = helper.make_node("Add", ["nothing", "lowest"], ["disparity_px"])
    nodes = [*red_of("left", "all"), lowest, everywhere, difference, answer]
    found = Matcher(matcher_file(tmp_path / "min.onnx", nodes, ["disparity_px"])).estimate(
        painted(np.full((33, 45), 90)), painted(np.full((33, 45), 90))
    )
    np.testing.assert_allclose(found.disparity_px, 90, atol=1e-4)  # zeros in the padding would be the lowest


def test_a_nearer_surface_and_the_left_border_occlude(both_views):
    # A wall at disparity 4, and on its columns 20..29 a board at 10, which the right camera sees at 10..19:
    # of the wall it hides left columns 14..23, of which the left camera sees 14..19.
    left_px, right_px = np.full((32, 40), 4), np.full((32, 40), 4)
    left_px[:, 20:30] = 10
    right_px[:, 10:20] = 10
    expected = np.zeros((32, 40), bool)
    expected[:, :4] = True  # their match lies left of the right image
    expected[:, 14:20] = True
    found = both_views.estimate(painted(left_px), painted(right_px))
    np.testing.assert_array_equal(found.occluded, expected)


def test_confidence_is_the_probability_of_the_logit(tmp_path):
    nodes = red_of("left", "disparity_px") + red_of("right", "confidence_logit")
    file = matcher_file(tmp_path / "sure.onnx", nodes, ["disparity_px", "confidence_logit"])
    found = Matcher(file).estimate(painted(np.full((32, 32), 3)), painted(np.full((32, 32), 2)))
    np.testing.assert_allclose(found.confidence, 1 / (1 + np.exp(-2.0)), rtol=1e-5)


def test_strips_put_together_are_the_whole(both_views, rng, monkeypatch):
    left, right = (painted(rng.integers(0, 255, (700, 64))) for _ in range(2))
    whole = both_views.estimate(left, right)
    monkeypatch.setattr(matcher, "_PIXEL_PAIRS_AT_ONCE", 64 * 64 * 256)
    assert len(list(matcher._strips(700, both_views._strip_rows(64)))) > 3
    in_strips = both_views.estimate(left, right)
    np.testing.assert_allclose(in_strips.disparity_px, whole.disparity_px, atol=1e-3)


@pytest.mark.parametrize(("height", "rows"), [(700, 256), (385, 384), (1080, 320), (2000, 256)])
def test_strips_cover_every_row_and_leave_no_row_without_weight(height, rows):
    strips = list(matcher._strips(height, rows))
    weights = np.zeros((height, 1))
    for strip in strips:
        assert strip.stop - strip.start <= rows
        weights[strip] += matcher._strip_weights(strip, height)
    assert weights.min() > 0.4


def test_the_number_of_threads_is_honoured():
    assert Matcher("small", threads=1)._session.get_session_options().intra_op_num_threads == 1


def test_a_model_is_loaded_once_and_kept(rng):
    matcher._kept_matcher.cache_clear()
    left, right = rng.integers(0, 256, (2, 32, 32, 3), np.uint8)
    for _ in range(3):
        sw.estimate(left, right)
    assert matcher._kept_matcher.cache_info().misses == 1


def test_the_answer_does_not_depend_on_earlier_calls_of_other_sizes(rng):
    left, right = rng.integers(0, 256, (2, 64, 80, 3), np.uint8)
    first = sw.estimate(left, right)
    sw.estimate(left[:40, :70], right[:40, :70])
    np.testing.assert_array_equal(sw.estimate(left, right).disparity_px, first.disparity_px)


def test_an_unknown_name_lists_the_shipped_ones():
    with pytest.raises(sw.MatcherError, match=r"unknown model 'tiny'; expected small"):
        Matcher("tiny")


def test_a_graph_that_is_no_matcher_is_refused(tmp_path):
    nodes = red_of("picture", "label")
    file = matcher_file(tmp_path / "other.onnx", nodes, ["label"], inputs=("picture",))
    with pytest.raises(sw.MatcherError, match=r"other\.onnx: expected a matcher.*found inputs picture"):
        Matcher(file)


def test_a_matcher_without_metadata_is_refused(tmp_path):
    file = matcher_file(
        tmp_path / "bare.onnx", red_of("left", "disparity_px"), ["disparity_px"], {"name": "bare"}
    )
    with pytest.raises(sw.MatcherError, match=r"no stereoweave\.multiple_of"):
        Matcher(file)


def test_a_file_that_is_no_onnx_is_refused_in_one_line(tmp_path):
    file = tmp_path / "garbage.onnx"
    file.write_bytes(b"not a graph")
    with pytest.raises(sw.MatcherError, match=r"garbage\.onnx") as caught:
        Matcher(file)
    assert "\n" not in str(caught.value)


def test_images_under_32_px_are_refused(both_views):
    with pytest.raises(sw.StereoweaveError, match="at least 32x32 px, got 40x31"):
        both_views.estimate(painted(np.zeros((31, 40))), painted(np.zeros((31, 40))))
