import numpy as np
import pytest

from stereoweave.synth.scenes.propeller import propeller
from stereoweave.synth.textures import FAMILIES

SEEDS = (0, 1, 3, 4)  # five, four, three and six blades; the last in a park


@pytest.fixture(scope="module")
def stages():
    return [propeller(np.random.default_rng(seed)) for seed in SEEDS]


def test_it_has_triangles_and_materials_enough_and_no_more_than_a_renderer_takes(stages):
    for stage in stages:
        assert 20_000 <= len(stage.world.mesh.material) <= 70_000
        assert 6 <= len(stage.world.materials) <= 64
        assert len(stage.world.lamps) <= 4


def test_every_material_is_known_and_its_texture_in_the_bank(stages):
    for stage in stages:
        used = np.unique(stage.world.mesh.material)
        assert used[0] >= 0
        assert used[-1] < len(stage.world.materials)
        assert {material.texture for material in stage.world.materials} <= set(FAMILIES)


def test_the_target_is_the_screw_alone_within_its_circle(stages):
    for stage in stages:
        mesh = stage.world.mesh
        screw = mesh.corners_m[mesh.target]
        assert 9_000 < mesh.target.sum() < 20_000
        assert 2.2 < np.linalg.norm(screw[..., 1:], axis=-1).max() < 2.85
        assert np.abs(screw[..., 0]).max() < 2.0


def test_all_corners_are_finite_and_all_normals_unit_vectors(stages):
    for stage in stages:
        assert np.isfinite(stage.world.mesh.corners_m).all()
        assert np.isfinite(stage.world.mesh.uv_m).all()
        np.testing.assert_allclose(np.linalg.norm(stage.world.mesh.normals, axis=-1), 1, atol=1e-4)


def test_faces_look_outwards(stages):
    for stage in stages:
        a, b, c = stage.world.mesh.corners_m.astype(float).swapaxes(0, 1)
        agree = (np.cross(b - a, c - a)[:, None] * stage.world.mesh.normals).sum(-1) > 0
        assert agree.mean() > 0.99


def test_the_cameras_stay_abaft_the_screw_above_the_floor_and_clear_of_everything(stages):
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


def test_the_seed_decides_everything(stages):
    again = propeller(np.random.default_rng(0))
    for name in ("corners_m", "normals", "uv_m", "material", "target"):
        np.testing.assert_array_equal(getattr(stages[0].world.mesh, name), getattr(again.world.mesh, name))
    assert again.world.materials == stages[0].world.materials
    assert again.world.sky == stages[0].world.sky
    assert again.orbit == stages[0].orbit
    for one, other in zip(stages[:-1], stages[1:], strict=True):
        assert (
            one.world.mesh.corners_m.shape != other.world.mesh.corners_m.shape
            or (one.world.mesh.corners_m != other.world.mesh.corners_m).any()
        )


def test_screws_differ_in_blades_and_places(stages):
    assert len({int(stage.world.mesh.target.sum()) for stage in stages}) == 4
    lit = {bool(stage.world.lamps) for stage in stages}
    grown = {any(material.texture == "grass" for material in stage.world.materials) for stage in stages}
    assert lit == grown == {True, False}
