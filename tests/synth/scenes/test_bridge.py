import functools

import numpy as np
import pytest

from stereoweave.stereo import StereoCamera
from stereoweave.synth.props.bridges import abutments, beams, draw_bridge_plan
from stereoweave.synth.scenes.bridge import KINDS, bridge
from stereoweave.synth.stage import Palette
from stereoweave.synth.viewpoints import draw_viewpoint, place_rig


@functools.cache
def draw_stage_and_rig(seed):
    return bridge(np.random.default_rng(seed))


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_spans_the_river_within_its_bounds(kind):
    rng, palette = np.random.default_rng(5), Palette()
    plan = draw_bridge_plan(rng, palette)
    mesh = KINDS[kind](rng, palette, plan)
    low_m, high_m = mesh.corners_m.min((0, 1)), mesh.corners_m.max((0, 1))
    assert low_m[0] < -0.99 * plan.half_m
    assert high_m[0] > 0.99 * plan.half_m
    assert np.abs(mesh.corners_m[..., 0]).max() < plan.half_m + 1.0
    assert np.abs(mesh.corners_m[..., 1]).max() < 1.4
    assert plan.level_m < high_m[2] < plan.level_m + 4.5
    assert len(np.unique(mesh.material)) >= 2


@pytest.mark.parametrize("seed", range(3))
def test_the_target_is_about_ten_metres_wide_and_the_cameras_are_clear_of_everything(seed):
    rng, stage = np.random.default_rng(seed), draw_stage_and_rig(seed)
    mesh = stage.world.mesh
    target_m = mesh.corners_m[mesh.target].reshape(-1, 3)
    assert 8 < np.ptp(target_m[:, 0]) < 12
    assert np.ptp(target_m[:, 1]) < 2.8
    camera = StereoCamera(focal_px=600, baseline_m=0.1, cx_px=319.5, cy_px=239.5)
    points_m = mesh.corners_m.reshape(-1, 3)
    for _ in range(20):
        eye_m = place_rig(stage.orbit, draw_viewpoint(rng, stage.orbit), camera, (640, 480)).position_m
        below_m = points_m[np.linalg.norm(points_m[:, :2] - eye_m[:2], axis=1) < 0.5]
        assert (below_m[:, 2] < eye_m[2]).all()


def test_a_beam_lies_between_its_given_ends():
    beam = beams([[1.0, 0, 2]], [[4.0, 0, 2]], (0.2, 0.4), 7)
    np.testing.assert_allclose(beam.corners_m.min((0, 1)), [1, -0.1, 1.8], atol=1e-6)
    np.testing.assert_allclose(beam.corners_m.max((0, 1)), [4, 0.1, 2.2], atol=1e-6)
    upright = beams([[0.0, 0, 0]], [[0.0, 0, 3]], (0.2, 0.4), 7)
    assert np.ptp(upright.corners_m[..., 2]) == pytest.approx(3)


def test_the_abutments_carry_the_road_at_both_ends():
    plan = draw_bridge_plan(np.random.default_rng(0), Palette())
    corners_m = abutments(plan).corners_m
    for side in (-1, 1):
        end_m = corners_m[side * corners_m[..., 0] > 0]
        assert end_m[:, 2].max() >= plan.level_m - 0.12
        assert end_m[:, 2].min() < -0.5
