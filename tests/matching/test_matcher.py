from dataclasses import replace

import numpy as np
import pytest
from matcher_examples import ANY_SIZE, PROPERTIES, matcher_file, of_fixed_size, painted, red_of
from onnx import TensorProto, helper

import stereoweave as sw
from stereoweave.io.images import read_pair
from stereoweave.matching import matcher
from stereoweave.matching.contrast import measure_contrast
from stereoweave.matching.estimate import match, match_many
from stereoweave.matching.matcher import Matcher
from stereoweave.matching.options import MatchOptions
from stereoweave.matching.providers import PROVIDERS
from stereoweave.stereo import StereoPair


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


def test_no_run_has_more_rows_than_opencv_supports():
    small = Matcher("small", threads=1)
    assert small.sees_whole(32, 32_766)
    assert not small.sees_whole(32, 32_767)


def test_a_graph_of_one_output_runs_the_mirrored_pair_for_the_other_view(tmp_path, rng):
    file = matcher_file(tmp_path / "one.onnx", red_of("left", "disparity_px"), ["disparity_px"])
    left, right = (painted(rng.integers(0, 255, (40, 50))) for _ in range(2))
    found = Matcher(file).estimate(left, right, raw=True)
    np.testing.assert_allclose(found.disparity_px, left[:, :, 0], atol=1e-4)
    np.testing.assert_allclose(found.right_disparity_px, right[:, :, 0], atol=1e-4)


def test_padding_repeats_the_border(tmp_path):
    nodes = [
        *red_of("left", "all"),
        helper.make_node("Gather", ["all", "last"], ["last_column"], axis=3),
        helper.make_node("Gather", ["last_column", "last"], ["corner"], axis=2),
        helper.make_node("Sub", ["all", "all"], ["nothing"]),
        helper.make_node("Add", ["nothing", "corner"], ["disparity_px"]),
    ]
    y, x = np.mgrid[:33, :45]
    ramp = painted(2 * x + 3 * y)
    found = Matcher(matcher_file(tmp_path / "corner.onnx", nodes, ["disparity_px"])).estimate(ramp, ramp)
    # The picture padded to 48x48 ends with the level of its border; reflected padding would be darker.
    np.testing.assert_allclose(found.disparity_px, 2 * 44 + 3 * 32, atol=1e-4)


def test_a_nearer_surface_and_the_left_border_occlude(both_views):
    # A wall is at disparity 4. A board at disparity 10 covers columns 20..29, which the right camera sees at
    # 10..19. It occludes the wall's left columns 14..23, of which the left camera sees 14..19.
    left_px, right_px = np.full((32, 40), 4), np.full((32, 40), 4)
    left_px[:, 20:30] = 10
    right_px[:, 10:20] = 10
    expected = np.zeros((32, 40), bool)
    expected[:, :4] = True  # their match is beyond the right image's left border
    expected[:, 14:20] = True
    found = both_views.estimate(painted(left_px), painted(right_px))
    np.testing.assert_array_equal(found.occluded, expected)


def test_the_occluded_wall_takes_the_walls_disparity_unless_raw(both_views):
    # As above, but the network gives the occluded part of the wall 2 px.
    left_px, right_px = np.full((32, 40), 4), np.full((32, 40), 4)
    left_px[:, 20:30] = 10
    right_px[:, 10:20] = 10
    left_px[:, 14:20] = 2
    left, right = painted(left_px), painted(right_px)
    raw, found = (both_views.estimate(left, right, raw=raw) for raw in (True, False))
    np.testing.assert_allclose(raw.disparity_px, left_px, atol=1e-4)
    np.testing.assert_allclose(found.disparity_px[:, 14:20], 4, atol=0.1)
    np.testing.assert_array_equal(found.occluded, raw.occluded)
    assert found.occluded[:, 14:20].all()


@pytest.mark.parametrize("call", ["estimate", "estimate_many", "sw.estimate", "match", "match_many"])
def test_an_estimate_cannot_be_both_refined_and_raw(both_views, call):
    grey = np.full((32, 40, 3), 90, np.uint8)
    pair, both = StereoPair(left=grey, right=grey), {"refined": True, "raw": True}
    calls = {
        "estimate": lambda: both_views.estimate(grey, grey, **both),
        "estimate_many": lambda: both_views.estimate_many([pair], **both),
        "sw.estimate": lambda: sw.estimate(grey, grey, **both),
        "match": lambda: match(both_views, pair, MatchOptions(**both)),
        "match_many": lambda: match_many(both_views, [pair], MatchOptions(**both)),
    }
    with pytest.raises(sw.StereoweaveError, match="raw: cannot be combined with refined"):
        calls[call]()


