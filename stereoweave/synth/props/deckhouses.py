"""Deckhouses, funnels, masts, lifebuoys and fenders for ships. The bow is at +x."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.lattice import poses_towards
from stereoweave.synth.props.primitives import (
    Point,
    Points,
    boxes,
    copies,
    facets,
    lathe,
    loft,
    rotation,
    spheres,
    tubes,
)
from stereoweave.synth.world import Mesh, join_meshes

Quads = Float[np.ndarray, "n 4 3"]

# Offsets from the wall, large enough to keep wall, frame and glass in depth order at any distance.
_FRAME_M, _GLASS_M = 0.006, 0.012


@dataclass(frozen=True, kw_only=True)
class ShipMaterials:
    """Materials of a ship.

    Attributes:
        house: walls of the deckhouses.
        roof: roofs and decks.
        trim: second colour, for funnels, cranes and doors.
        white: light paint for masts and canisters.
        dark: black paint and rubber.
        glass: window panes.
        steel: bare or galvanised metal.
        orange: lifesaving gear.
        rope: ropes and nets.
    """

    house: int
    roof: int
    trim: int
    white: int
    dark: int
    glass: int
    steel: int
    orange: int
    rope: int


@dataclass(frozen=True, kw_only=True)
class House:
    """Block with sloping walls on a deck.

    Attributes:
        x_m: aft and forward ends of the foot.
        width_m: width of the foot.
        z_m: heights of the foot and the top.
        lean_m: inward lean of the aft, forward and side walls at the top; negative values lean outwards.
    """

    x_m: tuple[float, float]
    width_m: float
    z_m: tuple[float, float]
    lean_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def corners_m(self, spare_m: float = 0.0) -> tuple[Points, Points]:
        """Return the corners of the foot and the top, each [4, 3] and moved outwards by spare_m.

        The order is aft starboard, forward starboard, forward port and aft port.
        """
        aft, forward, side = self.lean_m
        half = self.width_m / 2 + spare_m
        low = [(self.x_m[0] - spare_m, -half), (self.x_m[1] + spare_m, -half)]
        high = [(low[0][0] + aft, side - half), (low[1][0] - forward, side - half)]
        foot, top = (
            np.array([(*a, z), (*b, z), (b[0], -b[1], z), (a[0], -a[1], z)])
            for (a, b), z in zip((low, high), self.z_m, strict=True)
        )
        return foot, top

    def walls_m(self) -> Quads:
        """Return the starboard, forward, port and aft walls.

        Each wall starts at its lower-left corner, as seen from outside.
        """
        foot, top = self.corners_m()
        return np.stack([foot, np.roll(foot, -1, 0), np.roll(top, -1, 0), top], 1)

    def mesh(self, walls: int, roof: int, eaves_m: float = 0.05) -> Mesh:
        """Build the walls and an overhanging roof."""
        _, top = self.corners_m(eaves_m)
        return join_meshes([_quads(self.walls_m(), walls), slab(top, top + [0, 0, 0.05], roof)])


def slab(low_m: Points, high_m: Points, material: int) -> Mesh:
    """Build a solid between two quads, both counter-clockwise when seen from above."""
    sides = np.stack([low_m, np.roll(low_m, -1, 0), np.roll(high_m, -1, 0), high_m], 1)
    return _quads(np.concatenate([sides, high_m[None], low_m[None, ::-1]]), material)


def windows(
    wall_m: Float[np.ndarray, "4 3"],
    count: int,
    band: tuple[float, float],
    materials: ShipMaterials,
    gap: float = 0.25,
) -> Mesh:
    """Build a row of framed panes on a wall.

    band: lower and upper edges of the panes, as fractions of the wall's height.
    """
    edges = np.linspace(0.06, 0.94, count + 1)
    half = gap / 2 * (edges[1] - edges[0])
    left, right = edges[:-1] + half, edges[1:] - half
    frame_share = 0.08 * (right - left)[:1]
    tall = 0.08 * (band[1] - band[0])
    frames = _quads_on_wall(
        wall_m, (left - frame_share, right + frame_share), (band[0] - tall, band[1] + tall), _FRAME_M
    )
    panes = _quads_on_wall(wall_m, (left, right), band, _GLASS_M)
    return join_meshes([_quads(frames, materials.dark), _quads(panes, materials.glass)])


def door(wall_m: Float[np.ndarray, "4 3"], at: float, materials: ShipMaterials) -> Mesh:
    """Build a door with a small window; `at` is the door's position as a fraction of the wall's length."""
    length, height = (float(np.linalg.norm(wall_m[k] - wall_m[0])) for k in (1, 3))
    half = 0.3 * min(height, 1.0) / length
    leaf = _quads_on_wall(wall_m, (np.array([at - half]), np.array([at + half])), (0.06, 0.82), _FRAME_M)
    pane = _quads_on_wall(
        wall_m, (np.array([at - half / 2]), np.array([at + half / 2])), (0.55, 0.72), _GLASS_M
    )
    return join_meshes([_quads(leaf, materials.trim), _quads(pane, materials.glass)])


def funnel(foot_m: Point, size_m: tuple[float, float, float], materials: ShipMaterials) -> Mesh:
    """Build an oval funnel that leans aft, with a band and a dark top.

    size_m: length, width and height.
    """
    length, width, height = size_m
    angle = np.linspace(0, 2 * np.pi, 28, endpoint=False)
    oval = np.stack([length / 2 * np.cos(angle), width / 2 * np.sin(angle), 0 * angle], -1)

    def ring(share: float) -> Points:
        return foot_m + oval * (1 - 0.12 * share) + [-0.22 * height * share, 0, height * share]

    bands = ((0, 0.42, materials.house), (0.42, 0.72, materials.trim), (0.72, 1, materials.dark))
    body = [loft(np.stack([ring(a), ring(b)]), paint) for a, b, paint in bands]
    top = foot_m + [-0.22 * height, 0, height]
    pipes = tubes(
        top + np.array([[0.15 * length, 0, -0.1], [-0.15 * length, 0, -0.1]]),
        top + np.array([[0.1 * length, 0, 0.14], [-0.25 * length, 0, 0.16]]),
        0.045,
        materials.dark,
        sides=12,
    )
    return join_meshes([*body, pipes])


def ship_mast(rng: np.random.Generator, foot_m: Point, height_m: float, materials: ShipMaterials) -> Mesh:
    """Build a mast with crosstrees, a radar, lights and aerials."""
    top = foot_m + [-0.06 * height_m, 0, height_m]
    pole = tubes(foot_m, top, np.array([[0.06, 0.03]]), materials.white, sides=14)
    legs = tubes(
        foot_m + np.array([[-0.45, 0.3, 0], [-0.45, -0.3, 0]]),
        foot_m + 0.75 * (top - foot_m),
        0.022,
        materials.white,
    )
    levels = np.array([0.5, 0.72, 0.9])
    at = foot_m + levels[:, None] * (top - foot_m)
    reach = np.array([[0, 0.55, 0], [0, 0.4, 0], [0, 0.28, 0]])
    yards = tubes(at - reach, at + reach, 0.016, materials.white)
    whips = np.concatenate([at - reach, at + reach, [top]])
    aerials = tubes(
        whips, whips + [0, 0, 1] * rng.uniform(0.25, 0.8, (7, 1)), 0.007, materials.white, sides=5
    )
    lights = spheres(at + [0.05, 0, 0.06], 0.035, materials.glass, 1)
    ball = spheres(at[0] + [0.0, 0.35, 0.14], 0.12, materials.white, 2)
    return join_meshes(
        [pole, legs, yards, aerials, lights, ball, _radar(rng, at[1] + [0.14, 0, 0.04], materials)]
    )


def _radar(rng: np.random.Generator, at_m: Point, materials: ShipMaterials) -> Mesh:
    """Build a radar scanner on a pedestal and a bracket in front of the mast."""
    spin = rotation((0, 0, 1), rng.uniform(0, 180))[None, :3, :3]
    bar = boxes(at_m + [0, 0, 0.14], (0.07, 0.75, 0.07), materials.white, spin)
    bracket = boxes(at_m + [-0.06, 0, -0.02], (0.24, 0.1, 0.03), materials.white)
    return join_meshes(
        [bar, bracket, lathe([(0.07, 0), (0.05, 0.1), (0, 0.1)], materials.white, 12).translate(*at_m)]
    )


def stays(tops_m: Points, feet_m: Points, materials: ShipMaterials) -> Mesh:
    """Build wires between pairs of points."""
    return tubes(tops_m, feet_m, 0.006, materials.steel, sides=4)


def lifebuoys(at_m: Points, outwards: Points, materials: ShipMaterials) -> Mesh:
    """Build lifebuoys facing the directions `outwards`, each with four orange and four white segments."""
    angle = np.linspace(0, 2 * np.pi, 9)
    ring = lathe(
        np.stack([0.15 + 0.04 * np.cos(angle), 0.04 * np.sin(angle)], -1), materials.orange, sections=24
    )
    x, y, _ = ring.corners_m.mean(1).T
    white = np.arctan2(y, x) % (np.pi / 2) < np.pi / 6
    ring = replace(ring, material=np.where(white, materials.white, ring.material).astype(np.int32))
    return copies(ring, poses_towards(at_m, outwards))


def tyres(at_m: Points, along: Points, materials: ShipMaterials) -> Mesh:
    """Build car tyres that lie flat against a hull; `along` is the direction of the hull."""
    angle = np.linspace(0, 2 * np.pi, 9)
    profile = np.stack([0.17 + 0.055 * np.cos(angle), 0.06 * np.sin(angle)], -1)
    tyre = lathe(profile, materials.dark, sections=18)
    return copies(tyre, poses_towards(at_m, np.cross(along, [0.0, 0.0, 1.0])))


def _quads_on_wall(
    wall_m: Float[np.ndarray, "4 3"],
    across: tuple[np.ndarray, np.ndarray],
    up: tuple[float, float],
    off_m: float,
) -> Quads:
    """Return quads that lie off_m in front of a wall.

    across: left and right edges of the quads, as fractions of the wall's length.
    up: lower and upper edges of the quads, as fractions of the wall's height.
    """
    a, b, c, d = wall_m
    out = np.cross(b - a, d - a)
    out = off_m * out / np.linalg.norm(out)

    def place(u: np.ndarray, v: float) -> Points:
        u = u[:, None]
        return (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * d + u * c) + out

    left, right = across
    return np.stack([place(left, up[0]), place(right, up[0]), place(right, up[1]), place(left, up[1])], 1)


def _quads(quads_m: Quads, material: int) -> Mesh:
    return facets(quads_m[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3), material)
