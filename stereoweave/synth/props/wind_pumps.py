"""Wind pumps with a wheel of sheet-iron blades, a tail, a lattice tower and a water tank."""

from typing import NamedTuple

import numpy as np

from stereoweave.synth.props.lattice import (
    bars,
    chain_segments,
    galvanised_steel,
    ladder,
    mast_levels,
    mast_rings,
    painted_steel,
    railing,
    truss,
)
from stereoweave.synth.props.primitives import boxes, copies, lathe, rotation, sheet, spheres, tubes
from stereoweave.synth.stage import Palette
from stereoweave.synth.world import Material, Mesh, join_meshes


class WindPump(NamedTuple):
    """Wind pump around the z axis, with its wheel facing +x.

    Attributes:
        mesh: wheel, tail, tower and tank.
        top_m: height of the wheel's upper edge.
    """

    mesh: Mesh
    top_m: float


def wind_pump(rng: np.random.Generator, palette: Palette) -> WindPump:
    """Build a random wind pump about 5 m high."""
    steel = palette.add(galvanised_steel(rng))
    blades = palette.add(
        galvanised_steel(rng) if rng.random() < 0.6 else painted_steel(rng, (0.7, 0.68, 0.62))
    )
    tail = palette.add(painted_steel(rng, (0.5, 0.08, 0.05)))
    rust = palette.add(Material(texture="rust", variant=int(rng.integers(8)), span_m=1.0))
    hub, radius = rng.uniform(3.9, 4.4), rng.uniform(0.95, 1.3)
    mesh = join_meshes(
        [
            _wheel(rng, radius, (blades, tail, steel)).translate(0.3, 0, hub),
            _tail(rng, radius, (tail, steel)).translate(0, 0, hub),
            _tower(hub - 0.12, steel, rust),
            _tank(rng, palette, steel, rust),
        ]
    )
    return WindPump(mesh, hub + radius)