def test_confidence_is_the_probability_of_the_logit(tmp_path, rng):
    nodes = red_of("left", "disparity_px") + red_of("right", "confidence_logit")
    file = matcher_file(tmp_path / "sure.onnx", nodes, ["disparity_px", "confidence_logit"])
    left, right = painted(np.full((32, 32), 3)), painted(np.full((32, 32), 3))
    left[:, :, 1] = rng.integers(0, 256, (32, 32))  # a plain picture has no confidence
    found = Matcher(file).estimate(left, right, raw=True)
    np.testing.assert_allclose(found.confidence, 1 / (1 + np.exp(-3.0)), rtol=1e-5)


def test_the_confidence_of_an_extreme_logit_is_0_or_1():
    logit = np.array([[-200, -89, 0, 89, 200]], np.float32)
    nowhere = np.zeros((1, 5), bool)
    found = matcher._confidence(logit, np.zeros((1, 5), np.float32), nowhere, nowhere)
    np.testing.assert_allclose(found, [[0, 0, 0.5, 1, 1]], atol=1e-30)
    assert found.dtype == np.float32


def test_confidence_is_halved_where_no_right_disparity_within_four_columns_is_as_near(tmp_path, rng):
    nodes = [
        *red_of("left", "disparity_px"),
        *red_of("right", "right_disparity_px"),
        helper.make_node("Sub", ["disparity_px", "disparity_px"], ["confidence_logit"]),
    ]
    outputs = ["disparity_px", "right_disparity_px", "confidence_logit"]
    even_odds = Matcher(matcher_file(tmp_path / "even.onnx", nodes, outputs))
    # Two boards at disparity 10 before a wall at 4. The right view has the first one's left edge, at column
    # 10, two columns late, and misses the second board.
    left_px, right_px = np.full((32, 100), 4), np.full((32, 100), 4)
    left_px[:, 20:30] = left_px[:, 60:66] = 10
    right_px[:, 12:20] = 10
    left, right = painted(left_px), painted(right_px)
    left[:, :, 1] = rng.integers(0, 256, (32, 100))  # a plain picture has no confidence
    expected = np.full((32, 100), 0.5)
    expected[:, 60:66] = 0.25
    np.testing.assert_array_equal(even_odds.estimate(left, right, raw=True).confidence, expected)


def test_without_a_logit_confidence_depends_on_the_disagreement():
    disagreement_px = np.log(np.array([[0.5, 1, 2, 1]], np.float32))
    plain = np.array([[False, False, False, True]])
    found = matcher._confidence(None, disagreement_px, np.zeros((1, 4), bool), plain)
    np.testing.assert_allclose(found, [[0.5, 1, 0.5, 0]], rtol=1e-6)


def test_a_pixel_is_plain_without_texture_within_32_px():
    # Columns 0 to 99 are plain grey up to 2 levels of rounding; a board of another grey begins at column 100.
    image = painted(np.full((40, 140), 90))
    image[::2, ::3] += 2
    image[:, 100:] = 93
    expected = np.zeros((40, 140), bool)
    # The last mean of 90 is at column 95. The first mean of 93 is at column 103: 8 of its 9 columns are on
    # the board.
    expected[:, : 103 - 32] = True
    expected[:, 95 + 32 + 1 :] = True
    contrast = measure_contrast(image, matcher._PLAIN_MEAN_PX, matcher._PLAIN_WINDOW_PX)
    np.testing.assert_array_equal(contrast <= matcher._PLAIN_GREY_LEVELS, expected)


def test_blended_strips_equal_the_whole(tmp_path, rng, monkeypatch):
    # Each output is the mean of the 65 rows around it, so a strip is wrong within 32 rows of its ends.
    mean = helper.make_node(
        "AveragePool", ["all"], ["disparity_px"], kernel_shape=[65, 1], pads=[32, 0, 32, 0]
    )
    nodes = [*red_of("left", "all"), mean]
    unpadded = PROPERTIES | {"multiple_of": 1}  # no strip is padded
    means = Matcher(matcher_file(tmp_path / "means.onnx", nodes, ["disparity_px"], unpadded))
    left, right = (painted(rng.integers(0, 255, (700, 64))) for _ in range(2))
    whole = means.estimate(left, right)
    monkeypatch.setattr(matcher, "PIXEL_PAIRS_AT_ONCE", 64 * 64 * 256)
    assert len(list(matcher._strips(700, means._strip_rows(64)))) > 3
    in_strips = means.estimate(left, right)
    np.testing.assert_allclose(in_strips.disparity_px, whole.disparity_px, atol=1e-3)


@pytest.mark.parametrize(("height", "rows"), [(700, 256), (385, 384), (1080, 320), (2000, 256)])
def test_strips_cover_every_row_and_leave_no_row_without_weight(height, rows):
    strips = list(matcher._strips(height, rows))
    weights = np.zeros((height, 1))
    for strip in strips:
        assert strip.stop - strip.start <= rows
        weights[strip] += matcher._strip_weights(strip, height)
    assert weights.min() > 0.4


