"""Roof antennas: masts with Yagi antennas, dishes and whips among the chimneys of a flat roof in a town."""

import numpy as np

from stereoweave.synth.props.antennas import dipoles, panel, satellite_dish, whip, yagi
from stereoweave.synth.props.lattice import bars, cables, galvanised_steel, painted_steel
from stereoweave.synth.props.primitives import boxes, lathe, rotation, sweep, tubes
from stereoweave.synth.props.surroundings import daylight, draw_spots, hills, houses, terrain, trees
from stereoweave.synth.stage import Palette, Stage, outdoor_stage
from stereoweave.synth.viewpoints import Orbit
from stereoweave.synth.world import Material, Mesh, join_meshes

STREET_M = -8.0  # height of the street; the roof is at 0
SPOTS_M = np.array([(0.1, 0.2, 0), (0.7, -1.5, 0), (0.5, 1.7, 0), (-1.1, -0.8, 0), (-1.2, 1.0, 0)])


def roof_antennas(rng: np.random.Generator) -> Stage:
    """Build a stage with five antenna masts, 1.9 to 3.3 m tall."""
    palette = Palette()
    steel, other = palette.add(galvanised_steel(rng)), palette.add(galvanised_steel(rng))
    grey = rng.uniform(0.5, 0.8)
    cover = palette.add(Material(texture="plain", tint=(grey, grey, 0.98 * grey), roughness=0.5))
    dark = palette.add(Material(texture="plain", tint=(0.06, 0.06, 0.065), roughness=0.6))
    heights = rng.permutation(np.linspace(1.9, 3.3, len(SPOTS_M)))
    feet = SPOTS_M + rng.uniform(-0.2, 0.2, SPOTS_M.shape) * [1, 1, 0]
    masts = [
        _mast(rng, height, (steel, cover, dark), other).translate(*foot)
        for height, foot in zip(heights, feet, strict=True)
    ]
    roof = _roof(rng, palette, feet, dark)
    light = daylight(rng)
    mesh = join_meshes([join_meshes(masts).as_target(), roof, _town(rng, palette)])
    orbit = Orbit(
        centre_m=(0.0, 0.0, 1.6),
        distance_m=(4.5, 6.3),
        azimuth_deg=(-75, 75),
        elevation_deg=(-7, 14),
        aim_m=0.4,
        floor_m=0.9,
    )
    return outdoor_stage(mesh, palette, light, orbit)


def _mast(rng: np.random.Generator, height_m: float, skins: tuple[int, int, int], steel: int) -> Mesh:
    """Build a pole on a tripod or with guy wires, carrying a cable and a column of antennas."""
    mast, cover, dark = skins
    parts = [
        tubes((0, 0, 0), (0, 0, height_m), 0.022, mast, 10),
        boxes((0, 0, 0.02), (0.3, 0.3, 0.04), dark),
        tubes((0.026, 0.01, 0.02), (0.026, 0.01, 0.92 * height_m), 0.006, dark, 4),
        _stays(height_m, mast) if height_m > 2.2 else _tripod(mast),
    ]
    z, bearing = height_m - 0.08, rng.uniform(0, 360)
    if rng.random() < 0.35:
        parts.append(whip(rng.uniform(0.5, 0.9), cover, mast).translate(z=height_m))
    while z > 0.9:
        mesh, room = _draw_antenna(rng, (steel, cover, dark))
        parts.append(mesh.transform(rotation((0, 0, 1), bearing)).translate(z=z))
        z -= room * rng.uniform(1.0, 1.3)
        bearing += float(rng.choice([0, 25, 90, 180]))
    return join_meshes(parts)


def _draw_antenna(rng: np.random.Generator, skins: tuple[int, int, int]) -> tuple[Mesh, float]:
    """Draw an antenna; return its mesh and the length of mast that it occupies, in metres."""
    steel, cover, dark = skins
    kind = str(rng.choice(["yagi", "wide", "dish", "dipoles", "panel"], p=[0.4, 0.2, 0.24, 0.1, 0.06]))
    if kind == "yagi":
        return yagi(rng.uniform(0.8, 1.3), int(rng.integers(9, 16)), steel, dark), 0.5
    if kind == "wide":
        # An antenna for long waves has few rods, which are as long as its boom.
        broad = yagi(0.45, 4, steel, dark)
        return broad.transform(np.diag([2.2, 2.2, 2.2, 1.0])), 0.85
    if kind == "dish":
        return satellite_dish(rng.uniform(0.28, 0.46), cover, steel), 0.75
    if kind == "dipoles":
        return dipoles(2, steel).translate(0.08, 0, -0.7), 0.95
    return panel(0.55, cover, steel).translate(0.1, 0, -0.3), 0.8


def _stays(height_m: float, wire: int) -> Mesh:
    angle = np.radians([20, 140, 260])
    feet = 0.9 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    top = np.array([0, 0, 0.72 * height_m])
    return join_meshes([cables(top, feet, 0.004, wire, count=1), boxes(feet, (0.08, 0.08, 0.05), wire)])


def _tripod(steel: int) -> Mesh:
    angle = np.radians([0, 120, 240])
    feet = 0.4 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    return bars(np.stack([feet, np.broadcast_to([0, 0, 0.55], (3, 3))], 1), 0.014, steel)


