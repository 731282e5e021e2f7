import numpy as np
import pytest

from stereoweave.synth.scenes.propeller import propeller

SEEDS = (0, 1, 3, 4)  # propellers with five, four, three and six blades; the last one is in a park


@pytest.fixture(scope="module")
def stages():
    return [propeller(np.random.default_rng(seed)) for seed in SEEDS]


def test_the_target_is_only_the_propeller_within_its_circle(stages):
    for stage in stages:
        mesh = stage.world.mesh
        screw = mesh.corners_m[mesh.target]
        assert 9_000 < mesh.target.sum() < 20_000
        assert 2.2 < np.linalg.norm(screw[..., 1:], axis=-1).max() < 2.85
        assert np.abs(screw[..., 0]).max() < 2.0


def test_the_cameras_stay_aft_of_the_propeller_above_the_floor_and_clear_of_everything(stages):
    for stage in stages:
        orbit, corners_m = stage.orbit, stage.world.mesh.corners_m.reshape(-1, 3)
        for azimuth_deg in np.linspace(*orbit.azimuth_deg, 5):
            for distance_m in orbit.distance_m:
                for elevation_deg in orbit.elevation_deg:
                    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
                    way = [
                        np.cos(azimuth) * np.cos(elevation),
                        np.sin(azimuth) * np.cos(elevation),
                        np.sin(elevation),
                    ]
                    eye_m = np.array(orbit.centre_m) + distance_m * np.array(way)
                    eye_m[2] = max(eye_m[2], orbit.floor_m)
                    assert eye_m[0] > 2.8
                    assert np.linalg.norm(corners_m - eye_m, axis=1).min() > 0.4


def test_propellers_differ_in_blades_and_surroundings(stages):
    assert len({int(stage.world.mesh.target.sum()) for stage in stages}) == 4
    lit = {bool(stage.world.lamps) for stage in stages}
    grown = {any(material.texture == "grass" for material in stage.world.materials) for stage in stages}
    assert lit == grown == {True, False}
