"""Tests of every scene: enough parts, valid meshes, and stages that depend only on their seed."""

from dataclasses import fields

import numpy as np
import pytest

from stereoweave.synth.scenes import SCENES
from stereoweave.synth.textures.bank import FAMILIES
from stereoweave.synth.world import Mesh

# Together, these seeds give most kinds of each scene.
SEEDS = range(5)


@pytest.fixture(scope="module", params=SCENES)
def stages(request):
    return [SCENES[request.param](np.random.default_rng(seed)) for seed in SEEDS]


def test_there_are_enough_triangles_and_materials_but_no_more_than_a_renderer_accepts(stages):
    for stage in stages:
        assert 20_000 <= len(stage.world.mesh.material) <= 90_000
        assert 0 < stage.world.mesh.target.sum() < len(stage.world.mesh.material)
        assert len(np.unique(stage.world.mesh.material)) >= 6
        assert len(stage.world.materials) <= 64
        assert len(stage.world.lamps) <= 4


def test_every_material_exists_and_its_texture_is_in_the_bank(stages):
    for stage in stages:
        assert set(np.unique(stage.world.mesh.material)) <= set(range(len(stage.world.materials)))
        assert {material.texture for material in stage.world.materials} <= set(FAMILIES)


def test_all_corners_are_finite_and_all_normals_unit_vectors(stages):
    for stage in stages:
        assert np.isfinite(stage.world.mesh.corners_m).all()
        assert np.isfinite(stage.world.mesh.uv_m).all()
        np.testing.assert_allclose(np.linalg.norm(stage.world.mesh.normals, axis=-1), 1, atol=1e-4)


def test_faces_and_their_normals_point_to_the_same_side(stages):
    for stage in stages:
        a, b, c = stage.world.mesh.corners_m.astype(float).swapaxes(0, 1)
        agree = (np.cross(b - a, c - a)[:, None] * stage.world.mesh.normals).sum(-1) > 0
        assert agree.mean() > 0.99


@pytest.mark.parametrize("name", SCENES)
def test_a_seed_always_gives_the_same_stage_and_another_seed_a_different_one(name):
    first, again, other = (SCENES[name](np.random.default_rng(seed)) for seed in (1, 1, 2))
    for field in fields(Mesh):
        np.testing.assert_array_equal(
            getattr(first.world.mesh, field.name), getattr(again.world.mesh, field.name)
        )
    assert (first.world.materials, first.world.sky) == (again.world.materials, again.world.sky)
    assert first.orbit == again.orbit
    assert first.world.sky != other.world.sky
    assert not np.array_equal(first.world.mesh.corners_m, other.world.mesh.corners_m)
