from dataclasses import replace

import cv2
import numpy as np
import pytest
from plain_occluded_fill import plain_fill

from stereoweave.matching.occlusion_fill import fill_occluded
from stereoweave.stereo import Estimate

WALL_PX, BOARD_PX = 4, 30


def estimate_of(disparity_px, occluded, confidence=0.5):
    disparity_px = np.asarray(disparity_px, np.float32)
    return Estimate(
        disparity_px=disparity_px,
        right_disparity_px=disparity_px[:, ::-1].copy(),
        confidence=np.full_like(disparity_px, confidence),
        occluded=occluded,
    )


@pytest.fixture
def scene():
    """Return a wall and a board (columns 50 to 89), with columns 0 to 3 and 24 to 49 occluded."""
    disparity_px = np.full((40, 120), WALL_PX, np.float32)
    disparity_px[:, 50:90] = BOARD_PX
    occluded = np.zeros((40, 120), bool)
    occluded[:, :4] = occluded[:, 24:50] = True
    disparity_px[occluded] = 11
    return estimate_of(disparity_px, occluded)


@pytest.fixture
def clutter(rng):
    """Return an estimate of random patches with many disparities, a third of them occluded."""
    disparity_px = np.repeat(np.repeat(rng.uniform(-20, 40, (12, 20)), 4, 0), 4, 1)[:45, :77]
    disparity_px += rng.uniform(-1, 1, disparity_px.shape)
    occluded = cv2.blur(rng.random((45, 77)), (7, 3)) < 0.45
    occluded[7], occluded[20, :30] = True, True
    found = estimate_of(disparity_px, occluded)
    return replace(found, confidence=rng.random((45, 77), np.float32))


def test_occluded_pixels_continue_the_farther_surface_and_the_border_the_only_one(scene):
    found = fill_occluded(scene)
    np.testing.assert_array_equal(found.disparity_px[:, :50], WALL_PX)
    np.testing.assert_array_equal(found.disparity_px[:, 50:90], BOARD_PX)


def test_disparities_behind_the_plane_of_convergence_are_farther_still(scene):
    found = fill_occluded(replace(scene, disparity_px=scene.disparity_px - 20))
    np.testing.assert_array_equal(found.disparity_px[:, :50], WALL_PX - 20)


def test_a_mix_of_two_surfaces_beside_a_run_is_not_continued(scene):
    scene.disparity_px[:, 21:24] = [2, 1, 9]
    found = fill_occluded(scene)
    np.testing.assert_array_equal(found.disparity_px[:, 24:50], WALL_PX)


def test_visible_pixels_the_mask_and_the_other_view_do_not_change(clutter):
    found = fill_occluded(clutter)
    visible = ~clutter.occluded
    for name in ("disparity_px", "confidence"):
        np.testing.assert_array_equal(getattr(found, name)[visible], getattr(clutter, name)[visible])
    for name in ("occluded", "right_disparity_px"):
        np.testing.assert_array_equal(getattr(found, name), getattr(clutter, name))


def test_a_row_without_a_visible_pixel_stays(scene):
    alone = replace(scene, occluded=np.ones_like(scene.occluded), disparity_px=scene.disparity_px * 0 + 7)
    np.testing.assert_array_equal(fill_occluded(alone).disparity_px, 7)


def test_a_disparity_far_from_the_fill_is_kept_within_the_surroundings(scene):
    # The pixels are 14 px farther than the wall. Windows in the wall above and below them are farther still.
    scene.disparity_px[15:25, 30:40] = -10
    assert (fill_occluded(scene).disparity_px[15:25, 30:40] == WALL_PX).all()
    scene.disparity_px[4:12, 20:24] = scene.disparity_px[28:36, 20:24] = -12
    found = fill_occluded(scene)
    assert (found.disparity_px[15:25, 30:40] == -10).all()
    assert (found.confidence[15:25, 30:40] == 0.5).all()


def test_filled_pixels_mix_both_confidences_unless_their_own_is_0(scene):
    scene.confidence[:, :24], scene.confidence[:, 50:] = 1, 0.25
    scene.confidence[:, 24:30] = 0
    found = fill_occluded(scene)
    np.testing.assert_array_equal(found.confidence[:, 24:30], 0)
    np.testing.assert_allclose(found.confidence[:, 30:50], 0.6 * 0.5 + 0.4 * 1, rtol=1e-6)


def test_pixels_without_content_do_not_fill_others(scene):
    # The network gives a black border of 24 columns 2 px.
    scene.disparity_px[:, 4:24] = 2
    seen = np.ones(scene.occluded.shape, bool)
    seen[:, :24] = False
    assert (fill_occluded(scene).disparity_px[:, 24:50] == 2).all()
    found = fill_occluded(scene, seen)
    assert (found.disparity_px[:, 24:50] == BOARD_PX).all()
    assert (found.disparity_px[:, 4:24] == 2).all()


@pytest.mark.parametrize("masked", [False, True])
def test_the_fill_equals_the_plain_one(clutter, rng, masked):
    seen = rng.random((45, 77)) < 0.9 if masked else np.ones((45, 77), bool)
    found = fill_occluded(clutter, seen if masked else None)
    expected_px, believed = plain_fill(clutter.disparity_px, clutter.confidence, clutter.occluded, seen)
    np.testing.assert_array_equal(found.disparity_px, expected_px)
    np.testing.assert_allclose(found.confidence, believed, rtol=1e-5)
    changed = found.disparity_px != clutter.disparity_px
    assert changed.any() and (clutter.occluded & ~changed).any()
