"""Motion of the camera from corners, and points moved by it."""

import cv2
import numpy as np
import pytest
from plain_moving_points import plain_fill_cracks, plain_find_places, plain_splat

from stereoweave.stereo import Estimate
from stereoweave.video.camera_motion import find_camera_motion, find_corners
from stereoweave.video.motion import halve, measure_motion
from stereoweave.video.moved_points import move_points
from stereoweave.video.splat_kernels import NOWHERE_PX, fill_cracks, find_places, splat
from stereoweave.video.temporal_filter import TemporalFilter
from stereoweave.video.temporal_kernels import Track

HEIGHT, WIDTH = 192, 256
NEAR_PX, FAR_PX = 30, 10


def texture(rng, height=HEIGHT, width=WIDTH):
    grey = cv2.GaussianBlur(rng.uniform(0, 255, (height, width)), (0, 0), 1.5)
    return np.clip(128 + 4 * (grey - 128), 0, 255).astype(np.uint8)


def begin_track(disparity_px):
    confidence, frames, rival_px, rival_frames = np.zeros((4, *disparity_px.shape), np.float32)
    offset_px = np.zeros((*disparity_px.shape, 2), np.float32)
    return Track(disparity_px, confidence + 1, frames + 1, offset_px, rival_px, rival_frames)


class SteppingAside:
    """Frames of a camera that steps aside by a tenth of the baseline, in front of a square and a wall.

    The square has a disparity of 30 px and moves by 3 px a frame to the left, the wall by 1 px.
    """

    def __init__(self, rng):
        self._wall, self._square = texture(rng, width=WIDTH + 100), texture(rng, 96, 96)

    def frame(self, number):
        """Return the left and right grey images and the disparities of both."""
        greys, maps = [], []
        for position in (0, 1):
            start = 20 + number + position * FAR_PX
            grey, disparity_px = self._wall[:, start : start + WIDTH].copy(), np.full((HEIGHT, WIDTH), FAR_PX)
            column = 110 - 3 * number - position * NEAR_PX
            square = np.s_[48:144, column : column + 96]
            grey[square], disparity_px[square] = self._square, NEAR_PX
            greys.append(grey)
            maps.append(disparity_px.astype(np.float32))
        return *greys, *maps


@pytest.fixture
def video(rng):
    return SteppingAside(rng)


def find_motion(video, first, second):
    before, _, disparity_px, _ = video.frame(first)
    return find_camera_motion(find_corners(halve(before), disparity_px), halve(video.frame(second)[0]))


def place(matrix, x, y, d):
    moved = matrix @ [x, y, 1, d]
    return moved[:2] / moved[2]


def test_a_camera_that_steps_aside_moves_points_by_their_disparity(video):
    matrix = find_motion(video, 0, 2)
    np.testing.assert_allclose(place(matrix, 150, 90, NEAR_PX), [144, 90], atol=0.15)
    np.testing.assert_allclose(place(matrix, 40, 40, FAR_PX), [38, 40], atol=0.15)
    np.testing.assert_allclose(place(matrix, 100, 40, 20), [96, 40], atol=0.25)  # nothing is there


def test_the_inverse_of_a_motion_leads_back(video):
    there, back = find_motion(video, 0, 2), find_motion(video, 2, 0)
    np.testing.assert_allclose(place(back @ there, 120, 100, NEAR_PX), [120, 100], atol=0.3)


def test_a_flash_hides_no_motion(video):
    before, _, disparity_px, _ = video.frame(0)
    flash = cv2.convertScaleAbs(video.frame(2)[0], alpha=1.5)
    matrix = find_camera_motion(find_corners(halve(before), disparity_px), halve(flash))
    np.testing.assert_allclose(place(matrix, 150, 90, NEAR_PX), [144, 90], atol=0.3)


def test_a_camera_at_rest_and_one_that_shows_something_else_have_no_motion(rng, video):
    assert find_motion(video, 1, 1) is None
    before, _, disparity_px, _ = video.frame(0)
    assert find_camera_motion(find_corners(halve(before), disparity_px), halve(texture(rng))) is None


@pytest.mark.parametrize("shown", [np.zeros((40, 60), np.uint8), np.full((8, 7), 200, np.uint8)])
def test_an_image_without_corners_has_no_motion(shown):
    disparity_px = np.zeros((2 * shown.shape[0], 2 * shown.shape[1]), np.float32)
    assert find_camera_motion(find_corners(shown, disparity_px), shown) is None


