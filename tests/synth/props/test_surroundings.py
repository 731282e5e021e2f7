import numpy as np
import pytest

from stereoweave.synth.props import surroundings
from stereoweave.synth.props.surroundings import daylight, draw_spots, fence, hills, sea, terrain, trees
from stereoweave.synth.stage import Palette
from stereoweave.synth.textures.bank import FAMILIES
from stereoweave.synth.world import Mesh

SPOTS = np.array([[20.0, 0, 0], [0, 30, 0], [-40, 0, 0], [0, -50, 0], [25, 25, 0], [-30, 30, 0]])
STANDING = [
    "trees",
    "bushes",
    "houses",
    "rocks",
    "posts",
    "crates",
    "pallets",
    "barrels",
    "bollards",
    "cones",
]


def built(name: str, seed: int = 0) -> tuple[Mesh, Palette]:
    palette = Palette()
    return getattr(surroundings, name)(np.random.default_rng(seed), palette, SPOTS), palette


def facing(mesh: Mesh) -> np.ndarray:
    """Return the cosine between each normal and the outward direction that the corner order defines."""
    a, b, c = mesh.corners_m.astype(float).swapaxes(0, 1)
    across = np.cross(b - a, c - a)
    return (across[:, None] * mesh.normals).sum(-1) / np.linalg.norm(across, axis=1, keepdims=True)


@pytest.mark.parametrize("name", STANDING)
def test_objects_stand_at_each_spot_and_nowhere_else(name):
    mesh, _ = built(name)
    centres = mesh.corners_m.mean(1)[:, :2]
    distance_m = np.linalg.norm(centres[:, None] - SPOTS[None, :, :2], axis=-1)
    assert distance_m.min(1).max() < 9  # half the length of a house, plus its eaves
    assert (np.bincount(distance_m.argmin(1), minlength=len(SPOTS)) > 0).all()


@pytest.mark.parametrize("name", STANDING)
def test_feet_are_on_the_ground_or_slightly_below(name):
    mesh, _ = built(name)
    assert -1.5 < mesh.corners_m[..., 2].min() < 0.03


@pytest.mark.parametrize("name", STANDING)
def test_normals_are_unit_vectors_that_point_outwards(name):
    mesh, _ = built(name)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=-1), 1, atol=1e-5)
    assert np.mean(facing(mesh) > 0) > 0.995


@pytest.mark.parametrize("name", STANDING)
def test_materials_are_in_the_palette_and_their_textures_in_the_bank(name):
    mesh, palette = built(name)
    assert set(np.unique(mesh.material)) == set(range(len(palette.materials)))
    assert {material.texture for material in palette.materials} <= set(FAMILIES)


@pytest.mark.parametrize("name", STANDING)
def test_the_mesh_depends_on_the_seed_alone(name):
    (first, _), (again, _), (other, _) = built(name, 1), built(name, 1), built(name, 2)
    np.testing.assert_array_equal(first.corners_m, again.corners_m)
    assert first.corners_m.shape != other.corners_m.shape or (first.corners_m != other.corners_m).any()


@pytest.mark.parametrize("name", STANDING)
def test_an_empty_list_of_spots_gives_an_empty_mesh(name):
    nothing = getattr(surroundings, name)(np.random.default_rng(0), Palette(), np.zeros((0, 3)))
    assert len(nothing.material) == 0


def test_trees_have_the_requested_height():
    mesh = trees(np.random.default_rng(3), Palette(), SPOTS, (5, 6))
    nearest = np.linalg.norm(mesh.corners_m.mean(1)[:, None, :2] - SPOTS[None, :, :2], axis=-1).argmin(1)
    tops_m = [mesh.corners_m[nearest == k, :, 2].max() for k in range(len(SPOTS))]
    assert min(tops_m) > 4.2
    assert max(tops_m) < 6.6


def test_spots_are_spread_evenly_over_a_ring():
    spots = draw_spots(np.random.default_rng(0), 400, 10, 50)
    radius_m = np.linalg.norm(spots[:, :2], axis=1)
    assert not spots[:, 2].any()
    assert radius_m.min() >= 10
    assert radius_m.max() <= 50
    # Half the area of the ring from 10 to 50 m lies within sqrt((100 + 2500) / 2) = 36.06 m.
    assert np.mean(radius_m < 36.06) == pytest.approx(0.5, abs=0.01)
    quarters = np.bincount(np.digitize(np.arctan2(spots[:, 1], spots[:, 0]), [-np.pi / 2, 0, np.pi / 2]))
    assert quarters.min() > 85


