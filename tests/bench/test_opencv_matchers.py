import runpy

import cv2
import numpy as np
import pytest

from stereoweave.bench.opencv_matchers import OPENCV_MATCHERS, fill_rows, left_right_confidence
from stereoweave.data.readers import read_scenes
from stereoweave.stereo import StereoPair

MODES = {
    "sgbm": cv2.STEREO_SGBM_MODE_SGBM,
    "sgbm_8_paths": cv2.STEREO_SGBM_MODE_HH,
    "sgbm_3_way": cv2.STEREO_SGBM_MODE_SGBM_3WAY,
}
HOLE = -1


def dots_at_7_px(rng):
    dots = rng.integers(0, 256, (48, 107, 3), dtype=np.uint8)
    return StereoPair(left=dots[:, :100].copy(), right=dots[:, 7:].copy())


@pytest.mark.parametrize("name", OPENCV_MATCHERS)
def test_each_finds_the_disparity_of_random_dots_up_to_the_left_border(rng, name):
    disparity_px = OPENCV_MATCHERS[name]()(dots_at_7_px(rng))
    assert disparity_px.shape == (48, 100)
    assert disparity_px.dtype == np.float32
    np.testing.assert_allclose(disparity_px[8:-8, 12:88], 7, atol=0.25)


def test_a_hole_takes_the_farther_of_its_neighbours_along_the_row():
    holes = [[-1, -1, -1, -1], [-1, 5, -1, 3], [2, -1, 0, 9], [-1, -1, -1, -1]]
    filled = [[-1, -1, -1, -1], [5, 5, 3, 3], [2, 2, 2, 9], [2, 2, 2, 9]]
    np.testing.assert_array_equal(fill_rows(np.array(holes, np.float32)), filled)


def test_confidence_is_the_disagreement_of_the_two_views_at_the_match():
    left_px = np.array([[HOLE, 2, 2, 1, 1.5, 2.4]], np.float32)
    right_px = np.array([[2.5, 3, HOLE, 9, 9, 9]], np.float32)
    # A hole; its match at column -1; 0 (2.5 there); 2 (a hole there); 2.5, rounded to 2; 3.6, rounded to 4.
    expected = [[-np.inf, -np.inf, -0.5, -np.inf, -np.inf, -6.6]]
    found = left_right_confidence(left_px, right_px)
    np.testing.assert_allclose(found, np.array(expected, np.float32), rtol=1e-6)
    assert found.dtype == np.float32


def test_two_views_that_agree_are_the_most_confident(rng):
    left_px = np.full((4, 20), 3, np.float32)
    confidence = left_right_confidence(left_px, left_px)
    assert (confidence[:, 3:] == 0).all()
    assert (confidence[:, :3] == -np.inf).all()


@pytest.mark.testdata
def test_sgbm_is_set_and_filled_as_the_referee_does(testdata):
    referee = runpy.run_path(str(testdata / "referee" / "score_pairs.py"))
    pairs = {scene.name: scene.pair for scene in read_scenes(testdata / "stereo" / "pairs")}
    for name, mode in MODES.items():
        expected = referee["sgbm"](mode)(pairs["tsukuba"].left, pairs["tsukuba"].right)
        np.testing.assert_array_equal(OPENCV_MATCHERS[name]()(pairs["tsukuba"]), expected)
        np.testing.assert_array_equal(fill_rows(expected), referee["fill_rows"](expected))


@pytest.mark.testdata
def test_holes_of_random_maps_are_filled_as_the_referee_does(testdata, rng):
    fill_rows_plain = runpy.run_path(str(testdata / "referee" / "score_pairs.py"))["fill_rows"]
    for share in (0.0, 0.5, 0.95, 1.0):
        holes = rng.uniform(0.1, 50, (40, 12)).astype(np.float32)
        holes[rng.random(holes.shape) < share] = -1
        np.testing.assert_array_equal(fill_rows(holes), fill_rows_plain(holes))
