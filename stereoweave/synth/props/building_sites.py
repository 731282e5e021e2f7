"""Building sites near a town, with a concrete shell, scaffolding, site offices and a hoarding."""

import numpy as np

from stereoweave.synth.props.lattice import bars, galvanised_steel, painted_steel, railing
from stereoweave.synth.props.primitives import boxes, lathe
from stereoweave.synth.props.surroundings import draw_spots, hills, houses, pallets, terrain, trees
from stereoweave.synth.stage import Palette
from stereoweave.synth.world import Colour, Material, Mesh, join_meshes

SCALE = 0.4  # scale of the surroundings, which matches the reduced size of the crane
BAY_M, STOREY_M = 0.95, 0.52


def building_site(rng: np.random.Generator, palette: Palette) -> Mesh:
    """Build a site with its concrete shell at negative y.

    Cameras at positive y see the shell behind the crane.
    """
    small = np.diag([SCALE, SCALE, SCALE, 1.0])
    town = draw_spots(rng, 20, 17 / SCALE, 60 / SCALE)
    stacks = draw_spots(rng, 7, 2 / SCALE, 5 / SCALE)
    return join_meshes(
        [
            terrain(rng, palette, str(rng.choice(["grass", "asphalt"])), extent_m=110, flat_radius_m=14),
            _yard(rng, palette),
            _shell(rng, palette).translate(rng.uniform(-1.8, 0.2), rng.uniform(-3.6, -2.9)),
            _huts(rng, palette),
            _hoarding(rng, palette),
            _heaps(rng, palette),
            pallets(rng, palette, stacks).transform(small),
            houses(rng, palette, town).transform(small),
            trees(rng, palette, draw_spots(rng, 18, 13, 60), height_m=(1.6, 3.6)),
            hills(rng, palette, distance_m=rng.uniform(85, 130)),
        ]
    )


def _yard(rng: np.random.Generator, palette: Palette) -> Mesh:
    """Build the bare ground of the site."""
    family = str(rng.choice(["soil", "gravel", "gravel"]))
    ground = palette.add(Material(texture=family, variant=int(rng.integers(64)), span_m=2.5, relief=0.6))
    return boxes((0, 2, 0.0), (19, 17, 0.03), ground)