def _wheel(rng: np.random.Generator, radius_m: float, skins: tuple[int, int, int]) -> Mesh:
    """Build a wheel around the x axis, with angled, curved blades, two rings, spokes and a hub."""
    blades, marked, steel = skins
    count = int(rng.choice([12, 15, 18]))
    share = np.linspace(0, 1, 5)[:, None]
    width = (0.42 + 0.5 * share) * 2 * np.pi * radius_m / count * 0.95
    across = np.linspace(-0.5, 0.5, 5)[None]
    z = radius_m * (0.4 + 0.6 * share) + 0 * across
    bowl = 0.3 * width * (0.25 - across**2)
    tilt = np.radians(28)
    y = across * width * np.cos(tilt) - bowl * np.sin(tilt)
    x = across * width * np.sin(tilt) + bowl * np.cos(tilt)
    blade = np.stack([x, y, z], -1)
    both = [sheet(blade, blades), sheet(blade[:, ::-1] - [0.006, 0, 0], blades)]
    turns = np.stack([rotation((1, 0, 0), 360 * (k + rng.uniform(0, 0.02)) / count) for k in range(count)])
    angle = np.linspace(0, 2 * np.pi, 4 * count + 1)
    circle = np.column_stack([0 * angle, np.cos(angle), np.sin(angle)])
    hoops = np.stack([circle * 0.46 * radius_m - [0.02, 0, 0], circle * 0.86 * radius_m - [0.05, 0, 0]])
    spokes = circle[: 4 * 6 * (count // 6) : 4 * (count // 6)]
    starts = np.concatenate([spokes * 0.06, spokes * 0.06 - [0.16, 0, 0]])
    ends = np.tile(spokes * 0.86 * radius_m - [0.05, 0, 0], (2, 1))
    hub = lathe([(0, -0.2), (0.08, -0.2), (0.08, 0.02), (0.04, 0.08), (0, 0.09)], marked, 20)
    return join_meshes(
        [
            copies(join_meshes(both), turns),
            bars(chain_segments(hoops), 0.011, steel),
            bars(np.stack([starts, ends], 1), 0.01, steel),
            hub.transform(rotation((0, 1, 0), 90)),
        ]
    )


def _tail(rng: np.random.Generator, radius_m: float, skins: tuple[int, int]) -> Mesh:
    """Build the gear case, the boom and the vane."""
    vane, steel = skins
    end = -1.25 * radius_m
    half = rng.uniform(0.26, 0.34)
    boom = np.array(
        [
            [(0.15, 0, 0.0), (end, 0, 0.0)],
            [(0, 0, 0.16), (0.75 * end, 0, 0.0)],
            [(0, 0, -0.16), (0.75 * end, 0, 0.0)],
        ]
    )
    outline = np.array(
        [[(0.55 * end, -0.5 * half), (1.3 * end, -half)], [(0.55 * end, 0.5 * half), (1.3 * end, half)]]
    )
    board = np.insert(outline, 1, 0.012, axis=2)
    return join_meshes(
        [
            boxes((0.05, 0, 0), (0.26, 0.2, 0.26), vane),
            bars(boom, 0.014, steel),
            sheet(board, vane),
            sheet(board[:, ::-1] * [1, -1, 1], vane),
        ]
    )


def _tower(top_m: float, steel: int, rust: int) -> Mesh:
    """Build a tower of four braced legs, with a platform, a railing, a ladder, a pump rod and footings."""
    joints = mast_rings(*mast_levels((0.0, top_m), (1.3, 0.14), 0.9))
    deck = 0.86 * top_m
    rim = 0.28 * np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0], [1, 1, 0]])
    return join_meshes(
        [
            truss(joints, "cross").mesh(0.02, 0.0085, steel),
            boxes((0, 0, deck), (0.58, 0.58, 0.02), rust),
            railing(rim + [0, 0, deck], 0.2, 0.3, 0.006, steel),
            ladder((0, 0.64, 0.05), (0, 0.15, deck), (1, 0, 0), 0.11, steel),
            tubes((0, 0, 0.05), (0, 0, top_m), 0.011, rust),
            tubes((0, 0, 0.0), (0, 0, 0.5), 0.045, rust, 12),
            boxes(joints[0], (0.16, 0.16, 0.12), rust),
        ]
    )


def _tank(rng: np.random.Generator, palette: Palette, steel: int, rust: int) -> Mesh:
    """Build a corrugated water tank with a pipe, and a trough."""
    water = palette.add(Material(texture="water", tint=(0.3, 0.38, 0.36), roughness=0.1, relief=0.1))
    radius, height = rng.uniform(0.55, 0.8), rng.uniform(0.5, 0.75)
    z = np.linspace(0, height, 25)
    wall = np.column_stack([radius + 0.012 * np.sin(np.arange(25) * np.pi / 2), z])
    inside = np.array([[radius - 0.02, height], [radius - 0.02, height - 0.12]])
    tank = lathe(np.concatenate([[[radius, -0.1]], wall, inside]), steel, 40)
    surface = lathe([(radius - 0.01, height - 0.08), (0, height - 0.08)], water, 32)
    x, y = -0.4, float(rng.choice([-1, 1])) * (radius + 0.95)
    pipe = np.array([[0, 0, height + 0.14], [x, y * 0.8, height + 0.14], [x, y * 0.8, height - 0.02]])
    return join_meshes(
        [
            join_meshes([tank, surface]).translate(x, y),
            bars(chain_segments(pipe[None]), 0.02, rust, sides=8),
            spheres(pipe[1], 0.024, rust, 1),
            tubes((0, 0, 0.4), (0, 0, height + 0.14), 0.02, rust, 8),
            boxes((x + 1.1, y, 0.1), (0.9, 0.3, 0.2), rust),
            boxes((x + 1.1, y, 0.195), (0.82, 0.24, 0.02), water),
        ]
    )
