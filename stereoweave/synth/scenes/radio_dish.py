"""Large radio dishes: a reflector on a lattice of ribs, a feed on struts, and a mount."""

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.antennas import paraboloid
from stereoweave.synth.props.lattice import (
    bars,
    cage,
    chain_segments,
    galvanised_steel,
    ladder,
    railing,
    truss,
)
from stereoweave.synth.props.primitives import boxes, copies, lathe, rotation, spheres, translation, tubes
from stereoweave.synth.props.surroundings import bushes, daylight, draw_spots, hills, houses, terrain, trees
from stereoweave.synth.props.wind_rotors import composite_skin
from stereoweave.synth.stage import Palette, Stage, outdoor_stage
from stereoweave.synth.viewpoints import Orbit
from stereoweave.synth.world import Material, Mesh, join_meshes

RIBS = 16


def radio_dish(rng: np.random.Generator) -> Stage:
    """Build a stage with a dish 3.6 to 4.4 m across that faces +x, and similar dishes in the distance."""
    palette = Palette()
    white, steel = palette.add(composite_skin(rng)), palette.add(galvanised_steel(rng))
    back = white if rng.random() < 0.5 else steel
    concrete = palette.add(Material(texture="concrete", variant=int(rng.integers(8)), span_m=2.0))
    dark = palette.add(Material(texture="plain", tint=(0.1, 0.1, 0.11), roughness=0.6))
    radius, axis = rng.uniform(1.8, 2.2), rng.uniform(2.5, 2.9)
    upwards_deg = rng.uniform(18, 62)
    reflector = _reflector(rng, radius, (white, back, steel, dark))
    aimed = reflector.transform(
        translation(z=axis) @ rotation((0, 1, 0), 90 - upwards_deg) @ translation(z=0.42)
    )
    mount = (_pedestal if rng.random() < 0.5 else _alidade)(axis, (white, steel, concrete, dark))
    dish = join_meshes([aimed, mount])
    light = daylight(rng)
    land = _land(rng, palette, concrete)
    far = _far(rng, white, (radius, axis, upwards_deg))
    mesh = join_meshes([dish.as_target(), far, land])
    front = 0.0 if rng.random() < 0.75 else 180.0
    orbit = Orbit(
        centre_m=(0.2, 0.0, 0.9 * axis),
        distance_m=(6.5, 9.5),
        azimuth_deg=(front - 85, front + 85),
        elevation_deg=(-13, 22),
        aim_m=0.6,
        floor_m=0.6,
    )
    return outdoor_stage(mesh, palette, light, orbit)


def _far(rng: np.random.Generator, white: int, measures: tuple[float, float, float]) -> Mesh:
    """Build simplified, distant dishes of the given radius, axis height and elevation."""
    radius, axis, upwards_deg = measures
    reflector = paraboloid(radius, 0.8 * radius, white, white, 20)
    dish = [
        reflector.transform(
            translation(z=axis) @ rotation((0, 1, 0), 90 - upwards_deg) @ translation(z=0.42)
        ),
        lathe([(0.5, 0), (0.3, axis - 0.4), (0, axis + 0.3)], white, 16),
    ]
    return copies(join_meshes(dish), np.stack([translation(x, y) for x, y, _ in draw_spots(rng, 4, 26, 70)]))


