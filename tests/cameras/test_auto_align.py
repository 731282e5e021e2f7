"""Automatic alignment: what is changed, what is left, and how close the rows end."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from camera_examples import Taken, take, turn

from experiments.handheld.warps import rolling_shutter, wide_lens
from stereoweave.cameras.alignment import check_pair
from stereoweave.cameras.auto_align import align
from stereoweave.cameras.rectify_uncalibrated import fit_warps
from stereoweave.io.images import read_pair
from stereoweave.learn.data.collage import paint_collage
from stereoweave.stereo import StereoCamera, StereoPair

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SIZE = (640, 480)


@pytest.fixture(scope="module")
def example():
    """Return a rendered pair, rectified."""
    return read_pair(EXAMPLES / "left.png", EXAMPLES / "right.png")


@pytest.fixture(scope="module")
def painted():
    """Return a painted pair, with places of the same points where both cameras see them."""
    sample = paint_collage(77, 0, 2, SIZE[1], SIZE[0])
    rows, columns = (grid.ravel() for grid in np.mgrid[8 : SIZE[1] : 16, 8 : SIZE[0] : 16])
    disparity_px = sample.disparity_px[rows, columns]
    known = np.isfinite(disparity_px) & ~sample.occluded[rows, columns]
    left_px = np.column_stack([columns, rows])[known].astype(float)
    right_px = left_px - np.column_stack([disparity_px[known], np.zeros(known.sum())])
    return Taken(StereoPair(left=sample.left, right=sample.right), left_px, right_px)


def lowered(source, down_px):
    """Return the mapping of a camera whose principal point is higher by this."""
    return lambda places_px: source(places_px + [0, down_px])


def distances_m(camera, left_px, right_px):
    """Return the distances of points from the left camera."""
    depth_m = camera.depth_m((left_px - right_px)[:, :1])[:, 0]
    return depth_m * np.hypot(
        1, np.linalg.norm(left_px - [camera.cx_px, camera.cy_px], axis=1) / camera.focal_px
    )


def vertical_errors_px(taken):
    """Return the vertical errors at the true places before and after the fit."""
    warps = fit_warps(taken.pair).warps
    after_px = warps.left.transform(taken.left_px) - warps.right.transform(taken.right_px)
    return np.abs(taken.left_px - taken.right_px)[:, 1], np.abs(after_px)[:, 1]


@pytest.mark.parametrize("strength", [0.15, 0.3])
def test_the_distortion_of_wide_lenses_is_removed(painted, strength):
    lens, right_turn = wide_lens(SIZE, strength), turn(SIZE, (1, -1, 2))
    before_px, after_px = vertical_errors_px(
        take(painted, lens, lambda places_px: right_turn(lens(places_px)))
    )
    assert np.median(before_px) > 5
    assert np.median(after_px) < 0.3


def test_rows_bent_by_a_rolling_shutter_are_aligned(painted):
    sway, level = rolling_shutter(SIZE, 4), turn(SIZE, (0, 0, 0))
    before_px, after_px = vertical_errors_px(take(painted, level, sway))
    assert np.median(before_px) > 2
    assert np.median(after_px) < 0.4


def test_a_larger_right_picture_is_scaled_and_not_cut(painted):
    taken = take(painted, turn(SIZE, (0, 0, 0)), turn(SIZE, (0, 0, 0), scale=1.03))
    assert check_pair(taken.pair.left, taken.pair.right).defects == ("scale",)
    aligned = align(taken.pair)
    assert aligned.alignment.is_rectified
    assert aligned.pair.left_seen.mean() > 0.97
    assert aligned.pair.right_seen.mean() > 0.9


@pytest.mark.parametrize(
    ("left", "right"),
    [
        (turn(SIZE, (0.5, 0, -0.5)), turn(SIZE, (-0.5, 0, 1))),
        (turn(SIZE, (0, 0, 0)), lowered(turn(SIZE, (0, 0, 1)), 8)),
        (turn(SIZE, (3, 3, 3)), turn(SIZE, (3, 3, 3))),
        (turn(SIZE, (0, 0, 0)), turn(SIZE, (0, 0, 1), scale=1.02)),
    ],
    ids=["turned", "lowered", "baseline", "scaled"],
)
def test_a_pair_of_a_known_camera_keeps_metres(painted, left, right):
    camera = StereoCamera.centred(painted.pair.left, focal_px=640, baseline_m=0.1)
    taken = take(painted, left, right)
    aligned = align(replace(taken.pair, camera=camera))
    assert aligned.alignment.is_rectified
    ends_px = aligned.warps.left.transform(taken.left_px), aligned.warps.right.transform(taken.right_px)
    found_m = distances_m(aligned.pair.camera, *ends_px)
    # An error of 0.2 px is 1 % at a disparity of 20 px.
    near = (painted.left_px - painted.right_px)[:, 0] > 20
    ratio = (found_m / distances_m(camera, painted.left_px, painted.right_px))[near]
    assert abs(np.median(ratio) - 1) < 0.01
    assert np.percentile(np.abs(ratio - 1), 90) < 0.03


def test_cameras_turned_towards_each_other_lose_metres(painted):
    camera = StereoCamera.centred(painted.pair.left, focal_px=640, baseline_m=0.1)
    taken = take(painted, turn(SIZE, (0, 1, 0)), turn(SIZE, (0, -1, 1)))
    aligned = align(replace(taken.pair, camera=camera))
    assert aligned.alignment.is_rectified
    assert aligned.pair.camera is None


@pytest.mark.parametrize(
    ("left", "right"),
    [
        (turn(SIZE, (0, 0, 0)), rolling_shutter(SIZE, 4)),
        (turn(SIZE, (0, 1, 0)), turn(SIZE, (0, -1, 1))),
    ],
    ids=["rolling shutter", "turned"],
)
def test_cameras_that_are_stated_to_be_parallel_keep_every_disparity(painted, left, right):
    camera = StereoCamera.centred(painted.pair.left, focal_px=640, baseline_m=0.1)
    taken = take(painted, left, right)
    aligned = align(replace(taken.pair, camera=camera), parallel=True)
    assert aligned.alignment.is_rectified
    assert aligned.pair.camera == camera
    left_px, right_px = (
        warp.transform(places_px)
        for warp, places_px in zip(aligned.warps, (taken.left_px, taken.right_px), strict=True)
    )
    np.testing.assert_allclose(left_px, taken.left_px, atol=1e-6)
    np.testing.assert_allclose(right_px[:, 0], taken.right_px[:, 0], atol=1e-6)
    assert [str(note).partition("; ")[2] for note in aligned.notes] == [
        "rows were bent; the pictures can also be kept as they are (no_rectify)"
    ]


def test_a_sound_pair_stays_as_it_is(example):
    aligned = align(example)
    assert aligned.pair is example
    assert aligned.notes == ()


def test_swapped_sides_are_swapped_back(example):
    aligned = align(StereoPair(left=example.right, right=example.left))
    np.testing.assert_array_equal(aligned.pair.left, example.left)
    np.testing.assert_array_equal(aligned.pair.right, example.right)
    assert [note.text for note in aligned.notes] == [
        "left and right were swapped, and have been swapped back"
    ]


def test_swapped_sides_of_a_turned_pair_are_swapped_back(painted):
    taken = take(painted, turn(SIZE, (0, 0, 2)), turn(SIZE, (1, 1, -1)))
    aligned = align(StereoPair(left=taken.pair.right, right=taken.pair.left))
    assert aligned.alignment.is_rectified
    assert "swapped" in aligned.notes[0].text
    assert aligned.alignment.range_px[1] > 20


def test_a_lower_picture_is_moved_up(example):
    left, right = (np.ascontiguousarray(image) for image in (example.left[20:], example.right[:-20]))
    aligned = align(StereoPair(left=left, right=right))
    assert aligned.alignment.defects == ()
    assert "px before)" in aligned.notes[0].text
    assert aligned.alignment.vertical_error_px < 0.2


def test_plain_pictures_stay_as_they_are():
    plain = StereoPair(left=np.full((100, 200, 3), 90, np.uint8), right=np.full((100, 200, 3), 90, np.uint8))
    assert align(plain).pair is plain


def test_a_pair_that_cannot_be_rectified_stays_as_it_is_and_is_told_why(example):
    zoomed = take(
        Taken(example, np.zeros((1, 2)), np.zeros((1, 2))), turn(SIZE, (0, 0, 0)), turn(SIZE, (0, 0, 0), 1.12)
    )
    aligned = align(zoomed.pair)
    assert aligned.pair is zoomed.pair
    assert aligned.notes[0].text.startswith("the pair could not be rectified: expected ")
