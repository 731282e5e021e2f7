from dataclasses import replace

import numpy as np
import pytest

from experiments.failures.gallery import draw_failures, find_failures
from stereoweave.data.readers import Scene
from stereoweave.stereo import Estimate, StereoPair

# The width of a cell of the picture.
WIDTH = 256


def scene_of(name, wrong=0):
    """Return a textured plane at 4 px, and an estimate that is 6 px off in the last `wrong` columns."""
    rng = np.random.default_rng(0)
    left, right = rng.integers(0, 256, (2, 16, WIDTH, 3), dtype=np.uint8)
    truth_px = np.full((16, WIDTH), 4, np.float32)
    estimate_px = truth_px.copy()
    estimate_px[:, WIDTH - wrong :] += 6
    estimate = Estimate(
        disparity_px=estimate_px,
        right_disparity_px=truth_px,
        confidence=np.ones_like(truth_px),
        occluded=np.zeros((16, WIDTH), bool),
    )
    return Scene(name=name, pair=StereoPair(left=left, right=right), truth_px=truth_px), estimate


def test_the_worst_pair_of_each_set_is_found_and_the_worst_comes_first():
    matched = [scene_of("a/1", 16), scene_of("a/2", 64), scene_of("b/1"), scene_of("c/1", 128)]
    found = [failure for failure, _, _ in find_failures(matched, 2)]
    assert [failure.scene for failure in found] == ["c/1", "a/2"]
    assert found[1].bad2_percent == pytest.approx(25)
    assert found[1].epe_px == pytest.approx(6 / 4)
    assert found[1].worst_class == "textured"
    assert 20 < found[1].worst_class_bad2_percent <= 25


def test_a_pair_without_known_disparity_is_left_out():
    scene, estimate = scene_of("a/1", 64)
    unknown = replace(scene, truth_px=np.full_like(scene.truth_px, np.nan))
    assert find_failures([(unknown, estimate)], 1) == []


def test_a_row_shows_left_picture_truth_estimate_and_error():
    scene, estimate = scene_of("a", 64)
    drawn = draw_failures([(scene, estimate)])
    assert drawn.shape == (16 + 4, 4 * (256 + 4), 3)
    picture, truth, found, error = (drawn[:16, x : x + 256] for x in (0, 260, 520, 780))
    assert np.array_equal(picture, scene.pair.left)
    assert np.array_equal(truth[:, :192], found[:, :192])
    assert not np.array_equal(truth[:, 192:], found[:, 192:])
    # 6 of 8 px.
    assert (error[:, :192] == 0).all()
    assert (error[:, 192:] == 191).all()
