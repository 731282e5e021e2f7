from dataclasses import replace

import numpy as np
import pytest
from second_casts import from_the_other_eye

from stereoweave.data.samples import make_sample
from stereoweave.stereo import StereoPair
from stereoweave.synth.rendering.effects import PLAIN
from stereoweave.synth.rendering.raycast import Raycaster
from stereoweave.synth.sets.pair_rendering import RenderSpec, draw_stage_and_rig, render_pair

SPEC = RenderSpec(scene="pylon", seed=3, size_px=(160, 120))
BLACK = np.zeros((240, 320, 3), np.uint8)


@pytest.fixture(scope="module")
def camera():
    return Raycaster(PLAIN)


@pytest.fixture(scope="module")
def with_a_view(camera):
    return render_pair(camera, replace(SPEC, views=(0.5,)), 1)


def test_a_pair_depends_only_on_its_seed_scene_and_index(camera, with_a_view):
    again = render_pair(camera, SPEC, 1).sample
    for name in ("left", "right", "disparity_px", "right_disparity_px", "occluded", "right_occluded"):
        np.testing.assert_array_equal(getattr(again, name), getattr(with_a_view.sample, name), err_msg=name)
    others = [render_pair(camera, SPEC, 2), render_pair(camera, replace(SPEC, seed=4), 1)]
    assert not any(np.array_equal(other.sample.left, again.left) for other in others)
    assert len({again.camera, *(other.sample.camera for other in others)}) == 3


def test_disparity_follows_from_the_rendered_depth_and_is_zero_in_the_sky(camera, with_a_view):
    stage, rig = draw_stage_and_rig(camera, SPEC, 1)
    for position, disparity_px in enumerate(
        (with_a_view.sample.disparity_px, with_a_view.sample.right_disparity_px)
    ):
        depth_m = camera.depth_m(stage.world, rig, position)
        assert 0.05 < np.isinf(depth_m).mean() < 0.95
        np.testing.assert_allclose(
            disparity_px, rig.camera.focal_px * rig.camera.baseline_m / depth_m, rtol=1e-6, atol=0
        )


@pytest.mark.parametrize("scene", ["refinery", "antenna", "pylon", "rooms"])
def test_occlusion_masks_agree_with_rays_cast_from_the_other_camera(camera, scene):
    """Masks compare disparities only at whole columns, so up to 1 % of the pixels may be missed or extra."""
    spec = RenderSpec(scene=scene, size_px=(320, 240))
    stage, rig = draw_stage_and_rig(camera, spec, 0)
    left_px, right_px = (
        rig.camera.disparity_px(camera.depth_m(stage.world, rig, position)) for position in (0, 1)
    )
    sample = make_sample(StereoPair(left=BLACK, right=BLACK), left_px, right_px)
    for position, disparity_px, found in (
        (0, left_px, sample.occluded),
        (1, right_px, sample.right_occluded),
    ):
        there_px, _ = from_the_other_eye(stage.world, rig, disparity_px, position)
        hidden = np.isnan(there_px) | (there_px > disparity_px + 0.5)
        assert hidden.mean() > 0.04
        assert (hidden & ~found).mean() < 0.01
        assert (found & ~hidden).mean() < 0.007


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
    depth_m = with_a_view.sample.camera.depth_m(with_a_view.sample.disparity_px)[rows, columns]
    # Smooth ground lies between the depths of its neighbours; anything else covers it.
    known = np.isfinite(around_m).all(0)
    agree = np.abs(around_m.mean(0) - depth_m)[known] < 0.03 * depth_m[known]
    nearer = around_m.min(0)[known] < depth_m[known]
    assert agree.mean() > 0.8
    assert (agree | nearer).mean() > 0.97


def test_a_video_shows_one_world_through_one_camera_that_moves_a_little_between_frames(camera):
    film = replace(SPEC, frames=8)
    stages, rigs = zip(*(draw_stage_and_rig(camera, film, 2, frame) for frame in range(8)), strict=True)
    np.testing.assert_array_equal(stages[0].world.mesh.corners_m, stages[7].world.mesh.corners_m)
    assert len({rig.camera for rig in rigs}) == 1
    steps_m = np.linalg.norm(np.diff([rig.position_m for rig in rigs], axis=0), axis=1)
    assert 0 < steps_m.max() < 0.25 * steps_m.sum()
    assert render_pair(camera, film, 17).sample.camera == rigs[1].camera
