"""Scene `rooms`, for training: table tops, rooms and open ground with objects of all shapes and materials."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.clutter import ClutterSpace, clutter
from stereoweave.synth.props.interiors import draw_lamp_spots, draw_lamps, indoor_light, pendants, shell
from stereoweave.synth.props.primitives import boxes, rotation
from stereoweave.synth.props.random_materials import draw_material_from
from stereoweave.synth.props.surroundings import (
    bushes,
    daylight,
    draw_spots,
    hills,
    houses,
    rocks,
    terrain,
    trees,
)
from stereoweave.synth.props.table_tops import draw_table_top, table_top
from stereoweave.synth.stage import Palette, Stage
from stereoweave.synth.viewpoints import Orbit
from stereoweave.synth.world import Mesh, World, join_meshes

# The arc is narrow, so that objects can be placed in view of all viewpoints.
_SWING_DEG = 12.0
# Probabilities of table tops, rooms and open ground.
_SHARES = (0.64, 0.24, 0.12)
# Larger than in other scenes, because 6 to 8 % of the left image lies outside the right one in real indoor
# pairs.
_NEAREST_PX = (60.0, 170.0)


def rooms(rng: np.random.Generator) -> Stage:
    """Build a table top, a room or open ground with 9 to 40 objects, seen from an arc around its centre."""
    kinds = (_table_top, _room, _ground)
    return kinds[rng.choice(len(kinds), p=_SHARES)](rng)


def _table_top(rng: np.random.Generator) -> Stage:
    """Build a closed room with a table close to the cameras, boards on the table and a wall behind it."""
    palette = Palette()
    sizes, size_m = draw_table_top(rng), rng.uniform([6.5, 6.5, 2.5], [9.0, 9.0, 3.5])
    azimuth_deg, lowest_deg = rng.uniform((0, 6), (360, 28)).tolist()
    orbit = Orbit(
        centre_m=(0.0, 0.0, sizes.height_m + rng.uniform(0.1, 0.3) * sizes.distance_m),
        distance_m=(sizes.distance_m, 1.1 * sizes.distance_m),
        azimuth_deg=(azimuth_deg, azimuth_deg + _SWING_DEG),
        elevation_deg=(lowest_deg, lowest_deg + 4),
        aim_m=0.2,
        floor_m=sizes.height_m + 0.2,
    )
    half_m = 0.5 * max(sizes.width_m, 2 * sizes.behind_m)
    space = ClutterSpace(
        orbit=orbit,
        low_m=np.array([-half_m, -half_m, sizes.height_m]),
        high_m=np.array([half_m, half_m, sizes.height_m + 1.4]),
        far_m=sizes.distance_m + 0.8 * sizes.behind_m,
        count=(9, 30),
        standing=0.75,
    )
    things = clutter(rng, palette, space)
    towards_cameras = rotation((0, 0, 1), azimuth_deg + _SWING_DEG / 2)
    spots_m = draw_lamp_spots(rng, size_m, space.eyes_m())
    lamps = draw_lamps(rng, spots_m)
    parts = [
        table_top(rng, palette, sizes).transform(towards_cameras),
        shell(rng, palette, size_m, open_roof=False, open_side=None),
        pendants(rng, palette, spots_m, float(size_m[2])),
    ]
    sky, exposure = indoor_light(rng, daylight(rng)[0], lamps)
    mesh = join_meshes([*parts, *(thing.as_target() for thing in things)])
    world = World(mesh=mesh, materials=tuple(palette.materials), sky=sky, lamps=lamps, exposure=exposure)
    return Stage(world=world, orbit=orbit, nearest_px=_NEAREST_PX)


def _room(rng: np.random.Generator) -> Stage:
    palette = Palette()
    size_m = rng.uniform([5.0, 5.0, 2.5], [10.0, 10.0, 4.2])
    open_roof, open_side = rng.random() < 0.2, int(rng.integers(4)) if rng.random() < 0.25 else None
    orbit = _orbit_inside(rng, size_m)
    space = ClutterSpace(
        orbit=orbit,
        low_m=np.array([-0.5, -0.5, 0]) * size_m,
        high_m=np.array([0.5, 0.5, 1]) * size_m,
        far_m=orbit.distance_m[1] + 0.45 * float(size_m[:2].max()),
    )
    things = clutter(rng, palette, space)
    spots_m = draw_lamp_spots(rng, size_m, space.eyes_m())
    lamps = draw_lamps(rng, spots_m)
    parts = [shell(rng, palette, size_m, open_roof=open_roof, open_side=open_side)]
    sky, _, exposure = daylight(rng)
    if not open_roof:
        parts.append(pendants(rng, palette, spots_m, float(size_m[2])))
    if not open_roof and open_side is None:
        sky, exposure = indoor_light(rng, sky, lamps)
    else:
        parts.append(terrain(rng, palette, "grass", extent_m=80.0, level_m=-0.2, flat_radius_m=9.0))
        parts.append(trees(rng, palette, draw_spots(rng, 14, 12.0, 40.0)))
    mesh = join_meshes([*parts, *(thing.as_target() for thing in things)])
    world = World(mesh=mesh, materials=tuple(palette.materials), sky=sky, lamps=lamps, exposure=exposure)
    return Stage(world=world, orbit=orbit, nearest_px=_NEAREST_PX)


def _ground(rng: np.random.Generator) -> Stage:
    palette = Palette()
    azimuth_deg, lowest_deg, distance_m = rng.uniform((0, -3, 2.0), (360, 15, 4.5)).tolist()
    orbit = Orbit(
        centre_m=(0.0, 0.0, rng.uniform(0.8, 1.5)),
        distance_m=(distance_m, 1.1 * distance_m),
        azimuth_deg=(azimuth_deg, azimuth_deg + _SWING_DEG),
        elevation_deg=(lowest_deg, lowest_deg + 4),
        aim_m=0.25,
        floor_m=0.45,
    )
    reach_m = rng.uniform(3.5, 8.0)
    space = ClutterSpace(
        orbit=orbit,
        low_m=np.array([-9.0, -9.0, 0.0]),
        high_m=np.array([9.0, 9.0, 4.5]),
        far_m=distance_m + reach_m,
    )
    things = clutter(rng, palette, space)
    family = str(rng.choice(["grass", "soil", "gravel", "asphalt", "concrete"]))
    parts = [
        terrain(rng, palette, family, extent_m=90.0, bumps_m=1.5, flat_radius_m=9.5),
        _walls(rng, palette, azimuth_deg + _SWING_DEG / 2, reach_m),
        trees(rng, palette, draw_spots(rng, int(rng.integers(5, 20)), 12.0, 45.0)),
        bushes(rng, palette, draw_spots(rng, int(rng.integers(4, 20)), 10.0, 30.0)),
        *_far_off(rng, palette),
    ]
    mesh = join_meshes([*parts, *(thing.as_target() for thing in things)])
    sky, fog, exposure = daylight(rng)
    exposure *= float(np.exp(rng.normal(-0.12, 0.25)))
    materials = tuple(palette.materials)
    world = World(mesh=mesh, materials=materials, sky=sky, fog=fog, exposure=exposure)
    return Stage(world=world, orbit=orbit, nearest_px=_NEAREST_PX)


def _far_off(rng: np.random.Generator, palette: Palette) -> Sequence[Mesh]:
    """Build a random selection of distant hills, houses and rocks."""
    far = []
    if rng.random() < 0.6:
        far.append(hills(rng, palette, distance_m=rng.uniform(70, 130)))
    if rng.random() < 0.6:
        far.append(houses(rng, palette, draw_spots(rng, int(rng.integers(2, 6)), 18.0, 50.0)))
    if rng.random() < 0.6:
        far.append(rocks(rng, palette, draw_spots(rng, int(rng.integers(4, 16)), 10.0, 25.0)))
    return far


def _walls(rng: np.random.Generator, palette: Palette, cameras_deg: float, away_m: float) -> Mesh:
    """Build one to four free-standing walls beyond the centre, opposite the cameras."""
    walls = []
    for _ in range(int(rng.integers(1, 5))):
        material = palette.add(
            draw_material_from(rng, ("brick", "stone", "plaster", "concrete", "wood", "photograph"), 7.0)
        )
        size_m = rng.uniform([2.0, 0.15, 1.0], [7.0, 0.4, 3.2])
        wall = boxes([[0, 0, size_m[2] / 2 - 0.3]], size_m[None], material)
        coping = boxes([[0, 0, size_m[2] - 0.27]], (size_m * [1.02, 1.3, 0])[None] + [[0, 0, 0.08]], material)
        around = rotation((0, 0, 1), cameras_deg + 180 + rng.uniform(-55, 55))
        facing = join_meshes([wall, coping]).transform(rotation((0, 0, 1), 90 + rng.normal(0, 25)))
        walls.append(facing.translate(x=away_m * rng.uniform(0.9, 1.5)).transform(around))
    return join_meshes(walls)


def _orbit_inside(rng: np.random.Generator, size_m: Float[np.ndarray, "3"]) -> Orbit:
    """Return an arc around the room's centre, at eye level and as far out as the walls allow."""
    azimuth_deg = rng.uniform(0, 360)
    angle = np.radians(np.linspace(azimuth_deg, azimuth_deg + _SWING_DEG, 9))
    to_wall_m = np.minimum(size_m[0] / 2 / abs(np.cos(angle)), size_m[1] / 2 / abs(np.sin(angle))).min()
    farthest_m, height_m = min(float(to_wall_m) - 0.6, 5.0), rng.uniform(0.9, 1.4)
    highest_deg = float(np.degrees(np.arctan((size_m[2] - 0.4 - height_m) / farthest_m)))
    lowest_deg = rng.uniform(-8.0, min(14.0, highest_deg - 4))
    return Orbit(
        centre_m=(0.0, 0.0, height_m),
        distance_m=(0.9 * farthest_m, farthest_m),
        azimuth_deg=(azimuth_deg, azimuth_deg + _SWING_DEG),
        elevation_deg=(lowest_deg, lowest_deg + 4),
        aim_m=0.25,
        floor_m=0.4,
    )
