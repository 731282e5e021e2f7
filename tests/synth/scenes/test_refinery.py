import functools

import numpy as np
import pytest

from stereoweave.synth.props.pipework import pipes
from stereoweave.synth.props.refinery_units import RefineryMaterials
from stereoweave.synth.scenes.refinery import UNITS, refinery

COATS = RefineryMaterials(shells=(0, 1, 2), steel=3, rail=4, red=5, white=6, concrete=7, sign=8, flame=9)


@functools.cache
def draw_stage_and_rig(seed):
    return refinery(np.random.default_rng(seed))


@pytest.mark.parametrize("seed", range(3))
def test_the_target_is_the_plant_and_all_cameras_are_outside_it(seed):
    stage = draw_stage_and_rig(seed)
    mesh = stage.world.mesh
    target_m = mesh.corners_m[mesh.target].reshape(-1, 3)
    assert np.linalg.norm(target_m[:, :2], axis=1).max() < stage.orbit.distance_m[0] * np.cos(np.radians(24))
    assert 3.5 < target_m[:, 2].max() < 7
    assert 0.3 < mesh.target.mean() < 0.95


@pytest.mark.parametrize("name", UNITS)
def test_every_unit_and_its_nozzles_stay_within_its_plot(name):
    for seed in range(4):
        unit = UNITS[name](np.random.default_rng(seed), COATS)
        reach_m = np.linalg.norm(unit.mesh.corners_m[..., :2], axis=-1).max()
        assert reach_m < 1.05
        assert unit.mesh.corners_m[..., 2].min() > -0.05
        assert np.linalg.norm(unit.nozzles_m[:, :2], axis=1).max() < reach_m
        assert set(np.unique(unit.mesh.material)) <= set(range(10))


def test_pipes_follow_their_paths():
    path_m = np.array([[0.0, 0, 0], [0, 0, 1], [2, 0, 1]])
    mesh = pipes([path_m], [0.05], 3)
    # The flanges have 1.6 times the pipe's radius, and the elbow has 1.15 times the radius.
    np.testing.assert_allclose(mesh.corners_m.min((0, 1)), [-0.08, -0.08, 0], atol=0.002)
    np.testing.assert_allclose(mesh.corners_m.max((0, 1)), [2, 0.08, 1.08], atol=0.002)
    assert set(mesh.material) == {3}
