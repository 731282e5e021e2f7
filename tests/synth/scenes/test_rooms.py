import functools
import itertools

import numpy as np
import pytest

from stereoweave.synth.props.clutter import COUNT, ClutterSpace, clutter
from stereoweave.synth.props.furniture import FURNITURE
from stereoweave.synth.props.random_materials import PERIODIC, draw_broad_material, draw_material
from stereoweave.synth.props.solids import SOLIDS, PropStyle
from stereoweave.synth.props.table_tops import draw_table_top, table_top
from stereoweave.synth.props.thin_things import THIN
from stereoweave.synth.scenes.rooms import rooms
from stereoweave.synth.stage import Palette
from stereoweave.synth.textures.bank import FAMILIES
from stereoweave.synth.viewpoints import Orbit

THINGS = {thing.__name__: thing for thing in (*SOLIDS, *THIN, *FURNITURE)}
SPACE = ClutterSpace(
    orbit=Orbit(centre_m=(0, 0, 1), distance_m=(2, 2.5), azimuth_deg=(30, 55), elevation_deg=(0, 8)),
    low_m=np.array([-3.0, -3.0, 0.0]),
    high_m=np.array([3.0, 3.0, 3.0]),
    far_m=5.0,
)


@functools.cache
def draw_stage_and_rig(seed):
    return rooms(np.random.default_rng(seed))


@pytest.mark.parametrize("seed", range(4))
def test_15_to_40_objects_fill_the_room_and_keep_away_from_the_cameras(seed):
    palette = Palette()
    things = clutter(np.random.default_rng(seed), palette, SPACE)
    assert COUNT[0] == 15
    assert COUNT[1] == 40
    assert 15 <= len(things) <= 40
    assert len(palette.materials) == len(things)
    corners_m = np.concatenate([thing.corners_m.reshape(-1, 3) for thing in things])
    eyes_m = SPACE.eyes_m()
    nearest_m = min(np.linalg.norm(corners_m - eye, axis=1).min() for eye in eyes_m)
    assert nearest_m > 0.3
    assert np.linalg.norm(corners_m - eyes_m.mean(0), axis=1).max() < 9


def test_cameras_are_within_the_ranges_of_their_orbit():
    eyes_m = SPACE.eyes_m() - [0, 0, 1]
    distances_m = np.linalg.norm(eyes_m, axis=1)
    assert distances_m.min() == pytest.approx(2)
    assert distances_m.max() == pytest.approx(2.5)
    azimuths_deg = np.degrees(np.arctan2(eyes_m[:, 1], eyes_m[:, 0]))
    assert azimuths_deg.min() == pytest.approx(30)
    assert azimuths_deg.max() == pytest.approx(55)


def test_only_the_objects_are_the_target():
    for seed in range(4):
        stage = draw_stage_and_rig(seed)
        mesh = stage.world.mesh
        assert 0.1 < mesh.target.mean() < 0.95
        target_m = mesh.corners_m[mesh.target]
        assert abs(target_m[..., :2]).max() < 11
        assert target_m[..., 2].min() > -0.8


def test_a_fifth_of_the_surfaces_are_nearly_plain_and_a_third_show_photographs(rng):
    families = [draw_material(rng, 3.0).texture for _ in range(4000)]
    assert 0.15 < families.count("plain") / 4000 < 0.25
    assert 0.30 < families.count("photograph") / 4000 < 0.40
    assert 0.08 < sum(families.count(name) for name in PERIODIC) / 4000 < 0.16
    assert set(families) == set(FAMILIES)


def test_two_thirds_of_the_walls_floors_and_tables_are_plain_and_flat(rng):
    materials = [draw_broad_material(rng, ("brick", "wood"), 3.0) for _ in range(2000)]
    plain = [material for material in materials if material.texture == "plain"]
    assert 0.61 < len(plain) / 2000 < 0.69
    assert {material.texture for material in materials} == {"plain", "brick", "wood"}
    assert max(material.relief for material in plain) <= 0.1


@pytest.mark.parametrize("seed", range(8))
def test_a_table_reaches_from_the_front_of_its_centre_to_the_wall_behind_it(seed):
    rng = np.random.default_rng(seed)
    sizes = draw_table_top(rng)
    corners_m = table_top(rng, Palette(), sizes).corners_m
    slab_m = corners_m[np.ptp(corners_m[..., 2], axis=1) == 0]
    surface_m = slab_m[np.isclose(slab_m[:, 0, 2], sizes.height_m, atol=1e-5)]
    assert surface_m[..., 0].min() == pytest.approx(-sizes.behind_m)
    assert surface_m[..., 0].max() == pytest.approx(sizes.before_m)
    assert np.ptp(surface_m[..., 1]) == pytest.approx(sizes.width_m)


def test_boards_and_walls_of_a_table_keep_a_quarter_of_the_distance_from_the_cameras():
    for seed in range(40):
        rng = np.random.default_rng(seed)
        sizes = draw_table_top(rng)
        corners_m = table_top(rng, Palette(), sizes).corners_m.reshape(-1, 3)
        upright_m = corners_m[corners_m[:, 2] > sizes.height_m + 0.01]
        away_m = np.linalg.norm(upright_m[:, :2] - [sizes.distance_m, 0], axis=1)
        assert away_m.min() > 0.25 * sizes.distance_m


def test_a_fifth_of_the_surfaces_are_glossy(rng):
    materials = [draw_material(rng, 3.0) for _ in range(4000)]
    glossy = [material for material in materials if material.roughness <= 0.4]
    assert 0.17 < len(glossy) / 4000 < 0.23
    assert all(material in glossy for material in materials if material.metal)


def test_textures_are_as_fine_as_pixels_at_any_distance(rng):
    for distance_m in (1.0, 4.0, 10.0):
        spans_px = [draw_material(rng, distance_m).span_m / distance_m * 600 for _ in range(300)]
        assert min(spans_px) >= 169.9  # at a focal length of 600 px
        assert max(spans_px) <= 800.1


@pytest.mark.parametrize("name", THINGS)
def test_every_object_is_about_a_metre_in_size_and_faces_outwards(name):
    skin = PropStyle(main=3, other=5, bar_m=0.01)
    for seed in range(3):
        mesh = THINGS[name](np.random.default_rng(seed), skin)
        assert set(np.unique(mesh.material)) <= {3, 5}
        assert 0.3 < np.ptp(mesh.corners_m.reshape(-1, 3), axis=0).max() < 3
        a, b, c = mesh.corners_m.swapaxes(0, 1)
        area = np.cross(b - a, c - a)
        inverted = (area * mesh.normals.mean(1)).sum(1) < 0
        assert np.linalg.norm(area[inverted], axis=1).sum() < 0.01 * np.linalg.norm(area, axis=1).sum()


def test_thin_bars_are_as_thick_as_asked():
    for name, bar_m in itertools.product(("lattice_mast", "bar_grid"), (0.002, 0.02)):
        mesh = THINGS[name](np.random.default_rng(0), PropStyle(main=0, other=1, bar_m=bar_m))
        rim_m = mesh.corners_m[:, 1] - mesh.corners_m[:, 2]
        assert np.linalg.norm(rim_m, axis=1).min() < 2 * bar_m