def test_low_and_very_wide_pictures_do_not_fit_one_run(both_views):
    # Even the smallest strip, of 256 rows, with 20000 columns exceeds the limit of pixel pairs 25 times.
    assert both_views.sees_whole(1920, 1088)
    assert both_views.sees_whole(200, 20_000)
    assert not both_views.sees_whole(20_000, 200)


def test_the_number_of_threads_is_honoured():
    assert Matcher("small", threads=1)._network.session.get_session_options().intra_op_num_threads == 1


def test_an_unknown_name_lists_the_shipped_ones():
    with pytest.raises(sw.MatcherError, match="unknown model 'tiny'; expected base, small, best or the path"):
        Matcher("tiny")


def test_a_graph_that_is_no_matcher_is_refused(tmp_path):
    nodes = red_of("picture", "label")
    file = matcher_file(tmp_path / "other.onnx", nodes, ["label"], inputs=("picture",))
    with pytest.raises(sw.MatcherError, match=r"other\.onnx: expected a matcher with.*found inputs picture"):
        Matcher(file)


def test_the_order_of_the_inputs_is_free(tmp_path, rng):
    nodes = red_of("left", "disparity_px")
    file = matcher_file(tmp_path / "swapped.onnx", nodes, ["disparity_px"], inputs=("right", "left"))
    left, right = (painted(rng.integers(0, 255, (32, 48))) for _ in range(2))
    found = Matcher(file).estimate(left, right, raw=True)
    np.testing.assert_allclose(found.disparity_px, left[:, :, 0], atol=1e-4)


@pytest.mark.parametrize(
    ("key", "value"),
    [("multiple_of", value) for value in ("0", "1.5", "1000000")]
    + [("max_disparity_px", value) for value in ("far", "nan", "inf", "-192", "0")],
)
def test_metadata_that_is_no_possible_number_is_refused(tmp_path, key, value):
    nodes = red_of("left", "disparity_px")
    file = matcher_file(tmp_path / "odd.onnx", nodes, ["disparity_px"], PROPERTIES | {key: value})
    with pytest.raises(sw.MatcherError, match=rf"odd\.onnx: expected .* found .*{key} '{value}'"):
        Matcher(file)


def test_a_matcher_whose_metadata_is_no_text_is_refused(tmp_path):
    nodes = red_of("left", "disparity_px")
    file = matcher_file(tmp_path / "odd.onnx", nodes, ["disparity_px"], PROPERTIES | {"name": "network"})
    file.write_bytes(file.read_bytes().replace(b"network", b"net\xffork"))
    with pytest.raises(sw.MatcherError, match=r"odd\.onnx: expected metadata in UTF-8"):
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


def counting(path, size=ANY_SIZE):
    """Write a matcher file that returns left red as disparity, and the batch size as right disparity."""
    nodes = [
        *red_of("left", "disparity_px"),
        helper.make_node("Sub", ["disparity_px", "disparity_px"], ["nothing"]),
        helper.make_node("Shape", ["left"], ["count"], end=1),
        helper.make_node("Cast", ["count"], ["count_px"], to=TensorProto.FLOAT),
        helper.make_node("Add", ["nothing", "count_px"], ["right_disparity_px"]),
    ]
    return matcher_file(path, nodes, ["disparity_px", "right_disparity_px"], size=size)


@pytest.fixture
def like_a_gpu(monkeypatch):
    """Let the CPU run batches of pairs, as a GPU does."""
    monkeypatch.setitem(PROVIDERS, "cpu", replace(PROVIDERS["cpu"], batches=True))


@pytest.fixture
def five_pairs(rng):
    return [StereoPair(left=x, right=x) for x in rng.integers(0, 256, (5, 48, 64, 3), np.uint8)]


@pytest.mark.parametrize(
    ("size", "counts"), [(ANY_SIZE, [2, 2, 2, 2, 1]), ((1, "h", "w"), [1] * 5), ((1, 64, 80), [1] * 5)]
)
def test_pairs_of_equal_size_run_in_batches_as_the_file_and_memory_allow(
    tmp_path, five_pairs, like_a_gpu, monkeypatch, size, counts
):
    monkeypatch.setattr(matcher, "PIXEL_PAIRS_AT_ONCE", 2 * 48 * 64 * 64 + 1)
    found = Matcher(counting(tmp_path / "counting.onnx", size)).estimate_many(five_pairs, raw=True)
    assert [estimate.right_disparity_px.max() for estimate in found] == counts
    for pair, estimate in zip(five_pairs, found, strict=True):
        np.testing.assert_allclose(estimate.disparity_px, pair.left[:, :, 0], atol=1e-4)


