"""Scene `propeller`: a ship's propeller in a dry dock or a yard, or on display as a monument. Aft is +x."""

from dataclasses import dataclass, replace

import numpy as np

from stereoweave.synth.props import surroundings
from stereoweave.synth.props.lattice import railing
from stereoweave.synth.props.primitives import boxes, copies, lathe, prism, rotation, translation, tubes
from stereoweave.synth.props.propellers import Propeller, draw_propeller, propeller_mesh
from stereoweave.synth.props.shipyards import blocks, dock, litter, scaffold, work_lamps, yard
from stereoweave.synth.props.sterns import stern
from stereoweave.synth.props.surroundings import daylight, draw_spots, vary_colour
from stereoweave.synth.stage import Palette, Stage
from stereoweave.synth.viewpoints import Orbit
from stereoweave.synth.world import Colour, Lamp, Material, Mesh, Sky, World, join_meshes

# Finishes of propellers: texture, its variants, colour, roughness and metal.
_FINISHES: tuple[tuple[str, tuple[int, ...], Colour, float, float], ...] = (
    ("steel", (0, 2), (1.6, 1.15, 0.6), 0.3, 0.9),  # polished bronze
    ("steel", (1, 2), (1.1, 0.8, 0.45), 0.45, 0.7),  # worn bronze
    ("plaster", (0, 2), (0.5, 0.42, 0.27), 0.6, 0.35),  # encrusted bronze
    ("paint", (0, 1, 2, 3), (0.42, 0.14, 0.1), 0.5, 0.0),
    ("paint", (0, 1, 2, 3), (0.8, 0.78, 0.72), 0.45, 0.0),
)


@dataclass(frozen=True, kw_only=True)
class _Surroundings:
    """Surroundings of a propeller: their mesh, the height of their floor, and their lamps."""

    mesh: Mesh
    floor_m: float
    lamps: tuple[Lamp, ...] = ()


def propeller(rng: np.random.Generator) -> Stage:
    """Build a stage with a propeller 4.6 to 5.6 m in diameter, seen from aft."""
    palette, propeller = Palette(), draw_propeller(rng)
    bolt = palette.add(Material(texture="steel", tint=(0.5, 0.5, 0.5), roughness=0.5, metal=0.7))
    bronze = palette.add(_draw_finish(rng))
    mesh = propeller_mesh(propeller, bronze, bronze, bolt).transform(rotation((1, 0, 0), rng.uniform(0, 360)))
    kind = rng.choice(["dock", "yard", "park"], p=[0.55, 0.28, 0.17])
    around = (
        _park(rng, palette, propeller)
        if kind == "park"
        else _shipyard(rng, palette, propeller, kind == "dock")
    )
    sky, fog, exposure = daylight(rng)
    world = World(
        mesh=join_meshes([mesh.as_target(), around.mesh]),
        materials=tuple(palette.materials),
        sky=_turn_sun_aft(rng, sky),
        lamps=around.lamps,
        fog=fog,
        exposure=exposure,
    )
    side = rng.choice([-1, 1])
    azimuths = sorted((side * 6.0, side * 52.0))
    orbit = Orbit(
        centre_m=(0.2, 0.0, 0.0),
        distance_m=(5.2, 8.2),
        azimuth_deg=(azimuths[0], azimuths[1]),
        elevation_deg=(-12.0, 12.0),
        aim_m=0.6,
        floor_m=around.floor_m + 1.2,
    )
    return Stage(world=world, orbit=orbit)


def _draw_finish(rng: np.random.Generator) -> Material:
    texture, variants, tint, roughness, metal = _FINISHES[rng.choice(5, p=[0.3, 0.25, 0.2, 0.15, 0.1])]
    return Material(
        texture=texture,
        variant=int(rng.choice(variants)),
        tint=vary_colour(rng, tint),
        span_m=rng.uniform(1.2, 2.5),
        roughness=roughness * rng.uniform(0.85, 1.2),
        metal=metal,
        relief=0.25,
    )


def _turn_sun_aft(rng: np.random.Generator, sky: Sky) -> Sky:
    """Rotate the sun aft in most cases, so that it shines under the hull onto the blades."""
    if rng.random() < 0.15:
        return sky
    level, azimuth = np.hypot(*sky.sun[:2]), np.radians(rng.uniform(-65, 65))
    return replace(sky, sun=(float(level * np.cos(azimuth)), float(level * np.sin(azimuth)), sky.sun[2]))


def _shipyard(
    rng: np.random.Generator, palette: Palette, propeller: Propeller, docked: bool
) -> _Surroundings:
    """Build the ship's stern on blocks above the propeller, among shipyard equipment."""
    ship = stern(rng, palette, propeller)
    floor_m, half_m = ship.keel_m - rng.uniform(0.9, 1.3), rng.uniform(8.0, 9.5)
    light, shining = work_lamps(rng, palette, floor_m)
    ground = dock(rng, palette, floor_m, half_m) if docked else yard(rng, palette, floor_m)
    pieces = [
        ship.mesh,
        ground,
        light,
        blocks(rng, palette, ship, floor_m),
        litter(rng, palette, floor_m, half_m),
    ]
    if rng.random() < 0.75:
        pieces.append(scaffold(rng, palette, floor_m, rng.uniform(4.2, 5.8)))
    return _Surroundings(mesh=join_meshes(pieces), floor_m=floor_m, lamps=shining)


