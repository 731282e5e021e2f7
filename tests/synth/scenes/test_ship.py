import numpy as np
import pytest

from stereoweave.synth.scenes.ship import ship

SEEDS = (0, 1, 4, 7, 11)  # a tug, a trawler, a coaster and two patrol boats; three of them are at a quay


@pytest.fixture(scope="module")
def stages():
    return [ship(np.random.default_rng(seed)) for seed in SEEDS]


def test_the_target_is_the_ship_within_a_sphere_around_the_orbit_s_centre(stages):
    for stage in stages:
        mesh = stage.world.mesh
        vessel = mesh.corners_m[mesh.target]
        assert np.linalg.norm(vessel - stage.orbit.centre_m, axis=-1).max() < 5.5
        assert 6.5 < np.ptp(vessel[..., 0]) < 9.8
        assert 15_000 < mesh.target.sum() < 35_000


def test_the_ship_floats(stages):
    for stage in stages:
        mesh = stage.world.mesh
        z = mesh.corners_m[mesh.target][..., 2]
        assert -1.2 < z.min() < -0.5
        assert z.max() > 2.2
        water = [k for k, material in enumerate(stage.world.materials) if material.texture == "water"]
        assert len(water) == 1
        assert abs(mesh.corners_m[mesh.material == water[0]][..., 2].mean()) < 0.05


def test_no_part_of_a_ship_is_below_the_hull(stages):
    for stage in stages:
        mesh = stage.world.mesh
        vessel = mesh.corners_m[mesh.target]
        bottom = mesh.material[mesh.target] == 0  # the first material is the paint below the waterline
        deepest_m = vessel[bottom][..., 2].min()
        assert vessel[~bottom][..., 2].min() > deepest_m + 0.3


def test_the_cameras_are_clear_of_everything_and_never_on_the_quay(stages):
    for stage in stages:
        orbit, corners_m = stage.orbit, stage.world.mesh.corners_m.reshape(-1, 3)
        moored = orbit.azimuth_deg != (0.0, 360.0)
        for azimuth in np.radians(np.linspace(*orbit.azimuth_deg, 5)):
            for elevation in np.radians(orbit.elevation_deg):
                way = [
                    np.cos(azimuth) * np.cos(elevation),
                    np.sin(azimuth) * np.cos(elevation),
                    np.sin(elevation),
                ]
                eye_m = np.array(orbit.centre_m) + orbit.distance_m[0] * np.array(way)
                assert eye_m[1] > 2 or not moored
                assert np.linalg.norm(corners_m - eye_m, axis=1).min() > 0.7


def test_ships_are_at_quays_and_on_open_water(stages):
    assert {stage.orbit.azimuth_deg for stage in stages} == {(0.0, 360.0), (22.0, 158.0)}
