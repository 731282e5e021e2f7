"""Scene `figures`: people and animals close to the cameras, indoors or outdoors, as in animated films."""

from dataclasses import replace

import numpy as np

from stereoweave.synth.props.clutter import ClutterSpace, clutter
from stereoweave.synth.props.interiors import draw_lamp_spots, draw_lamps, indoor_light, pendants, shell
from stereoweave.synth.props.people_and_animals import animal, draw_clothes, person
from stereoweave.synth.props.primitives import rotation
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
from stereoweave.synth.stage import Palette, Stage
from stereoweave.synth.viewpoints import Orbit
from stereoweave.synth.world import Colour, Mesh, Sky, World, join_meshes

# The figures are close to the cameras and the background is distant.
_NEAREST_PX = (55.0, 175.0)


def figures(rng: np.random.Generator) -> Stage:
    """Build a stage with three to seven plain, rounded figures, the nearest 1 to 2 m from the cameras."""
    distance_m, lowest_deg = rng.uniform((3.0, -4.0), (5.0, 12.0)).tolist()
    orbit = Orbit(
        centre_m=(0.0, 0.0, rng.uniform(0.9, 1.4)),
        distance_m=(distance_m, 1.1 * distance_m),
        azimuth_deg=(-6.0, 6.0),
        elevation_deg=(lowest_deg, lowest_deg + 4),
        aim_m=0.3,
        floor_m=0.5,
    )
    palette = Palette()
    cast = _cast(rng, palette, distance_m).as_target()
    world = _hall if rng.random() < 0.5 else _open_air
    return Stage(world=world(rng, palette, orbit, cast), orbit=orbit, nearest_px=_NEAREST_PX)


def _cast(rng: np.random.Generator, palette: Palette, distance_m: float) -> Mesh:
    """Build figures from close to the cameras, at x = distance_m, to a few metres beyond the centre."""
    clothes = [draw_clothes(rng, palette) for _ in range(3)]
    kinds = [animal(rng, palette) for _ in range(2)]
    depths_m = np.geomspace(rng.uniform(0.95, 1.8), distance_m + 4, int(rng.integers(3, 8)))
    cast = []
    for depth_m in depths_m * rng.uniform(0.95, 1.05, len(depths_m)):
        if rng.random() < 0.6:
            figure, size = person(rng, clothes[int(rng.integers(3))]), rng.uniform(0.7, 1.1)
        else:
            # Limit the size, so that the nose stays clear of the cameras.
            figure, size = kinds[int(rng.integers(2))], min(rng.uniform(0.7, 1.6), 0.65 * depth_m)
        pose = rotation((0, 0, 1), rng.uniform(-100, 100)) @ np.diag([size, size, size, 1.0])
        cast.append(
            figure.transform(pose).translate(distance_m - depth_m, 0.45 * depth_m * rng.uniform(-1, 1))
        )
    return join_meshes(cast)


def _hall(rng: np.random.Generator, palette: Palette, orbit: Orbit, cast: Mesh) -> World:
    """Build a large room with the figures, lamps and some clutter."""
    size_m = 2 * orbit.distance_m[1] + rng.uniform(1.5, 8.0, 3)
    size_m[2] = rng.uniform(2.8, 5.0)
    space = ClutterSpace(
        orbit=orbit,
        low_m=np.array([-0.5, -0.5, 0]) * size_m,
        high_m=np.array([0.5, 0.5, 1]) * size_m,
        far_m=1.5 * orbit.distance_m[1],
        count=(3, 10),
        standing=0.8,
    )
    spots_m = draw_lamp_spots(rng, size_m, space.eyes_m())
    lamps = draw_lamps(rng, spots_m)
    parts = [
        cast,
        *clutter(rng, palette, space),
        shell(rng, palette, size_m, open_roof=False, open_side=None),
        pendants(rng, palette, spots_m, float(size_m[2])),
    ]
    sky, exposure = indoor_light(rng, daylight(rng)[0], lamps)
    materials = tuple(palette.materials)
    return World(mesh=join_meshes(parts), materials=materials, sky=sky, lamps=lamps, exposure=exposure)


def _open_air(rng: np.random.Generator, palette: Palette, orbit: Orbit, cast: Mesh) -> World:
    """Build open ground with the figures and distant trees, rocks, houses and hills, often in soft light."""
    family = str(rng.choice(["grass", "soil", "gravel", "concrete", "plain"], p=[0.2, 0.15, 0.15, 0.1, 0.4]))
    parts = [
        cast,
        terrain(rng, palette, family, extent_m=120.0, bumps_m=2.5, flat_radius_m=8.0),
        trees(rng, palette, draw_spots(rng, int(rng.integers(4, 20)), 10.0, 60.0)),
        rocks(rng, palette, draw_spots(rng, int(rng.integers(4, 16)), 7.0, 30.0)),
        bushes(rng, palette, draw_spots(rng, int(rng.integers(0, 14)) + 1, 8.0, 30.0)),
    ]
    if rng.random() < 0.7:
        parts.append(hills(rng, palette, distance_m=rng.uniform(60, 110)))
    if rng.random() < 0.4:
        parts.append(houses(rng, palette, draw_spots(rng, int(rng.integers(1, 5)), 16.0, 50.0)))
    sky, fog, exposure = daylight(rng)
    materials = tuple(palette.materials)
    return World(
        mesh=join_meshes(parts), materials=materials, sky=_soften(rng, sky), fog=fog, exposure=exposure
    )


def _soften(rng: np.random.Generator, sky: Sky) -> Sky:
    """Dim the sun with a probability of one half."""
    share = rng.choice([1.0, rng.uniform(0.1, 0.6)])

    def dim(colour: Colour) -> Colour:
        red, green, blue = (float(share * part) for part in colour)
        return red, green, blue

    return replace(sky, sun_light=dim(sky.sun_light))
