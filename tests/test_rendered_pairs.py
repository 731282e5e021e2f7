from dataclasses import replace

import numpy as np
import pytest

from stereoweave.synth.effects import PLAIN
from stereoweave.synth.raycast import Raycaster
from stereoweave.synth.samples import Order, rendered, staged

ORDER = Order(scene="pylon", seed=3, size_px=(160, 120))


@pytest.fixture(scope="module")
def camera():
    return Raycaster(PLAIN)


@pytest.fixture(scope="module")
def with_a_view(camera):
    return rendered(camera, replace(ORDER, views=(0.5,)), 1)


def test_a_pair_depends_on_its_seed_scene_and_index_alone(camera, with_a_view):
    again = rendered(camera, ORDER, 1).sample
    for name in ("left", "right", "disparity_px", "right_disparity_px", "occluded", "right_occluded"):
        np.testing.assert_array_equal(getattr(again, name), getattr(with_a_view.sample, name), err_msg=name)
    others = [rendered(camera, ORDER, 2), rendered(camera, replace(ORDER, seed=4), 1)]
    assert not any(np.array_equal(other.sample.left, again.left) for other in others)
    assert len({again.camera, *(other.sample.camera for other in others)}) == 3


def test_the_sky_has_disparity_zero_and_infinite_depth(with_a_view):
    sky = np.isinf(with_a_view.depth_m)
    assert 0.05 < sky.mean() < 0.95
    np.testing.assert_array_equal(with_a_view.sample.disparity_px == 0, sky)


def test_depth_is_the_cameras_depth_of_the_disparity(with_a_view):
    sample = with_a_view.sample
    np.testing.assert_allclose(
        sample.camera.depth_m(sample.disparity_px), with_a_view.depth_m, rtol=1e-5, atol=0
    )


def test_a_view_half_way_sees_each_visible_pixel_half_its_disparity_to_the_left(with_a_view):
    ((position, view),) = with_a_view.views
    assert position == 0.5
    halves_px = with_a_view.sample.disparity_px / 2
    rows, columns = np.nonzero(halves_px > 0)
    matches = columns - halves_px[rows, columns]
    inside = matches > 0
    rows, columns, matches = rows[inside], columns[inside], matches[inside]
    low = np.floor(matches).astype(int)
    around_m = np.stack([view.depth_m[rows, low], view.depth_m[rows, np.minimum(low + 1, 159)]])
    depth_m = with_a_view.depth_m[rows, columns]
    # Smooth ground is between its neighbours; what else there is hides it.
    known = np.isfinite(around_m).all(0)
    agree = np.abs(around_m.mean(0) - depth_m)[known] < 0.03 * depth_m[known]
    nearer = around_m.min(0)[known] < depth_m[known]
    assert agree.mean() > 0.8
    assert (agree | nearer).mean() > 0.97


def test_a_film_shows_one_world_through_one_camera_that_moves_a_little_from_frame_to_frame(camera):
    film = replace(ORDER, frames=8)
    stages, rigs = zip(*(staged(camera, film, 2, frame) for frame in range(8)), strict=True)
    np.testing.assert_array_equal(stages[0].world.mesh.corners_m, stages[7].world.mesh.corners_m)
    assert len({rig.camera for rig in rigs}) == 1
    steps_m = np.linalg.norm(np.diff([rig.position_m for rig in rigs], axis=0), axis=1)
    assert 0 < steps_m.max() < 0.25 * steps_m.sum()
    assert rendered(camera, film, 17).sample.camera == rigs[1].camera
