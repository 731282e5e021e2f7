"""Pipework of a refinery: pipes, valves and pipe racks."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.bridges import beams
from stereoweave.synth.props.lattice import poses_towards
from stereoweave.synth.props.primitives import copies, lathe, spheres, tubes
from stereoweave.synth.props.refinery_units import RefineryMaterials
from stereoweave.synth.world import Mesh, join_meshes

Path = Float[np.ndarray, "_ 3"]


def pipes(paths_m: Sequence[Path], radii_m: Sequence[float], material: int) -> Mesh:
    """Build pipes with elbows at the corners and a pair of flanges on each long section."""
    counts = [len(path) - 1 for path in paths_m]
    starts, ends = (
        np.concatenate([path[part] for path in paths_m]) for part in (slice(None, -1), slice(1, None))
    )
    radii, length = np.repeat(radii_m, counts), np.linalg.norm(ends - starts, axis=1)
    elbows = np.concatenate([path[1:-1] for path in paths_m])
    # The spheres have only 20 faces, so they must be wider than the pipes to close the gaps at corners.
    bent = spheres(elbows, 1.15 * np.repeat(radii_m, np.array(counts) - 1), material, subdivisions=0)
    long = length > 0.5
    along = (ends - starts)[long] / length[long, None]
    middle, half = (0.6 * starts + 0.4 * ends)[long], 0.4 * radii[long, None] * along
    flanges = tubes(middle - half, middle + half, 1.6 * radii[long], material, 8)
    return join_meshes([tubes(starts, ends, radii, material, 6, capped=False), flanges, bent])


def valves(at_m: Path, axes: Path, radius_m: float, body: int, wheel: int) -> Mesh:
    """Build valves on pipes along x, with handwheels on spindles along `axes`."""
    parts = [
        spheres(at_m, 1.6 * radius_m, body, subdivisions=1),
        tubes(at_m, at_m + 4 * radius_m * axes, 0.3 * radius_m, body, 6),
    ]
    angle = np.linspace(0, 2 * np.pi, 5)
    tube_m = 0.25 * radius_m * np.column_stack([np.cos(angle), np.sin(angle)])
    rim = lathe(tube_m + [1.8 * radius_m, 0], wheel, 10)
    spokes_m = 1.8 * radius_m * np.eye(3)[:2]
    spokes = tubes(-spokes_m, spokes_m, 0.2 * radius_m, wheel, 4)
    return join_meshes(
        [*parts, copies(join_meshes([rim, spokes]), poses_towards(at_m + 3.6 * radius_m * axes, axes))]
    )


def rack(
    rng: np.random.Generator,
    half_m: float,
    levels_m: Sequence[float],
    lines: Sequence[int],
    materials: RefineryMaterials,
) -> Mesh:
    """Build a steel rack along x with layers of parallel pipes, some with expansion loops.

    lines: candidate materials for the pipes.
    """
    by_coat: dict[int, list[tuple[Path, float]]] = {}
    for level_m in levels_m:
        y = -0.37
        while y < 0.35:
            radius_m = float(rng.choice([0.018, 0.024, 0.032, 0.042]))
            path = _line_on_rack(rng, half_m, y + radius_m, level_m + radius_m)
            by_coat.setdefault(int(rng.choice(lines)), []).append((path, radius_m))
            y += 2 * radius_m + rng.uniform(0.015, 0.05)
    laid = [pipes([p for p, _ in bunch], [r for _, r in bunch], coat) for coat, bunch in by_coat.items()]
    at = rng.uniform([-0.9 * half_m, -0.3, 0], [0.9 * half_m, 0.3, 0], (8, 3)) + [0, 0, levels_m[-1] + 0.04]
    upright = np.tile([0.0, 0.0, 1.0], (8, 1))
    return join_meshes(
        [
            _frame(half_m, levels_m, materials.steel),
            *laid,
            valves(at, upright, 0.035, materials.steel, materials.red),
        ]
    )


def _frame(half_m: float, levels_m: Sequence[float], steel: int) -> Mesh:
    """Build the posts, ties, rails and braces of the rack."""
    x, half_y = np.linspace(-half_m + 0.15, half_m - 0.15, 9), 0.42
    feet = np.array([[at, y, 0.0] for at in x for y in (-half_y, half_y)])
    across = np.array([[at, -half_y, z - 0.03] for at in x for z in levels_m])
    ends = np.array([[x[0], y, z - 0.05] for y in (-half_y, half_y) for z in levels_m])
    return join_meshes(
        [
            beams(feet, feet + [0, 0, levels_m[-1] + 0.02], (0.05, 0.05), steel),
            beams(across, across * [1, -1, 1], (0.04, 0.06), steel),
            beams(ends, ends * [-1, 1, 1], (0.035, 0.05), steel),
            tubes(feet[[0, 1, -4, -3]], feet[[2, 3, -2, -1]] + [0, 0, levels_m[0]], 0.012, steel, 5),
        ]
    )


def _line_on_rack(rng: np.random.Generator, half_m: float, y: float, z: float) -> Path:
    """Draw a random path for a pipe that runs up from the ground, along the rack and down again.

    Some paths have an expansion loop.
    """
    first, last = -half_m - rng.uniform(0, 0.3), half_m + rng.uniform(0, 0.3)
    line = [[first, y, 0.0], [first, y, z]]
    if rng.random() < 0.25 and z > 0.9:
        at, rise = rng.uniform(-0.7, 0.5) * half_m, rng.uniform(0.2, 0.35)
        line += [[at, y, z], [at, y, z + rise], [at + 0.4, y, z + rise], [at + 0.4, y, z]]
    return np.array([*line, [last, y, z], [last, y, 0.0]])