@pytest.mark.parametrize("right", [False, True])
def test_points_of_both_views_move_with_the_camera_and_nearer_ones_hide_others(video, right):
    matrix = find_motion(video, 0, 2)
    truth_px, there_px = video.frame(0)[2 + right], video.frame(2)[2 + right]
    source, _, path = move_points(matrix, begin_track(truth_px), right)
    shown = source >= 0
    assert (truth_px.ravel()[source[shown]] != there_px[shown]).mean() < 0.005
    # Behind the square, 4 px of the wall come to light, and 2 px at the right border.
    assert (~shown).sum() == pytest.approx(4 * 96 + 2 * HEIGHT, rel=0.1)
    np.testing.assert_allclose(np.median(path.to_before_px[path.known], axis=0), [2, 0], atol=0.15)


def test_points_do_not_stand_still_while_the_camera_moves_by_less_than_half_a_pixel():
    matrix, track = np.eye(4), begin_track(np.full((4, 20), 5, np.float32))
    matrix[0, 2] = 0.4
    track.disparity_px[:, 10:] = 50
    for _ in range(5):
        source, offset_px, _ = move_points(matrix, track, False)
        moved_px = np.where(source >= 0, track.disparity_px.ravel()[source], 5)
        track = begin_track(moved_px.astype(np.float32))._replace(offset_px=offset_px)
    # 5 * 0.4 = 2 px
    assert (track.disparity_px[:, :12] == 5).all() and (track.disparity_px[:, 12:] == 50).all()


def test_only_what_moves_by_itself_is_not_calm(video, rng):
    before, _, truth_px, _ = video.frame(0)
    grey = video.frame(2)[0]
    moved = move_points(find_motion(video, 0, 2), begin_track(truth_px), False)
    motion = measure_motion(halve(before), halve(grey), moved.path)
    assert motion.calm.mean() > 0.9
    grey[150:180, 20:60] = texture(rng, 30, 40)
    motion = measure_motion(halve(before), halve(grey), moved.path)
    assert not motion.calm[76:89, 11:29].any()
    assert motion.calm[:, 40:].mean() > 0.9


def test_the_depth_of_a_pan_holds_still_where_estimates_contradict_each_other(video, rng):
    temporal_filter, errors_px, by_frame_px = TemporalFilter(1), [], []
    for number in range(8):
        left, right, *maps = video.frame(number)
        wrong = rng.random((2, HEIGHT, WIDTH)) < 0.15
        maps_px = [
            np.where(w, px + rng.uniform(5, 40, px.shape), px) for w, px in zip(wrong, maps, strict=True)
        ]
        estimate = Estimate(
            disparity_px=maps_px[0].astype(np.float32),
            right_disparity_px=maps_px[1].astype(np.float32),
            confidence=np.full((HEIGHT, WIDTH), 0.8, np.float32),
            occluded=np.zeros((HEIGHT, WIDTH), bool),
        )
        found = temporal_filter(*(np.dstack([grey] * 3) for grey in (left, right)), estimate)
        errors_px.append(np.abs(found.disparity_px - maps[0])[8:-8, 8:-8])
        by_frame_px.append(np.abs(maps_px[0] - maps[0])[8:-8, 8:-8])
    assert (errors_px[-1] > 2).mean() < 0.25 * (by_frame_px[-1] > 2).mean()


@pytest.mark.parametrize("right", [0.0, 1.0])
def test_the_kernels_equal_their_plain_versions(rng, right):
    shape = (31, 42)
    matrix = np.eye(4)
    matrix[:3] += rng.normal(0, [0.01, 0.01, 0.5, 0.05], (3, 4)) * [[1], [1], [0.02]]
    disparity_px = rng.choice([4.0, 4.5, 9.0, 20.0], shape).astype(np.float32)
    offset_px = rng.uniform(-0.5, 0.5, (*shape, 2)).astype(np.float32)
    nearest_px, source = np.empty(shape, np.float32), np.empty(shape, np.int32)
    offsets_px = np.empty((*shape, 2), np.float32)
    splat(matrix, right, disparity_px, offset_px, nearest_px, source, offsets_px)
    expected = plain_splat(matrix, right, disparity_px, offset_px)
    for _ in range(2):
        np.testing.assert_array_equal(source, expected[1])
        np.testing.assert_allclose(nearest_px, expected[0], atol=1e-4)
        np.testing.assert_allclose(offsets_px, expected[2], atol=1e-4)
        assert (nearest_px == NOWHERE_PX).any()
        fill_cracks(nearest_px, source, offsets_px)
        plain_fill_cracks(*expected)
    to_source_px, known = np.full((16, 21, 2), np.nan, np.float32), np.empty((16, 21), bool)
    find_places(source, offset_px, offsets_px, to_source_px, known)
    expected_to_px, expected_known = plain_find_places(source, offset_px, offsets_px)
    np.testing.assert_array_equal(known, expected_known)
    np.testing.assert_allclose(to_source_px, expected_to_px, atol=1e-5)
    assert 0 < known.mean() < 1