@pytest.mark.parametrize("views", [1, 2])
def test_pairs_give_the_same_results_in_a_batch_and_alone(tmp_path, five_pairs, like_a_gpu, views):
    # 47x61 is padded; a network with one output also runs the mirrored pairs.
    outputs = ["disparity_px", "right_disparity_px"][:views]
    nodes = [
        node for image, out in zip(("left", "right"), outputs, strict=False) for node in red_of(image, out)
    ]
    network = Matcher(matcher_file(tmp_path / "red.onnx", nodes, outputs))
    pairs = [StereoPair(left=x.left[:47, :61], right=x.right[::-1][:47, :61]) for x in five_pairs]
    for pair, found in zip(pairs, network.estimate_many(pairs), strict=True):
        alone = network.estimate(pair.left, pair.right)
        for name in ("disparity_px", "right_disparity_px", "confidence"):
            np.testing.assert_allclose(getattr(found, name), getattr(alone, name), atol=1e-3)
        np.testing.assert_array_equal(found.occluded, alone.occluded)


def test_the_processor_takes_one_pair_after_another(tmp_path, five_pairs):
    found = Matcher(counting(tmp_path / "counting.onnx")).estimate_many(five_pairs)
    assert [estimate.right_disparity_px.max() for estimate in found] == [1] * 5


def test_the_shipped_network_gives_the_same_results_in_a_batch_and_alone(five_pairs, like_a_gpu):
    network = Matcher()
    for pair, found in zip(five_pairs[:2], network.estimate_many(five_pairs[:2]), strict=True):
        alone = network.estimate(pair.left, pair.right)
        np.testing.assert_allclose(found.right_disparity_px, alone.right_disparity_px, atol=1e-3)
        np.testing.assert_allclose(found.confidence, alone.confidence, atol=1e-3)


def test_no_pairs_give_no_estimates(both_views):
    assert both_views.estimate_many([]) == []


def test_pairs_of_two_sizes_are_refused_together(both_views, five_pairs):
    smaller = StereoPair(left=five_pairs[0].left[:40], right=five_pairs[0].right[:40])
    with pytest.raises(sw.StereoweaveError, match="pairs of equal size, got 64x40, 64x48"):
        both_views.estimate_many([*five_pairs, smaller])


def test_large_pairs_run_in_strips_one_after_another(tmp_path, rng, like_a_gpu, monkeypatch):
    monkeypatch.setattr(matcher, "PIXEL_PAIRS_AT_ONCE", 64 * 64 * 256)
    pairs = [StereoPair(left=x, right=x) for x in rng.integers(0, 256, (2, 400, 64, 3), np.uint8)]
    found = Matcher(counting(tmp_path / "counting.onnx")).estimate_many(pairs, raw=True)
    for pair, estimate in zip(pairs, found, strict=True):
        np.testing.assert_allclose(estimate.disparity_px, pair.left[:, :, 0], atol=1e-3)
        np.testing.assert_allclose(estimate.right_disparity_px, 1, atol=1e-3)


def test_a_file_for_one_size_takes_smaller_pictures_and_refuses_larger_ones_in_one_line(tmp_path, rng):
    network = Matcher(counting(tmp_path / "one_size.onnx", (1, 64, 80)))
    assert network.fixed_size == (64, 80)
    assert network.sees_whole(80, 64) and network.sees_whole(33, 40)
    assert not network.sees_whole(81, 64) and not network.sees_whole(80, 65)
    picture = rng.integers(0, 256, (41, 57, 3), np.uint8)
    found = network.estimate(picture, picture, raw=True)
    np.testing.assert_allclose(found.disparity_px, picture[:, :, 0], atol=1e-4)
    tall = np.zeros((65, 64, 3), np.uint8)
    message = r"at most 80x64 px, the input size of one_size\.onnx, got 64x65; matching\.match scales"
    with pytest.raises(sw.StereoweaveError, match=message):
        network.estimate(tall, tall)


def test_padding_to_a_fixed_size_changes_little(tmp_path):
    pair = read_pair("tests/textured_pair/left.png", "tests/textured_pair/right.png")
    left, right = (np.ascontiguousarray(x[120:280, 200:424]) for x in (pair.left, pair.right))
    fixed = Matcher(of_fixed_size("small", tmp_path / "fixed.onnx", 256, 320))
    alone, found = Matcher().estimate(left, right), fixed.estimate(left, right)
    sure = (alone.confidence > 0.9) & ~alone.occluded
    assert sure.mean() > 0.4
    assert np.mean(np.abs(found.disparity_px - alone.disparity_px)[sure] > 1) < 0.01


def test_a_matcher_is_shown_by_its_model_range_and_provider():
    assert repr(Matcher("small")) == "Matcher(small, disparity 0 to 256 px, cpu)"