def _reflector(rng: np.random.Generator, radius_m: float, skins: tuple[int, int, int, int]) -> Mesh:
    """Build a paraboloid around z with ribs behind it and with struts and a receiver in front."""
    white, back, steel, dark = skins
    focal = rng.uniform(0.7, 0.85) * radius_m
    count = int(rng.choice([3, 4]))
    angle = np.arange(count) * 2 * np.pi / count + np.pi / count
    feet = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]) * 0.72 * radius_m
    feet[:, 2] = (0.72 * radius_m) ** 2 / (4 * focal)
    tips = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]) * 0.1 + [0, 0, focal]
    horn = lathe(
        [
            (0, focal - 0.2),
            (0.09, focal - 0.2),
            (0.05, focal - 0.06),
            (0.12, focal - 0.03),
            (0.12, focal + 0.16),
            (0, focal + 0.18),
        ],
        white,
        24,
    )
    secondary = lathe(
        [
            (0, focal - 0.02),
            (0.26, focal + 0.09),
            (0.26, focal + 0.11),
            (0.12, focal + 0.12),
            (0, focal + 0.12),
        ],
        white,
        28,
    )
    feed = lathe([(0.17, 0.0), (0.12, 0.3), (0.13, 0.34), (0, 0.34)], white, 24)
    cassegrain = rng.random() < 0.6
    return join_meshes(
        [
            paraboloid(radius_m, focal, white, back, 64),
            bars(_ribs(radius_m, focal), 0.013, steel, sides=4, capped=False),
            bars(_seams(radius_m, focal), 0.0035, steel, sides=4, capped=False),
            bars(np.stack([feet, tips], 1), 0.022, white, sides=7),
            join_meshes([secondary, feed]) if cassegrain else horn,
            lathe([(0, -0.42), (0.34, -0.42), (0.36, -0.3), (0.36, -0.02), (0, 0.0)], back, 32),
            tubes(tips[0], tips[0] + [0, 0, 0.35], 0.008, steel),
            spheres(tips, 0.03, dark, 1),
        ]
    )


def _seams(radius_m: float, focal_m: float) -> Float[np.ndarray, "n 2 3"]:
    """Return the seams between the reflector's panels: radial and circular lines on its front."""
    radius, angle = np.meshgrid(
        np.linspace(0.2, 0.97, 9) * radius_m, np.linspace(0, 2 * np.pi, 4 * RIBS + 1), indexing="ij"
    )
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), radius**2 / (4 * focal_m)], -1)
    return np.concatenate([chain_segments(points[[0, 4]]), chain_segments(points[:, ::2].swapaxes(0, 1))])


def _ribs(radius_m: float, focal_m: float) -> Float[np.ndarray, "n 2 3"]:
    """Return the bars behind the reflector: rings, and radial ribs of chords, posts and braces."""
    radius = np.linspace(0.18, 0.98, 6) * radius_m
    angle = np.arange(RIBS) * 2 * np.pi / RIBS
    across = radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], -1)

    def joints(height_m: np.ndarray) -> np.ndarray:
        return np.concatenate([across, np.broadcast_to(height_m[:, None, None], (6, RIBS, 1))], -1)

    upper = joints(radius**2 / (4 * focal_m) - 0.03)
    lower = joints(np.interp(radius, radius[[0, -1]], (-0.36, radius_m**2 / (4 * focal_m) - 0.07)))
    rings = [np.concatenate([ring, ring[:, :1]], axis=1) for ring in (lower[1:], upper[-1:])]
    pairs = [
        (lower[:-1], lower[1:]),
        (upper, lower),
        (upper[:-1], lower[1:]),
        *[(ring[:, :-1], ring[:, 1:]) for ring in rings],
    ]
    return np.concatenate([np.stack(ends, 2).reshape(-1, 2, 3) for ends in pairs])


def _yoke(axis_m: float, foot_m: float, skins: tuple[int, int, int, int]) -> Mesh:
    """Build two arms up to the elevation axis, drives, and a counterweight."""
    white, steel, _, dark = skins
    height = axis_m - foot_m
    arms = [boxes((-0.05, y, foot_m + height / 2), (0.34, 0.12, height + 0.24), white) for y in (0.46, -0.46)]
    return join_meshes(
        [
            *arms,
            tubes((0, -0.56, axis_m), (0, 0.56, axis_m), 0.1, steel, 18),
            tubes((0, -0.58, axis_m), (0, -0.52, axis_m), 0.2, white, 20),
            tubes((0, 0.52, axis_m), (0, 0.58, axis_m), 0.2, white, 20),
            boxes((-0.05, 0, foot_m), (0.5, 1.04, 0.14), white),
            boxes((-0.32, 0.3, foot_m + 0.2), (0.3, 0.28, 0.3), dark),
        ]
    )