def _park(rng: np.random.Generator, palette: Palette, propeller: Propeller) -> _Surroundings:
    """Build a plinth that carries the propeller on a short shaft, among paths, benches, trees and houses."""
    floor_m = -propeller.radius_m - rng.uniform(0.7, 1.1)
    angle = np.radians(np.arange(95, 266, 5.5)) + rng.normal(0, 0.01, 32)
    close = draw_spots(rng, 22, 9.5, 14)
    hedge = rng.uniform(7.2, 8.5) * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    pieces = [
        surroundings.terrain(rng, palette, "grass", bumps_m=0.5, flat_radius_m=10),
        _path(rng, palette),
        _benches(rng, palette),
        surroundings.bushes(rng, palette, hedge),
        surroundings.trees(
            rng, palette, np.concatenate([close[close[:, 0] < -2], draw_spots(rng, 26, 16, 60)]), (5, 11)
        ),
        surroundings.houses(rng, palette, draw_spots(rng, 7, 35, 80)),
        surroundings.hills(rng, palette),
    ]
    base = join_meshes(pieces).translate(z=floor_m)
    return _Surroundings(mesh=join_meshes([base, _plinth(rng, palette, propeller, floor_m)]), floor_m=floor_m)


def _plinth(rng: np.random.Generator, palette: Palette, propeller: Propeller, floor_m: float) -> Mesh:
    """Build two steps, a tapering pier behind the hub, a plaque, and a chain around the plinth."""
    texture = str(rng.choice(["stone", "concrete", "brick"]))
    stone = palette.add(
        Material(texture=texture, variant=int(rng.integers(64)), tint=vary_colour(rng, (0.8, 0.78, 0.74)))
    )
    plate = palette.add(
        Material(texture="sign", variant=int(rng.integers(64)), tint=(0.7, 0.62, 0.45), span_m=1.2)
    )
    chain = palette.add(Material(texture="rust", tint=(0.3, 0.3, 0.3), roughness=0.6))
    steel = palette.add(Material(texture="steel", tint=(0.55, 0.55, 0.55), roughness=0.4, metal=0.8))
    front_m, r = -propeller.hub_half_m - 0.25, propeller.hub_m
    low_m = -propeller.radius_m - 0.15
    outline = [(front_m, 1.6 * r), (front_m - 0.5, 2.0 * r), (front_m - 1.6, 2.0 * r), (front_m - 2.1, 0)]
    outline = [*outline, (front_m - 1.6, -2.0 * r), (front_m - 0.5, -2.0 * r), (front_m, -1.6 * r)]
    pier = prism(outline, 1.6 * r - floor_m, stone).translate(z=floor_m)
    steps = boxes(
        [(-0.9, 0, (floor_m + low_m) / 2), (-0.9, 0, (floor_m + low_m) / 2 - 0.15)],
        [(3.2, 4.4, low_m - floor_m), (4.4, 5.6, low_m - floor_m - 0.3)],
        stone,
    )
    shaft = tubes((front_m - 0.3, 0, 0), (0, 0, 0), 0.6 * r, steel, sides=32)
    board = boxes((0.71, 0, low_m - 0.15), (0.06, 1.6, 0.22), plate)
    angle = np.linspace(0, 2 * np.pi, 13)[:, None]
    ring = np.concatenate([-0.9 + 3.1 * np.cos(angle), 3.6 * np.sin(angle), np.full_like(angle, floor_m)], 1)
    return join_meshes([pier, steps, shaft, board, railing(ring, 0.6, 3.0, 0.03, chain, rails=1)])


def _path(rng: np.random.Generator, palette: Palette) -> Mesh:
    """Build a paved circle around the plinth, and a path leading to the circle."""
    paving = palette.add(
        Material(
            texture=str(rng.choice(["gravel", "stone", "concrete"])),
            variant=int(rng.integers(64)),
            tint=vary_colour(rng, (0.8, 0.76, 0.7)),
            span_m=2.5,
            roughness=0.95,
        )
    )
    place = lathe([(5.6, 0.0), (5.5, 0.03), (0, 0.03)], paving, sections=64)
    way = boxes((0, 25, -0.09), (2.4, 50, 0.22), paving).transform(rotation((0, 0, 1), rng.uniform(0, 360)))
    return join_meshes([place, way])


def _benches(rng: np.random.Generator, palette: Palette) -> Mesh:
    wood = palette.add(
        Material(texture="wood", variant=int(rng.integers(64)), tint=vary_colour(rng, (0.6, 0.45, 0.32)))
    )
    iron = palette.add(Material(texture="rust", tint=(0.2, 0.22, 0.22), roughness=0.6))
    slats = boxes(
        [(0, y, 0.45) for y in (-0.15, 0, 0.15)] + [(0, 0.26, z) for z in (0.65, 0.8)],
        [(1.8, 0.12, 0.035)] * 3 + [(1.8, 0.035, 0.12)] * 2,
        wood,
    )
    ends = np.array([-0.75, 0.75])
    legs = [
        tubes([(x, y, 0) for x in ends], [(x, y, z) for x in ends], 0.03, iron)
        for y, z in ((-0.2, 0.43), (0.25, 0.85))
    ]
    bench = join_meshes([slats, *legs])
    return copies(
        bench,
        np.stack([rotation((0, 0, 1), angle) @ translation(y=5.0, z=0.03) for angle in (60, 100, 140, 215)]),
    )
