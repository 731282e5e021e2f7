"""Alignment of a video's shots."""

import numpy as np
import pytest
from camera_examples import Taken, take, turn

from experiments.handheld.warps import rolling_shutter
from stereoweave.cameras.alignment import check_pair
from stereoweave.cameras.feature_matches import find_matches
from stereoweave.learn.data.collage import paint_collage
from stereoweave.stereo import StereoPair
from stereoweave.video.shot_alignment import ShotAligner

SIZE = (320, 240)


def painted(index):
    sample = paint_collage(77, 0, index, SIZE[1], SIZE[0])
    return Taken(StereoPair(left=sample.left, right=sample.right), np.zeros((1, 2)), np.zeros((1, 2)))


def turned(index, *degrees):
    return take(painted(index), turn(SIZE, (0, 0, 0)), turn(SIZE, degrees)).pair


def is_rectified(pair):
    return check_pair(pair.left, pair.right).is_rectified


@pytest.fixture(scope="module")
def shots():
    """Return the first frames of two shots, whose right pictures are turned differently."""
    return turned(2, 1, 0, 2), turned(6, -1, 1, -2)


def test_a_shot_keeps_its_rectification_until_the_next_one_begins(shots):
    aligner = ShotAligner()
    assert not any(map(is_rectified, shots))
    first = aligner(shots[0])
    assert is_rectified(first)
    np.testing.assert_array_equal(aligner(shots[0]).right, first.right)
    assert not is_rectified(aligner(shots[1]))
    aligner.begin_shot()
    assert is_rectified(aligner(shots[1]))


@pytest.mark.parametrize("sway_px", [0, 4])
def test_a_rectified_shot_keeps_its_depth_about_the_screen(shots, sway_px):
    pair = shots[0]
    if sway_px:
        pair = take(painted(2), turn(SIZE, (0, 0, 0)), rolling_shutter(SIZE, sway_px)).pair
    converged = StereoPair(left=pair.left, right=np.roll(pair.right, 30, axis=1))
    aligner = ShotAligner()
    aligned = aligner(converged)
    assert ("right_field_px" in aligner.state()) == (sway_px > 0)
    before_px, after_px = (
        np.median(find_matches(pair.left, pair.right).disparity_px) for pair in (converged, aligned)
    )
    assert before_px < -10
    assert after_px == pytest.approx(before_px, abs=1.5)
    assert is_rectified(aligned)


def test_a_shot_that_begins_plain_is_measured_at_its_first_frame_with_content(shots):
    grey = np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)
    black = StereoPair(left=grey, right=grey)
    aligner = ShotAligner()
    assert aligner(black) is black
    assert is_rectified(aligner(shots[0]))


def test_a_sound_shot_stays_as_it_is():
    pair = painted(2).pair
    assert ShotAligner()(pair) is pair


def test_a_swapped_video_is_swapped_back():
    pair = painted(2).pair
    found = ShotAligner(swapped=True)(StereoPair(left=pair.right, right=pair.left))
    np.testing.assert_array_equal(found.left, pair.left)


def test_an_aligner_remembers_that_it_has_warped_a_shot_before(shots):
    sound = painted(2).pair
    aligner = ShotAligner()
    aligner(sound)
    assert not ShotAligner.from_state(aligner.state()).has_warped
    aligner.begin_shot()
    aligner(shots[0])
    aligner.begin_shot()
    assert aligner(sound) is sound
    assert ShotAligner.from_state(aligner.state()).has_warped


@pytest.mark.parametrize("sway_px", [0, 4])
def test_a_restored_aligner_continues_the_shot(shots, sway_px):
    frame = shots[0]
    if sway_px:
        level = turn(SIZE, (0, 0, 0))
        frame = take(painted(2), level, rolling_shutter(SIZE, sway_px)).pair
    aligner = ShotAligner()
    aligner(frame)
    state = aligner.state()
    assert ("right_field_px" in state) == (sway_px > 0)
    np.testing.assert_array_equal(ShotAligner.from_state(state)(frame).right, aligner(frame).right)