def _pedestal(axis_m: float, skins: tuple[int, int, int, int]) -> Mesh:
    """Build a steel cone on concrete with a door, a platform with a railing, and a caged ladder."""
    white, steel, concrete, dark = skins
    top = axis_m - 0.75
    angle = np.linspace(0, 2 * np.pi, 21)
    rim = 0.72 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    return join_meshes(
        [
            lathe([(0, -0.1), (1.0, -0.1), (0.98, 0.12), (0, 0.12)], concrete, 40),
            lathe([(0.6, 0.12), (0.62, 0.16), (0.36, top - 0.1), (0.42, top), (0, top)], white, 36),
            lathe([(0.2, top - 0.05), (0.74, top - 0.03), (0.74, top), (0, top)], steel, 32),
            railing(rim + [0, 0, top], 0.24, 0.3, 0.008, steel),
            boxes((0.52, 0, 0.42), (0.14, 0.26, 0.56), dark),
            ladder((-0.72, 0, 0.1), (-0.76, 0, top + 0.2), (0, 1, 0), 0.14, steel),
            cage((-0.76, 0, 0.7), (-0.76, 0, top + 0.2), (-1, 0, 0), 0.14, steel),
            _yoke(axis_m, top + 0.08, skins),
        ]
    )


def _alidade(axis_m: float, skins: tuple[int, int, int, int]) -> Mesh:
    """Build a lattice mount with a ladder; the mount turns on wheels on a circular rail."""
    white, steel, concrete, dark = skins
    top, wide = axis_m - 0.75, 1.05
    corner = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    share = np.linspace(0, 1, 4)[:, None, None]
    joints = corner * (wide + share * (0.42 - wide)) + [0, 0, 0.22] + share * [0, 0, top - 0.22]
    wheels = corner * wide + [0, 0, 0.14]
    track = 1.49
    frame = truss(joints, "cross")
    rim = np.concatenate([corner, corner[:1]]) * 0.62 + [0, 0, top]
    return join_meshes(
        [
            lathe(
                [(track - 0.22, 0), (track - 0.22, 0.05), (track + 0.22, 0.05), (track + 0.22, -0.1)][::-1],
                concrete,
                64,
            ),
            lathe(
                [(track - 0.04, 0.05), (track - 0.04, 0.07), (track + 0.04, 0.07), (track + 0.04, 0.05)][
                    ::-1
                ],
                steel,
                64,
            ),
            frame.mesh(0.05, 0.022, white, sides=7),
            tubes(wheels - corner * 0.04, wheels + corner * 0.04, 0.09, steel, 16),
            boxes(wheels + [0, 0, 0.08], (0.22, 0.22, 0.1), dark),
            boxes((0, 0, top), (1.24, 1.24, 0.02), steel),
            railing(rim, 0.24, 0.3, 0.008, steel),
            ladder((-wide - 0.04, 0, 0.15), (-0.5, 0, top), (0, 1, 0), 0.16, steel),
            boxes((0.1, 0, 0.55), (0.5, 0.6, 0.5), white),
            tubes((0, 0, 0), (0, 0, top), 0.12, concrete, 20),
            _yoke(axis_m, top + 0.08, skins),
        ]
    )


def _land(rng: np.random.Generator, palette: Palette, concrete: int) -> Mesh:
    """Build open ground with a path, distant buildings, trees and hills."""
    small = np.diag([0.4, 0.4, 0.4, 1.0])
    family = str(rng.choice(["grass", "grass", "gravel", "soil"]))
    path = boxes((1.0, 8.0, 0.0), (0.9, 17.0, 0.02), concrete).transform(
        rotation((0, 0, 1), rng.uniform(0, 360))
    )
    return join_meshes(
        [
            terrain(rng, palette, family, extent_m=110, bumps_m=0.6, flat_radius_m=17),
            path,
            trees(rng, palette, draw_spots(rng, 16, 14, 60), height_m=(1.5, 3.5)),
            bushes(rng, palette, draw_spots(rng, 12, 4 / 0.4, 30 / 0.4)).transform(small),
            houses(rng, palette, draw_spots(rng, 3, 22 / 0.4, 50 / 0.4)).transform(small),
            hills(rng, palette, distance_m=rng.uniform(80, 120)),
        ]
    )
