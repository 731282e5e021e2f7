import re
from pathlib import Path

import numpy as np
import pytest
from onnx import load, save

from stereoweave.hints import hints, told
from stereoweave.io import read_image, read_pair
from stereoweave.learn.collage import sample
from stereoweave.matcher import Matcher
from stereoweave.stereo import Estimate, StereoPair

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = ROOT / "examples"
SMALL = ROOT / "stereoweave/weights/small.onnx"
UNSEEN_SEED = 4_000_037
NOTHING = np.full((10, 10), np.nan, np.float32)


@pytest.fixture(scope="module")
def small():
    return Matcher("small", threads=1)


def estimate_of(confidence, disparity_px=20.0) -> Estimate:
    """Ten rows of ten columns, of the ten values given or of one."""
    confidence, disparity_px = (
        np.tile(np.float32(x), (10, 10 // np.size(x))) for x in (confidence, disparity_px)
    )
    return Estimate(
        disparity_px=disparity_px,
        right_disparity_px=disparity_px,
        confidence=confidence,
        occluded=np.zeros((10, 10), bool),
    )


def columns(values: dict[int, float]) -> np.ndarray:
    """A trial that is confident in these columns alone."""
    found = NOTHING.copy()
    for column, value in values.items():
        found[:, column] = value
    return found


def hints_of(left, right, matcher) -> list[str]:
    pair = StereoPair(left=np.ascontiguousarray(left), right=np.ascontiguousarray(right))
    return hints(pair, matcher.estimate(pair.left, pair.right), matcher)


UNSURE_OF_FOUR = [0.9, 0.9, 0.9, 0.9, 0.9, 0.9, 0.1, 0.1, 0.1, 0.1]


def test_a_pair_of_which_the_network_is_sure_gets_no_line():
    assert told(estimate_of(0.9), NOTHING, NOTHING, 192) == []


def test_what_is_found_nearer_than_the_range_at_half_the_size_is_named():
    # Of columns 6 to 9 the trial finds two beyond 192 px, one in front of it and none in the last.
    (line,) = told(estimate_of(UNSURE_OF_FOUR), columns({6: 230, 7: 192, 8: 191}), NOTHING, 192)
    assert line.startswith("20 % of the picture seems nearer than the network's range, 0 to 192 px: ")
    assert "at up to 230 px; match smaller copies" in line


def test_what_is_found_behind_the_range_in_a_mirror_is_named():
    (line,) = told(estimate_of(UNSURE_OF_FOUR), NOTHING, columns({6: -50, 7: -2, 8: -1}), 192)
    assert line.startswith("20 % of the picture seems behind the network's range, 0 to 192 px: ")
    assert "down to -50 px; are LEFT and RIGHT swapped? If not, cut 50 columns off the right of LEFT" in line


def test_an_estimate_at_the_end_of_the_range_counts_as_unsure():
    at_the_end = estimate_of(0.9, [0, 0, 0, 20, 20, 20, 20, 20, 20, 20])
    (line,) = told(at_the_end, NOTHING, columns({0: -5, 1: -5, 2: -5, 3: -5}), 192)
    assert line.startswith("30 % of the picture seems behind")


def test_a_trial_says_nothing_where_the_estimate_is_sure():
    assert told(estimate_of(0.9), columns({1: 230, 2: 230}), columns({3: -50, 4: -50}), 192) == []


def test_low_confidence_nearly_everywhere_is_told_unless_its_reason_is():
    unsure_of_eight = estimate_of([0.9, 0.9, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1])
    (line,) = told(unsure_of_eight, NOTHING, NOTHING, 192)
    assert line.startswith("sure of only 20 % of the picture")
    (line,) = told(unsure_of_eight, columns({8: 300}), NOTHING, 192)
    assert line.startswith("10 % of the picture seems nearer")
    assert told(estimate_of(UNSURE_OF_FOUR), NOTHING, NOTHING, 192) == []


def test_a_near_wall_swapped_sides_and_a_black_pair_each_get_their_line(small):
    wide = sample(UNSEEN_SEED, 3, 0, 256, 900).left
    (line,) = hints_of(wide[:, :640], wide[:, 240:880], small)
    assert "nearer than the network's range, 0 to 192 px: at half the size it is found at up to 24" in line
    pair = read_pair(EXAMPLES / "left.png", EXAMPLES / "right.png")
    (line,) = hints_of(pair.right, pair.left, small)
    assert "swapped?" in line
    (line,) = hints_of(np.zeros_like(pair.left), np.zeros_like(pair.left), small)
    assert line.startswith("sure of only 0 %")


def test_the_columns_to_cut_bring_a_pair_into_the_range(small):
    wide = sample(UNSEEN_SEED, 3, 0, 256, 700).left
    left, right = wide[:, 30:670], wide[:, :640]  # everything at -30 px
    (line,) = hints_of(left, right, small)
    (cut,) = map(int, re.findall(r"cut (\d+) columns off the right of LEFT and off the left of RIGHT", line))
    assert 30 <= cut <= 32
    left, right = (np.ascontiguousarray(x) for x in (left[:, :-cut], right[:, cut:]))
    assert np.median(small.estimate(left, right).disparity_px) == pytest.approx(cut - 30, abs=0.5)
    assert hints_of(left, right, small) == []


def test_sound_pairs_get_no_line(small):
    for index in range(12):
        made = sample(UNSEEN_SEED, 2, index)
        assert hints_of(made.left, made.right, small) == [], index


@pytest.mark.testdata
def test_no_real_pair_gets_a_line(testdata, small):
    folders = sorted(left.parent for left in (testdata / "stereo").glob("*/*/left.png"))
    assert len(folders) == 15
    for folder in folders:
        assert hints_of(read_image(folder / "left.png"), read_image(folder / "right.png"), small) == [], (
            folder
        )


def test_pictures_too_small_to_halve_work(small, rng):
    left, right = rng.integers(0, 256, (2, 33, 40, 3), np.uint8)
    (line,) = hints_of(left, right, small)
    assert line.startswith("sure of only")


def test_a_graph_of_one_size_is_not_tried_at_another(tmp_path, rng):
    graph = load(SMALL)
    for image in graph.graph.input:
        for axis, side in ((2, 64), (3, 96)):
            image.type.tensor_type.shape.dim[axis].dim_value = side
    save(graph, tmp_path / "fixed.onnx")
    left, right = rng.integers(0, 256, (2, 64, 96, 3), np.uint8)
    (line,) = hints_of(left, right, Matcher(tmp_path / "fixed.onnx", threads=1))
    assert line.startswith("sure of only")