def test_spots_keep_apart_and_are_not_sorted_by_distance():
    spots = draw_spots(np.random.default_rng(0), 400, 10, 50)
    apart = np.linalg.norm(spots[:, None] - spots[None], axis=-1) + 1e9 * np.eye(400)
    # Each spot has pi (2500 - 100) / 400 = 18.8 m^2 to itself, as much as a square of 4.3 m.
    assert apart.min() > 1.2
    radius_m = np.linalg.norm(spots, axis=1)
    assert abs(np.corrcoef(radius_m, np.arange(400))[0, 1]) < 0.15


def test_daylight_has_a_sun_at_15_to_65_degrees_and_a_plausible_strength():
    skies = [daylight(np.random.default_rng(seed)) for seed in range(200)]
    suns = np.array([sky.sun for sky, _, _ in skies])
    np.testing.assert_allclose(np.linalg.norm(suns, axis=1), 1)
    heights_deg = np.degrees(np.arcsin(suns[:, 2]))
    assert heights_deg.min() > 15 - 1e-9
    assert heights_deg.max() < 65 + 1e-9
    assert np.ptp(np.degrees(np.arctan2(suns[:, 1], suns[:, 0]))) > 340
    for sky, fog, exposure in skies:
        assert max(sky.sun_light) < 3.2
        assert sum(sky.ground) < sum(sky.zenith) < sum(sky.horizon)
        assert sky.zenith[2] > sky.zenith[0]
        assert 0.5 < exposure < 1.5
        assert fog is None or fog.density_per_m < 0.01
    assert {fog is None for _, fog, _ in skies} == {True, False}
    assert min(max(sky.sun_light) for sky, _, _ in skies) < 0.5  # some days are overcast


@pytest.mark.parametrize("family", ["grass", "soil", "gravel", "asphalt", "concrete"])
def test_terrain_is_flat_around_the_origin_and_has_the_requested_extent(family):
    palette = Palette()
    ground = terrain(
        np.random.default_rng(0), palette, family, extent_m=80, level_m=-2, bumps_m=0.5, flat_radius_m=6
    )
    x, y, z = ground.corners_m.reshape(-1, 3).T
    assert (x.min(), x.max(), y.min(), y.max()) == pytest.approx((-80, 80, -80, 80))
    assert (z[np.hypot(x, y) < 6] == -2).all()
    assert 0.1 < np.abs(z + 2).max() <= 0.5
    assert len(ground.material) <= 4000
    assert ground.normals[..., 2].min() > 0.9
    assert palette.materials[0].texture == family


def test_terrain_and_sea_are_finer_near_the_origin():
    for ground in (
        terrain(np.random.default_rng(0), Palette(), "grass"),
        sea(np.random.default_rng(0), Palette()),
    ):
        sides_m = np.ptp(ground.corners_m[..., 0], axis=1)
        away_m = np.abs(ground.corners_m).max((1, 2))
        assert sides_m[away_m < 5].mean() < 0.2 * sides_m[away_m > 60].mean()


def test_waves_are_small_and_centred_on_the_level_of_the_sea():
    water = sea(np.random.default_rng(0), Palette(), level_m=3.0)
    z = water.corners_m[..., 2]
    assert z.mean() == pytest.approx(3, abs=0.05)
    assert 0.02 < np.abs(z - 3).max() < 0.8
    assert water.normals[..., 2].min() > 0.8


def test_hills_close_the_horizon_and_face_the_origin():
    ridge = hills(np.random.default_rng(0), Palette(), distance_m=100)
    middles = ridge.corners_m.mean(1)
    around = np.digitize(np.degrees(np.arctan2(middles[:, 1], middles[:, 0])), np.arange(-180, 180, 10))
    assert (np.bincount(around, minlength=37)[1:] > 0).all()
    assert all(ridge.corners_m[around == part, :, 2].max() > 0 for part in range(1, 37))
    assert np.linalg.norm(ridge.corners_m[..., :2], axis=-1).min() > 90
    front = middles[:, 2] < 2
    assert ((ridge.normals.mean(1) * middles)[front, :2].sum(1) < 0).all()


def test_a_fence_has_a_post_at_each_corner_and_about_every_2_m():
    corners_m = np.array([[0.0, 0, 0], [10, 0, 0], [10, 8, 0]])
    mesh = fence(np.random.default_rng(0), Palette(), corners_m)
    feet = np.unique(np.round(mesh.corners_m[mesh.corners_m[..., 2] < -0.49], 3), axis=0)
    for post in [(0, 0), (2, 0), (4, 0), (6, 0), (8, 0), (10, 0), (10, 2), (10, 4), (10, 6), (10, 8)]:
        assert np.linalg.norm(feet[:, :2] - post, axis=1).min() < 0.04
    assert mesh.corners_m[..., :2].min() > -0.1
    assert mesh.corners_m[..., :2].max() < 10.1
