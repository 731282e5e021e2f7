"""Refinery units at a tenth of their real size: columns, tanks, pressure vessels and stacks.

Each unit stands on z = 0, centred on the z axis, and lists its nozzles.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.lattice import bars, cables, chain_segments, ladder
from stereoweave.synth.props.primitives import (
    boxes,
    copies,
    lathe,
    rotation,
    sheet,
    spheres,
    translation,
    tubes,
)
from stereoweave.synth.world import Mesh, join_meshes


@dataclass(frozen=True, kw_only=True)
class RefineryMaterials:
    """Materials of a refinery; `shells` lists the alternatives for vessel walls."""

    shells: tuple[int, ...]
    steel: int
    rail: int
    red: int
    white: int
    concrete: int
    sign: int
    flame: int

    def shell(self, rng: np.random.Generator) -> int:
        """Return a random material for the walls of a vessel."""
        return self.shells[rng.integers(len(self.shells))]


@dataclass(frozen=True, kw_only=True)
class RefineryUnit:
    """Mesh of a unit and positions [N, 3] of its nozzles."""

    mesh: Mesh
    nozzles_m: Float[np.ndarray, "n 3"]


def column(rng: np.random.Generator, materials: RefineryMaterials) -> RefineryUnit:
    """Build a distillation column.

    It has a skirt, a shell of one or two diameters, platforms with railings, and caged ladders.
    """
    high_m, radius_m = rng.uniform(2.8, 4.4), rng.uniform(0.16, 0.26)
    upper_m = radius_m * (rng.uniform(0.78, 0.9) if rng.random() < 0.5 else 1.0)
    neck_m = rng.uniform(0.55, 0.75) * high_m
    bend = np.linspace(0, np.pi / 2, 6)
    dome = np.column_stack([upper_m * np.cos(bend), high_m + 0.5 * upper_m * np.sin(bend)])
    below = [[0, 0], [1.15 * radius_m, 0], [radius_m, 0.35], [radius_m, neck_m], [upper_m, neck_m + 0.15]]
    parts = [lathe(np.concatenate([below, dome]), materials.shell(rng), 20)]
    hoop = lathe([[radius_m, -0.02], [radius_m + 0.01, 0], [radius_m, 0.02]], materials.steel, 16)
    parts.append(copies(hoop, _poses_at_heights(np.arange(0.45, neck_m, 0.45))))
    floors_m = np.linspace(0.0, high_m - 0.05, int(rng.integers(4, 7)))[1:]
    for inner_m, low in ((radius_m, floors_m < neck_m), (upper_m, floors_m >= neck_m)):
        parts.append(copies(_deck(inner_m, 0.17, materials), _poses_at_heights(floors_m[low])))
    climb = _caged_ladder(radius_m + 0.1, floors_m[0] + 0.1, materials)
    turns = np.stack([rotation((0, 0, 1), 150.0 * k) for k in range(len(floors_m))])
    parts.append(copies(climb, _poses_at_heights(floors_m - floors_m[0]) @ turns))
    # The vapour pipe runs from the top down the shell.
    line = np.array(
        [[0, 0, high_m], [0, 0, high_m + 0.3], [radius_m + 0.12, 0, high_m + 0.3], [radius_m + 0.12, 0, 0.5]]
    )
    line = line @ rotation((0, 0, 1), rng.uniform(0, 360))[:3, :3].T
    parts += [
        tubes(line[:-1], line[1:], 0.035, materials.shells[0], 10, capped=False),
        spheres(line[1:3], 0.036, materials.shells[0], 1),
    ]
    return RefineryUnit(mesh=join_meshes(parts), nozzles_m=np.array([line[-1], [0, 0, 0.7]]))


def ball_tank(rng: np.random.Generator, materials: RefineryMaterials) -> RefineryUnit:
    """Build a spherical tank on braced legs, with winding stairs and a platform on top."""
    radius_m = rng.uniform(0.5, 0.6)
    middle_m, legs = radius_m + 0.28, 9
    angle = np.arange(legs) * 2 * np.pi / legs
    ring = 0.96 * radius_m * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    tops = ring + [0, 0, middle_m + 0.1]
    after = np.roll(ring, -1, axis=0)
    parts = [
        spheres([[0, 0, middle_m]], radius_m, materials.shell(rng), subdivisions=3),
        tubes(ring, tops, 0.03, materials.shells[0], 8, capped=False),
        tubes(
            np.concatenate([ring + [0, 0, 0.05], after + [0, 0, 0.05]]),
            np.concatenate([after, ring]) + [0, 0, middle_m - 0.25],
            0.008,
            materials.steel,
            4,
            capped=False,
        ),
        tubes(ring, ring + [0, 0, 0.06], 0.06, materials.concrete, 6),
        lathe(
            [[radius_m, middle_m - 0.02], [radius_m + 0.015, middle_m], [radius_m, middle_m + 0.02]],
            materials.steel,
            36,
        ),
        _deck(0.02, 0.2, materials).translate(z=middle_m + radius_m),
    ]
    share = np.linspace(0, 1, 30)
    polar = np.pi / 2 * (1.05 - 0.85 * share)
    reach_m = (radius_m + 0.09) * np.sin(polar) + 0.02
    path = np.stack(
        [
            reach_m * np.cos(3.6 * share),
            reach_m * np.sin(3.6 * share),
            middle_m + (radius_m + 0.02) * np.cos(polar),
        ],
        -1,
    )
    foot = path[0] * [1.0, 1.0, 0] + [0.1, -0.5, 0]
    parts += [_stair(np.concatenate([np.linspace(foot, path[0], 8)[:-1], path]), materials)]
    return RefineryUnit(mesh=join_meshes(parts), nozzles_m=np.array([[0, 0, 0.22]]))


def drum_tank(rng: np.random.Generator, materials: RefineryMaterials) -> RefineryUnit:
    """Build a storage tank with a low conical roof, winding stairs, a railing and a sign."""
    radius_m, high_m = rng.uniform(0.5, 0.62), rng.uniform(0.6, 1.1)
    seams_m = np.linspace(0, high_m, 5)[1:-1]
    shell = lathe(
        [
            [0, 0],
            [radius_m, 0],
            *[[radius_m, z] for z in seams_m],
            [radius_m, high_m],
            [0.02, high_m + 0.12],
            [0, high_m + 0.12],
        ],
        materials.shell(rng),
        36,
    )
    seams = [
        lathe([[radius_m, z - 0.01], [radius_m + 0.008, z], [radius_m, z + 0.01]], materials.steel, 36)
        for z in seams_m
    ]
    angle = np.linspace(0, 2 * np.pi, 21)
    rim = np.stack([0.97 * radius_m * np.cos(angle), 0.97 * radius_m * np.sin(angle), 0 * angle + high_m], -1)
    share = np.linspace(0, 1, 31)
    turned = rng.uniform(0, 6) + share * high_m / radius_m * 1.5
    path = np.stack(
        [(radius_m + 0.06) * np.cos(turned), (radius_m + 0.06) * np.sin(turned), share * high_m], -1
    )
    label = turned[0] + 2.6 + np.linspace(-0.3, 0.3, 9)[None] + np.zeros((2, 1))
    z = high_m * np.array([0.45, 0.75])[:, None] + 0 * label
    board = sheet(
        np.stack([(radius_m + 0.006) * np.cos(label), (radius_m + 0.006) * np.sin(label), z], -1),
        materials.sign,
    )
    base = lathe([[0, 0], [radius_m + 0.1, 0], [radius_m + 0.1, 0.05], [0, 0.05]], materials.concrete, 32)
    parts = [shell, *seams, _railing(rim, materials), _stair(path, materials), board, base]
    return RefineryUnit(mesh=join_meshes(parts), nozzles_m=np.array([[0, 0, 0.12]]))


def pressure_vessels(rng: np.random.Generator, materials: RefineryMaterials) -> RefineryUnit:
    """Build two to four horizontal, round-ended pressure vessels on saddles, in one or two stacks.

    A platform and a ladder give access to the vessels.
    """
    radius_m, long_m = rng.uniform(0.14, 0.2), rng.uniform(0.55, 0.7)
    bend = np.linspace(0, np.pi / 2, 6)[:-1]
    cap = np.column_stack([radius_m * np.sin(bend), -0.5 * radius_m * np.cos(bend)])
    profile = np.concatenate(
        [cap - [0, long_m], [[radius_m, -long_m], [radius_m, long_m]], cap[::-1] * [1, -1] + [0, long_m]]
    )
    lying = lathe(profile, materials.shell(rng), 20).transform(rotation((0, 1, 0), 90))
    places = [(y, z) for y in (-0.26, 0.26) for z in (radius_m + 0.12, 3.2 * radius_m + 0.16)]
    used = places[: int(rng.integers(2, 5))]
    poses = np.stack([translation(0, y, z) for y, z in used])
    saddles = boxes(
        [[x, y, z - 0.6 * radius_m - 0.1 * (z < 0.4)] for x in (-0.4, 0.4) for y, z in used],
        [[0.08, 1.5 * radius_m, 1.3 * radius_m]],
        materials.steel,
    )
    necks = np.array([[x, y, z] for x in (-0.3, 0.3) for y, z in used])
    stubs = tubes(necks, necks + [0, 0, radius_m + 0.08], 0.03, materials.steel, 10)
    top_m = max(z for _, z in used) + radius_m + 0.05
    walk = boxes([[0, -0.26, top_m]], [[1.1, 0.3, 0.015]], materials.steel)
    edge = np.array(
        [
            [-0.55, -0.41, top_m],
            [0.55, -0.41, top_m],
            [0.55, -0.11, top_m],
            [-0.55, -0.11, top_m],
            [-0.55, -0.41, top_m],
        ]
    )
    posts = tubes(
        [[x, y, 0] for x in (-0.5, 0.5) for y in (-0.47, -0.05)],
        [[x, y, top_m] for x in (-0.5, 0.5) for y in (-0.47, -0.05)],
        0.014,
        materials.steel,
    )
    steps = ladder((0.64, -0.26, 0), (0.6, -0.26, top_m + 0.1), (0, 1, 0), 0.09, materials.rail)
    parts = [copies(lying, poses), saddles, stubs, walk, _railing(edge, materials), posts, steps]
    return RefineryUnit(mesh=join_meshes(parts), nozzles_m=np.array([[0.3, -0.26, used[0][1]]]))


def chimney(rng: np.random.Generator, materials: RefineryMaterials) -> RefineryUnit:
    """Build a chimney with red and white bands, a platform and a ladder."""
    high_m, foot_m, top_m = rng.uniform(3.8, 5.2), rng.uniform(0.2, 0.28), rng.uniform(0.11, 0.15)
    edges_m = np.concatenate([[0, 0.45 * high_m], np.linspace(0.45, 1, 7)[1:] * high_m])
    widths_m = np.interp(edges_m, [0, high_m], [foot_m, top_m])
    profile_m = np.column_stack([widths_m, edges_m])
    coat = [materials.concrete] + [materials.red, materials.white] * 3
    bands = [lathe(profile_m[k : k + 2], coat[k], 28) for k in range(len(coat))]
    rim = lathe(
        [
            [top_m, high_m],
            [top_m + 0.02, high_m],
            [top_m + 0.02, high_m + 0.05],
            [0.8 * top_m, high_m + 0.05],
            [0.7 * top_m, high_m - 0.3],
            [0, high_m - 0.3],
        ],
        materials.steel,
        28,
    )
    decks = [_deck(widths_m[1], 0.14, materials).translate(z=edges_m[1])]
    lean = (foot_m + 0.05, top_m + 0.05)
    steps = ladder((lean[0], 0, 0.0), (lean[1], 0, high_m), (0, 1, 0), 0.08, materials.rail)
    flue = boxes([[0, 0, 0.35]], [[0.3, 3 * foot_m, 0.3]], materials.steel)
    return RefineryUnit(
        mesh=join_meshes([*bands, rim, *decks, steps, flue]), nozzles_m=np.array([[0, 0, 0.3]])
    )


def flare(rng: np.random.Generator, materials: RefineryMaterials) -> RefineryUnit:
    """Build a slender flare stack with guy wires at two heights and, usually, a flame."""
    high_m = rng.uniform(4.4, 5.4)
    stack = lathe(
        [
            [0, 0],
            [0.1, 0],
            [0.06, 0.3],
            [0.045, 0.4],
            [0.045, high_m],
            [0.07, high_m + 0.05],
            [0.07, high_m + 0.2],
            [0.03, high_m + 0.2],
        ],
        materials.steel,
        16,
    )
    pilots = tubes(
        [[0.075, 0, 0.4], [-0.06, 0.05, 0.4]],
        [[0.075, 0, high_m + 0.15], [-0.06, 0.05, high_m + 0.15]],
        0.012,
        materials.shells[0],
        6,
    )
    angle = rng.uniform(0, 6) + np.arange(3) * 2 * np.pi / 3
    feet = 0.85 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    guys = [
        cables(np.array([[0, 0, share * high_m]]), feet, 0.006, materials.rail, sag_m=0.03, count=6)
        for share in (0.55, 0.95)
    ]
    blocks = boxes(feet + [0, 0, 0.03], [[0.12, 0.12, 0.08]], materials.concrete)
    steps = ladder((-0.07, 0, 0.3), (-0.07, 0, high_m), (0, 1, 0), 0.08, materials.rail)
    parts = [stack, pilots, *guys, blocks, steps, _deck(0.05, 0.11, materials).translate(z=high_m - 0.15)]
    if rng.random() < 0.7:
        parts.append(_flame(rng, materials).translate(z=high_m + 0.18))
    return RefineryUnit(mesh=join_meshes(parts), nozzles_m=np.array([[0, 0, 0.2]]))


def _flame(rng: np.random.Generator, materials: RefineryMaterials) -> Mesh:
    """Build a flame that leans with the wind."""
    share = np.linspace(0, 1, 12)
    width_m = 0.11 * np.sin(np.pi * (0.15 + 0.85 * share)) ** 0.8 * rng.uniform(0.8, 1.2, 12)
    flame = lathe(np.column_stack([np.append(width_m[:-1], 0.0), 0.55 * share]), materials.flame, 18)
    pose = np.eye(4)
    pose[:2, 2] = rng.uniform(-0.8, 0.8, 2)
    return flame.transform(pose)


def _deck(inner_m: float, wide_m: float, materials: RefineryMaterials) -> Mesh:
    """Build a round platform with a railing and brackets."""
    outer_m = inner_m + wide_m
    plate = lathe(
        [[inner_m, -0.02], [outer_m, -0.02], [outer_m, 0.0], [inner_m, 0.0]],
        materials.steel,
        16,
        crease_deg=10,
    )
    angle = np.linspace(0, 2 * np.pi, 11)
    rim = np.stack([outer_m * np.cos(angle), outer_m * np.sin(angle), 0 * angle], -1)
    brackets = np.stack([0.95 * rim[:-1:2], rim[:-1:2] * inner_m / outer_m - [0, 0, 0.15]], 1)
    return join_meshes(
        [plate, bars(brackets, 0.008, materials.steel, 3, capped=False), _railing(rim, materials)]
    )


def _railing(path_m: Float[np.ndarray, "n 3"], materials: RefineryMaterials) -> Mesh:
    """Build a railing with two rails and a post at each point of a path."""
    rails = [np.stack([path_m[:-1], path_m[1:]], 1) + [0, 0, z] for z in (0.055, 0.11)]
    posts = np.stack([path_m, path_m + [0, 0, 0.11]], 1)
    return bars(np.concatenate([*rails, posts]), 0.0065, materials.rail, 3, capped=False)


def _caged_ladder(at_m: float, high_m: float, materials: RefineryMaterials) -> Mesh:
    """Build a caged ladder at a distance of at_m from the axis."""
    angle = np.radians(np.linspace(-90, 90, 5))
    bow = np.stack([at_m + 0.12 * np.cos(angle), 0.07 * np.sin(angle), 0 * angle], -1)
    hoops = bow + np.arange(0.24, high_m, 0.2)[:, None, None] * [0, 0, 1]
    strips = np.stack([hoops[0, 1:-1], hoops[-1, 1:-1]], 1)
    caged = bars(np.concatenate([chain_segments(hoops), strips]), 0.0055, materials.rail, 3, capped=False)
    return join_meshes(
        [ladder((at_m, 0.0, 0.0), (at_m, 0.0, high_m), (0, 1, 0), 0.11, materials.rail), caged]
    )


def _poses_at_heights(heights_m: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
    """Return poses [N, 4, 4] at the given heights on the z axis."""
    poses = np.tile(np.eye(4), (len(heights_m), 1, 1))
    poses[:, 2, 3] = heights_m
    return poses


def _stair(path_m: Float[np.ndarray, "n 3"], materials: RefineryMaterials) -> Mesh:
    """Build steps along a path around the z axis, with a railing on the outer side."""
    angle = np.arctan2(path_m[:, 1], path_m[:, 0])
    out = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    turns = np.stack(
        [out, np.stack([-out[:, 1], out[:, 0], 0 * angle], -1), np.tile([0.0, 0, 1], (len(out), 1))], -1
    )
    steps = boxes(path_m, [[0.1, 0.045, 0.01]], materials.steel, turns)
    edge = (path_m + 0.05 * out)[::3]
    string = bars(np.stack([edge[:-1], edge[1:]], 1), 0.01, materials.steel, 4, capped=False)
    return join_meshes([steps, string, _railing(edge, materials)])
