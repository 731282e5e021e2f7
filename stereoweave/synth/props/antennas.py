"""Antennas of several kinds, mounted at the origin. Directional antennas point along +x."""

import numpy as np

from stereoweave.synth.props.lattice import bars, chain_segments
from stereoweave.synth.props.primitives import boxes, lathe, rotation, spheres, tubes
from stereoweave.synth.world import Mesh, join_meshes

FORWARD = rotation((0, 1, 0), 90)  # rotates z onto x


def panel(height_m: float, cover: int, steel: int) -> Mesh:
    """Build a sector antenna to mount in front of a pole, with brackets, a radio unit and cables."""
    half = height_m / 2
    brackets = np.array([[(-0.08, 0, z), (0.03, 0, z)] for z in (-0.7 * half, 0.7 * half)])
    leads = np.array(
        [
            [(0.06, y, -half), (0.05, y, -half - 0.08), (-0.03, y, -half - 0.12), (-0.1, y, -half + 0.05)]
            for y in (-0.03, 0.0, 0.03)
        ]
    )
    angle = np.linspace(-np.pi / 2, np.pi / 2, 9)
    front = np.column_stack([0.055 + 0.05 * np.cos(angle), 0.075 * np.sin(angle), 0 * angle])
    return join_meshes(
        [
            tubes((0.06, 0, -half), (0.06, 0, half), 0.055, cover, 12),
            boxes((0.03, 0, 0), (0.06, 0.15, height_m), cover),
            boxes((front[0, 0], 0, -half), (0.09, 0.13, 0.02), steel),
            bars(brackets, 0.014, steel),
            boxes((-0.12, 0, -0.3 * half), (0.07, 0.14, 0.45 * half), cover),
            bars(chain_segments(leads), 0.006, steel, sides=4),
        ]
    )


def drum(radius_m: float, cover: int, steel: int) -> Mesh:
    """Build a shrouded microwave dish with a domed cover and a bracket."""
    r, depth = radius_m, 0.75 * radius_m
    profile = np.array(
        [
            (0, 0.02),
            (0.35 * r, 0.02),
            (0.97 * r, 0.35 * depth),
            (r, 0.4 * depth),
            (r, depth),
            (1.03 * r, depth),
        ]
    )
    bulge = np.array(
        [
            (1.03 * r, depth + 0.02),
            (0.97 * r, depth + 0.03),
            (0.6 * r, depth + 0.07 * r),
            (0, depth + 0.1 * r),
        ]
    )
    return join_meshes(
        [
            lathe(np.concatenate([profile, bulge]), cover, 28).transform(FORWARD),
            lathe([(0, -0.12), (0.22 * r, -0.12), (0.25 * r, 0.03), (0, 0.03)], steel, 16).transform(FORWARD),
            bars(np.array([[(-0.12, 0, 0), (0.02, 0, 0)]]), 0.025, steel),
        ]
    )


def paraboloid(radius_m: float, focal_m: float, skin: int, back: int, sections: int = 32) -> Mesh:
    """Build a paraboloid around z, with its vertex at the origin and its focus at z = focal_m."""
    radius = np.linspace(0, radius_m, 9)
    front = np.column_stack([radius, radius**2 / (4 * focal_m)])
    thick = 0.018 * radius_m + 0.004
    behind = np.concatenate([front - [0, thick], front[-1:] + [[0.01 * radius_m, 0]]])
    return join_meshes(
        [lathe(behind, back, sections), lathe(np.concatenate([behind[-1:], front[::-1]]), skin, sections)]
    )


def satellite_dish(radius_m: float, cover: int, steel: int) -> Mesh:
    """Build a satellite television dish, tilted up by 30 degrees, with its receiver on an arm."""
    focal = 1.25 * radius_m
    rim = radius_m**2 / (4 * focal)
    arm = np.array(
        [
            [(-radius_m, 0, rim - 0.02), (-0.25 * radius_m, 0, focal)],
            [(0.3 * radius_m, 0, rim / 9), (-0.2 * radius_m, 0, focal)],
        ]
    )
    dish = join_meshes(
        [
            paraboloid(radius_m, focal, cover, cover),
            bars(arm[:1], 0.009, steel, sides=4),
            tubes((-0.22 * radius_m, 0, focal + 0.03), (-0.18 * radius_m, 0, focal - 0.06), 0.025, steel, 10),
        ]
    )
    tilted = dish.transform(rotation((0, 1, 0), 60)).translate(0.1)
    return join_meshes([tilted, bars(np.array([[(0, 0, 0), (0.12, 0, 0)]]), 0.02, steel)])


def yagi(length_m: float, count: int, steel: int, end: int) -> Mesh:
    """Build a Yagi antenna with a folded dipole and a rod reflector.

    The directors get shorter towards the front.
    """
    x = np.linspace(0.12, 1, count) * length_m - 0.3 * length_m
    half = np.linspace(0.5, 0.36, count) * 0.32
    rods = np.stack([np.stack([x, side * half, 0 * x + 0.012], -1) for side in (-1, 1)], 1)
    back = -0.3 * length_m
    z = np.array([-0.16, -0.1, -0.04, 0.04, 0.1, 0.16])
    grid = np.stack([np.column_stack([back + 0.3 * abs(z), 0 * z + side * 0.2, z]) for side in (-1, 1)], 1)
    spars = np.array([[(back, 0, 0), (back + 0.05, 0, side * 0.17)] for side in (-1, 1)])
    loop = np.array([(0, -0.15, 0), (0, 0.15, 0), (0, 0.15, 0.035), (0, -0.15, 0.035), (0, -0.15, 0)]) + [
        back + 0.07 * length_m,
        0,
        0,
    ]
    boom = np.array([[(back - 0.03, 0, 0), (0.7 * length_m, 0, 0)]])
    return join_meshes(
        [
            bars(boom, 0.011, steel),
            bars(np.concatenate([rods, grid, spars, chain_segments(loop[None])]), 0.0045, steel, sides=4),
            boxes(loop[0] + [0, 0.15, -0.01], (0.06, 0.05, 0.05), end),
            boxes((0, 0, -0.01), (0.06, 0.06, 0.05), end),
        ]
    )


def whip(height_m: float, cover: int, steel: int) -> Mesh:
    """Build a whip antenna: an upright rod on a short mount."""
    return join_meshes(
        [
            tubes((0, 0, 0), (0, 0, height_m), np.array([[0.014, 0.007]]), cover, 8),
            tubes((0, 0, -0.06), (0, 0, 0.1), 0.022, steel, 8),
            spheres((0, 0, height_m), 0.01, steel, 1),
        ]
    )


def dipoles(count: int, steel: int) -> Mesh:
    """Build a column of folded dipoles on a pole."""
    angle = np.linspace(0, 2 * np.pi, 13)
    loop = np.column_stack([0.14 + 0.03 * np.cos(angle), 0 * angle, 0.15 * np.sin(angle)])
    z = (np.arange(count) * 0.42)[:, None, None] * [0.0, 0, 1]
    arms = np.concatenate([z + [[0, 0, 0]], z + [[0.11, 0, 0]]], 1)
    pole = np.array([[(0, 0, -0.2), (0, 0, 0.42 * count - 0.1)]])
    return join_meshes(
        [
            bars(chain_segments(loop + z), 0.007, steel, sides=4),
            bars(arms, 0.01, steel),
            bars(pole, 0.016, steel),
        ]
    )