def _shell(rng: np.random.Generator, palette: Palette) -> Mesh:
    """Build a concrete shell under construction.

    The shell has a core, slabs on columns, starter bars, props, railings and scaffolding.
    """
    concrete = palette.add(
        Material(texture="concrete", variant=int(rng.integers(8)), span_m=1.6, roughness=0.9)
    )
    rust = palette.add(Material(texture="rust", variant=int(rng.integers(8)), span_m=0.5))
    board = palette.add(
        Material(texture="wood", variant=int(rng.integers(8)), tint=(0.85, 0.65, 0.35), span_m=1.0)
    )
    tube = palette.add(galvanised_steel(rng))
    bays, deep, floors = int(rng.integers(3, 6)), 2, int(rng.integers(2, 5))
    x = (np.arange(bays + 1) - bays / 2) * BAY_M
    y = (np.arange(deep + 1) - deep / 2) * BAY_M
    levels = np.arange(1, floors + 1) * STOREY_M
    size = np.array([bays * BAY_M + 0.25, deep * BAY_M + 0.25, 0.075])
    feet = np.stack(np.meshgrid(x, y, np.arange(floors) * STOREY_M), -1).reshape(-1, 3)
    top = np.stack(np.meshgrid(x, y, [floors * STOREY_M]), -1).reshape(-1, 3)
    edge = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [-1, -1, 0]]) * (size / 2 - 0.03)
    core = np.array([BAY_M, 0.8 * BAY_M, (floors + 0.8) * STOREY_M])
    parts = [
        boxes(levels[:, None] * [0, 0, 1] - [0, 0, 0.037], size, concrete),
        boxes(feet + [0, 0, (STOREY_M - 0.075) / 2], (0.1, 0.1, STOREY_M - 0.07), concrete),
        boxes(core * [0.5, 0, 0.5] + [x[0] + 0.3 * BAY_M, 0.0, 0], core, concrete),
        boxes((0, 0, 0.0), size * [1.1, 1.15, 1], concrete),
        bars(_starters(top), 0.006, rust, sides=4),
        boxes(top[: len(top) // 2] + [0, 0, 0.17], (0.14, 0.14, 0.3), board),
        bars(_props(rng, x, y, levels[-1] - STOREY_M), 0.009, rust, sides=4),
        railing(edge + [0, 0, levels[-1]], 0.2, 0.35, 0.007, board),
        _scaffolding(size, floors, tube, board),
    ]
    return join_meshes(parts)


def _starters(tops: np.ndarray) -> np.ndarray:
    """Return the starter bars on top of the columns as segments [N, 2, 3]."""
    around = np.array([(a, b, 0.0) for a in (-0.035, 0.0, 0.035) for b in (-0.035, 0.035)])
    feet = (tops[:, None] + around).reshape(-1, 3)
    return np.stack([feet, feet + [0, 0, 0.36]], 1)


def _props(rng: np.random.Generator, x: np.ndarray, y: np.ndarray, floor_m: float) -> np.ndarray:
    """Return the props below the highest slab as segments [N, 2, 3]."""
    at = rng.uniform((x[0], y[0], 0), (x[-1], y[-1], 0), (40, 3)) + [0, 0, floor_m]
    return np.stack([at, at + [0, 0, STOREY_M - 0.07]], 1)


def _scaffolding(size_m: np.ndarray, floors: int, tube: int, board: int) -> Mesh:
    """Build scaffolding with standards, ledgers, braces and planks in front of the shell's visible side."""
    x = np.linspace(-size_m[0] / 2, 0.1 * size_m[0], 6)
    y = size_m[1] / 2 + np.array([0.06, 0.3])
    z = np.arange(0, floors + 1) * STOREY_M
    feet = np.stack(np.meshgrid(x, y, [0.0]), -1).reshape(-1, 3)
    rows = np.stack(np.meshgrid([0.0], y, np.concatenate([z[1:], z[1:] + 0.2])), -1).reshape(-1, 3)
    cross = np.stack(np.meshgrid(x, [y[0]], z[1:]), -1).reshape(-1, 3)
    brace = np.stack(np.meshgrid(x[:-1:2], [y[1]], z[:-1]), -1).reshape(-1, 3)
    planks = z[1:, None] * [0, 0, 1] + [(x[0] + x[-1]) / 2, y.mean(), 0.012]
    segments = [
        (feet, feet + [0, 0, z[-1] + 0.3]),
        (rows + [x[0], 0, 0], rows + [x[-1], 0, 0]),
        (cross, cross + [0, 0.24, 0]),
        (brace, brace + [x[1] - x[0], 0, STOREY_M]),
    ]
    frame = np.concatenate([np.stack(ends, 1) for ends in segments])
    return join_meshes([bars(frame, 0.009, tube, sides=4), boxes(planks, (x[-1] - x[0], 0.22, 0.014), board)])


def _huts(rng: np.random.Generator, palette: Palette) -> Mesh:
    """Build two storeys of site offices with windows."""
    tints: tuple[Colour, ...] = ((0.75, 0.75, 0.72), (0.2, 0.32, 0.45), (0.62, 0.5, 0.2))
    wall = palette.add(painted_steel(rng, tints[int(rng.integers(3))], roughness=0.7))
    glass = palette.add(Material(texture="plain", tint=(0.06, 0.08, 0.1), roughness=0.15))
    at = np.array([(a, 0, b) for a in (-1.25, 0, 1.25) for b in (0.22, 0.68)])
    rows = np.array([(a, 0.24, 0.05) for a in (-0.35, 0.1, 0.4)])
    panes = (at[:, None] + rows).reshape(-1, 3)
    huts = [boxes(at, (1.22, 0.48, 0.43), wall), boxes(panes, (0.2, 0.02, 0.15), glass)]
    roofs = boxes(at + [0, 0, 0.22], (1.24, 0.52, 0.02), glass)
    return join_meshes([*huts, roofs]).translate(rng.choice([-4.6, 4.4]), rng.uniform(-4.2, -2.5))


def _hoarding(rng: np.random.Generator, palette: Palette) -> Mesh:
    """Build a hoarding of slightly uneven boards behind the site."""
    wood = palette.add(
        Material(texture="wood", variant=int(rng.integers(8)), tint=(0.75, 0.72, 0.66), span_m=1.5)
    )
    x = np.arange(-8.5, 8.6, 0.5)
    at = np.stack([x, -6.4 + rng.normal(0, 0.015, len(x)), np.full_like(x, 0.35)], -1)
    return join_meshes(
        [boxes(at, (0.49, 0.03, 0.8), wood), boxes(at - [0.25, 0.05, 0], (0.06, 0.06, 0.84), wood)]
    )


def _heaps(rng: np.random.Generator, palette: Palette) -> Mesh:
    """Build heaps of sand."""
    sand = palette.add(
        Material(texture="soil", variant=int(rng.integers(8)), tint=(1.0, 0.9, 0.7), span_m=0.7, relief=0.6)
    )
    heap = lathe([(0.75, -0.05), (0.45, 0.2), (0.2, 0.36), (0.08, 0.4), (0, 0.41)], sand, 24, crease_deg=60)
    spots = draw_spots(rng, 3, 2.4, 5.5)
    return join_meshes([heap.translate(x, y) for x, y, _ in spots])
