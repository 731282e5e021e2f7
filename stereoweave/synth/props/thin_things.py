"""Random thin objects about one metre in size, such as rods, lattices, fences, wheels and springs."""

import itertools

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.primitives import polyline_tubes, spheres, sweep, tubes
from stereoweave.synth.props.solids import PropBuilder, PropStyle, wander_m
from stereoweave.synth.world import Mesh, join_meshes


def rods(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a few bars in random directions."""
    count = int(rng.integers(2, 8))
    ends_m = rng.uniform(-0.5, 0.5, (2, count, 3))
    return tubes(ends_m[0], ends_m[1], style.bar_m * rng.uniform(0.6, 1.8, count), style.main, 8)


def bundle(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a bundle of slightly spreading bars, such as reeds or a broom."""
    count = int(rng.integers(10, 40))
    feet_m = np.column_stack([rng.normal(0, 0.1, (count, 2)), np.zeros(count)])
    spread = np.column_stack([rng.normal(0, 0.15, (count, 2)), rng.uniform(0.6, 1.0, count)])
    return tubes(feet_m, feet_m + spread, style.bar_m * rng.uniform(0.4, 1.2, count), style.main, 5)


def wire_frame(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build the edges and some face diagonals of a box, with balls at the corners."""
    corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3))) * rng.uniform(0.4, 1.0, 3)
    apart = [(a, b) for a in range(8) for b in range(a) if (a ^ b).bit_count() <= rng.integers(1, 3)]
    pairs = np.array(apart)
    bars = tubes(corners[pairs[:, 0]], corners[pairs[:, 1]], style.bar_m, style.main, 6)
    return join_meshes([bars, spheres(corners, 2 * style.bar_m, style.other, subdivisions=1)])


def bar_grid(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a three-dimensional grid of bars."""
    counts = rng.integers(2, 5, 3)
    size_m = rng.uniform(0.4, 1.0, 3)
    sets = []
    for axis in range(3):
        across = [np.linspace(-0.5, 0.5, counts[k]) if k != axis else np.array([-0.5]) for k in range(3)]
        starts = np.stack(np.meshgrid(*across), -1).reshape(-1, 3)
        ends = starts + np.eye(3)[axis]
        sets.append(tubes(starts * size_m, ends * size_m, style.bar_m, style.main, 5))
    return join_meshes(sets)


def thin_fence(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a framed fence of pickets and rails, coarse or as fine as wire mesh."""
    height_m = rng.uniform(0.5, 1.0)
    x, z = np.linspace(-0.5, 0.5, rng.integers(6, 24)), np.linspace(0, height_m, rng.integers(2, 12))
    upright = tubes(_points(x, 0 * x), _points(x, 0 * x + height_m), style.bar_m, style.main, 5)
    level = tubes(_points(0 * z - 0.5, z), _points(0 * z + 0.5, z), style.bar_m, style.main, 5)
    frame = np.array([[-0.5, 0, 0], [-0.5, 0, height_m], [0.5, 0, height_m], [0.5, 0, 0], [-0.5, 0, 0]])
    return join_meshes([upright, level, polyline_tubes(frame, 1.8 * style.bar_m, style.other)])


def wheel(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a wheel with a rim, a hub and spokes."""
    angle = np.linspace(0, 2 * np.pi, 37)
    rim_m = 0.48 * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], -1)
    spokes = rim_m[: -1 : int(rng.choice([1, 2, 3, 6]))]
    return join_meshes(
        [
            sweep(rim_m, 1.8 * style.bar_m, style.other, 8),
            tubes(np.zeros((1, 3)), spokes, style.bar_m, style.main, 5),
            spheres(np.zeros(3), max(0.04, 2 * style.bar_m), style.other),
        ]
    )


def spring(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a coil spring."""
    share = np.linspace(0, 1, 120)
    angle = 2 * np.pi * rng.uniform(3, 8) * share
    radius_m = rng.uniform(0.1, 0.35) * (1 + rng.uniform(-0.6, 0.4) * share)
    path_m = np.stack([radius_m * np.cos(angle), radius_m * np.sin(angle), share], -1)
    return sweep(path_m, style.bar_m, style.main, 6)


def branch(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a bare branch that forks four times."""
    starts, directions = np.zeros((1, 3)), np.array([[0.0, 0.0, 0.32]])
    levels = []
    for level in range(5):
        ends = starts + directions
        radii_m = style.bar_m * 2.2 * 0.62 ** np.array([level, level + 1])
        levels.append(tubes(starts, ends, np.tile(radii_m, (len(starts), 1)), style.main, 5))
        starts = np.repeat(ends, 2, axis=0)
        directions = 0.78 * np.repeat(directions, 2, axis=0)
        directions = directions + rng.normal(0, 0.13 * 0.85**level, directions.shape)
    return join_meshes(levels)


def loose_wires(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build two to four wires along similar random curves."""
    main_m = wander_m(rng, 20)
    aside_m = rng.normal(0, 0.08, (int(rng.integers(2, 5)), 1, 3)) * np.linspace(0.2, 1, 20)[:, None]
    return join_meshes(sweep(main_m + aside, style.bar_m, style.main, 6) for aside in aside_m)


def mobile(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a mobile: balls that hang on threads from a bar."""
    count = int(rng.integers(3, 9))
    x, drop_m = np.linspace(-0.45, 0.45, count), rng.uniform(0.15, 0.9, count)
    lower = _points(x, -drop_m)
    return join_meshes(
        [
            tubes([[-0.5, 0, 0]], [[0.5, 0, 0]], 1.6 * style.bar_m, style.main, 8),
            tubes(_points(x, 0 * x), lower, 0.6 * style.bar_m, style.main, 5),
            spheres(lower, rng.uniform(0.03, 0.08, count), style.other),
        ]
    )


def lattice_mast(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a slender lattice mast with three legs and a diagonal in each panel."""
    angle, z = np.arange(3) * 2 * np.pi / 3, np.linspace(0, 1, int(rng.integers(5, 12)))
    feet = np.stack([np.cos(angle), np.sin(angle)], -1) * rng.uniform(0.06, 0.16)
    rings = np.concatenate(
        [np.broadcast_to(feet, (len(z), 3, 2)), np.broadcast_to(z[:, None, None], (len(z), 3, 1))], -1
    )
    ahead = np.roll(rings, -1, axis=1)
    starts = np.concatenate([rings[:-1], rings, rings[:-1]]).reshape(-1, 3)
    ends = np.concatenate([rings[1:], ahead, ahead[1:]]).reshape(-1, 3)
    return tubes(starts, ends, style.bar_m, style.main, 5)


def _points(x: np.ndarray, z: np.ndarray) -> Float[np.ndarray, "n 3"]:
    return np.stack([x, np.zeros(len(x)), z], -1)


THIN: tuple[PropBuilder, ...] = (
    (rods, bundle, wire_frame, bar_grid, thin_fence, wheel, spring, branch, loose_wires, mobile, lattice_mast)
)  # fmt: skip