def _roof(rng: np.random.Generator, palette: Palette, feet: np.ndarray, dark: int) -> Mesh:
    """Build the house with its parapet, chimneys, vents, rooftop stairwell, cooling units and cables."""
    gravel = palette.add(
        Material(
            texture=str(rng.choice(["gravel", "asphalt", "concrete"])),
            tint=(0.75, 0.74, 0.72),
            variant=int(rng.integers(8)),
            span_m=2.5,
        )
    )
    family = str(rng.choice(["brick", "plaster"]))
    wall = palette.add(
        Material(texture=family, variant=int(rng.integers(8)), tint=(0.85, 0.8, 0.74), span_m=2.0)
    )
    zinc = palette.add(galvanised_steel(rng))
    white = palette.add(painted_steel(rng, (0.75, 0.75, 0.72)))
    half = np.array([4.2, 3.6])
    sides = [((s * half[0], 0, 0.12), (0.22, 2 * half[1] + 0.22, 0.36)) for s in (1, -1)]
    sides += [((0, s * half[1], 0.12), (2 * half[0] + 0.22, 0.22, 0.36)) for s in (1, -1)]
    centres, sizes = (np.array(values) for values in zip(*sides, strict=True))
    return join_meshes(
        [
            boxes((0, 0, STREET_M / 2 - 0.01), (2 * half[0], 2 * half[1], -STREET_M), wall),
            boxes((0, 0, -0.02), (2 * half[0], 2 * half[1], 0.04), gravel),
            boxes(centres, sizes, wall),
            boxes(centres + [0, 0, 0.2], sizes * [1, 1, 0] + [0.06, 0.06, 0.05], zinc),
            _windows(half, dark, white),
            _chimneys(rng, wall, dark, zinc),
            boxes((-3.1, 1.6, 0.85), (1.5, 1.8, 1.7), wall),
            boxes((-3.1, 1.6, 1.74), (1.7, 2.0, 0.08), zinc),
            boxes((-2.34, 1.6, 0.72), (0.04, 0.7, 1.4), white),
            *[_cooler(white, dark).translate(-2.4, y) for y in (-1.0, -1.9)],
            *[_run(foot, dark) for foot in feet],
        ]
    )


def _windows(half_m: np.ndarray, dark: int, white: int) -> Mesh:
    """Build rows of windows in the front and side walls."""
    y, z = (values.ravel() for values in np.meshgrid(np.linspace(-2.8, 2.8, 5), [-1.7, -4.2, -6.7]))
    x = np.full_like(y, half_m[0])
    front = np.stack([x, y, z], -1)
    side = np.stack([y, x * half_m[1] / half_m[0], z], -1)
    return join_meshes(
        [
            boxes(front, (0.06, 0.9, 1.4), white),
            boxes(front, (0.08, 0.78, 1.28), dark),
            boxes(np.concatenate([side, side * [1, -1, 1]]), (0.9, 0.06, 1.4), white),
            boxes(np.concatenate([side, side * [1, -1, 1]]), (0.78, 0.08, 1.28), dark),
        ]
    )


def _chimneys(rng: np.random.Generator, wall: int, dark: int, zinc: int) -> Mesh:
    """Build a chimney stack with pots, and three ventilators."""
    x, y = -2.2, rng.uniform(-0.4, 0.4)
    pots = np.array([(x, y + d, 1.28) for d in (-0.3, 0.0, 0.3)])
    vent = lathe([(0.07, 0), (0.07, 0.35), (0.13, 0.36), (0.15, 0.42), (0.1, 0.52), (0, 0.54)], zinc, 20)
    return join_meshes(
        [
            boxes((x, y, 0.6), (0.5, 1.05, 1.2), wall),
            boxes((x, y, 1.2), (0.6, 1.15, 0.08), wall),
            tubes(pots - [0, 0, 0.05], pots + [0, 0, 0.22], 0.09, dark, 12),
            *[vent.translate(a, b) for a, b in rng.uniform((-3.4, -3.0), (-1.6, 3.0), (3, 2))],
        ]
    )


def _cooler(white: int, dark: int) -> Mesh:
    """Build a cooling unit on feet, with its fan in front."""
    fan = lathe([(0.2, 0), (0.2, 0.03), (0.17, 0.035), (0, 0.02)], dark, 20)
    return join_meshes(
        [
            boxes((0, 0, 0.38), (0.32, 0.75, 0.55), white),
            fan.transform(rotation((0, 1, 0), 90)).translate(0.155, 0.1, 0.38),
            boxes([(0, y, 0.06) for y in (-0.28, 0.28)], (0.3, 0.06, 0.12), dark),
        ]
    )


def _run(foot_m: np.ndarray, dark: int) -> Mesh:
    """Build a cable on the roof from a mast to the rooftop stairwell."""
    share = np.linspace(0, 1, 14)[:, None]
    path = foot_m + share * (np.array([-2.36, 1.1, 0.02]) - foot_m) + [0, 0, 0.012]
    path[:, 1] += 0.25 * np.sin(share[:, 0] * 2 * np.pi)
    return sweep(path, 0.01, dark, 5)


def _town(rng: np.random.Generator, palette: Palette) -> Mesh:
    """Build houses and trees at street level, with hills behind them."""
    street = np.array([0, 0, STREET_M])
    return join_meshes(
        [
            terrain(
                rng,
                palette,
                str(rng.choice(["grass", "asphalt"])),
                extent_m=130,
                level_m=STREET_M,
                bumps_m=0.2,
                flat_radius_m=30,
            ),
            houses(rng, palette, draw_spots(rng, 24, 14, 70) + street),
            trees(rng, palette, draw_spots(rng, 16, 10, 60) + street, height_m=(4, 8)),
            hills(rng, palette, distance_m=rng.uniform(110, 150)).translate(z=STREET_M),
        ]
    )
