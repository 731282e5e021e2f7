"""A container crane on a quay: its portal, boom, stays and trolley, with containers and often a ship."""

from dataclasses import dataclass, replace

import numpy as np

from stereoweave.synth.props.lattice import (
    aviation_paints,
    bars,
    cables,
    cage,
    chain_segments,
    galvanised_steel,
    ladder,
    painted_steel,
    railing,
    sagging_points,
    truss,
)
from stereoweave.synth.props.primitives import boxes, copies, lathe, prism, rotation, translation, tubes
from stereoweave.synth.props.surroundings import bollards, daylight, hills, sea
from stereoweave.synth.stage import Palette, Stage, outdoor_stage
from stereoweave.synth.viewpoints import Orbit
from stereoweave.synth.world import Colour, Material, Mesh, join_meshes

PAINTS: tuple[Colour, ...] = ((0.1, 0.22, 0.42), (0.55, 0.1, 0.06), (0.7, 0.7, 0.68), (0.68, 0.45, 0.08))
BOXES: tuple[Colour, ...] = (
    (0.45, 0.12, 0.08), (0.1, 0.2, 0.38), (0.5, 0.5, 0.48), (0.6, 0.32, 0.08), (0.14, 0.3, 0.2)
)  # fmt: skip
CONTAINER_M = np.array([1.1, 0.28, 0.3])
GAUGE_M, BASE_M = 1.15, 0.95  # half the distances between the legs along x and y
GIRDER_M = 3.7  # height of the boom
BACK_M, TIP_M = -2.3, 4.0
EDGE_M = 1.9  # x coordinate of the quay's edge
WATER_M = -0.55


@dataclass(frozen=True, kw_only=True)
class QuayCraneMaterials:
    """Materials of a container crane."""

    portal: int
    boom: tuple[int, ...]
    steel: int
    dark: int
    house: int
    glass: int


def quay_crane(rng: np.random.Generator) -> Stage:
    """Build a stage with a container crane on a quay along y, with its boom along x."""
    palette = Palette()
    materials = _draw_materials(rng, palette)
    colours = [palette.add(painted_steel(rng, colour, roughness=0.6)) for colour in BOXES]
    crane = join_meshes(
        [_portal(materials), _boom(materials), _stays(materials), _trolley(rng, materials, colours)]
    )
    mesh = join_meshes([crane.as_target(), _quay(rng, palette, colours)])
    # The viewpoints are on one side, which shows the boom and the portal in profile. Mirroring adds the other
    # side.
    mirrored = rng.random() < 0.5
    light = daylight(rng)
    mesh = _mirror(mesh) if mirrored else mesh
    orbit = Orbit(
        centre_m=(0.7, 0.0, 2.8),
        distance_m=(7.5, 10.5),
        azimuth_deg=(220, 290) if mirrored else (70, 140),
        elevation_deg=(-15, 20),
        aim_m=0.6,
        floor_m=0.6,
    )
    return outdoor_stage(mesh, palette, light, orbit)


def _draw_materials(rng: np.random.Generator, palette: Palette) -> QuayCraneMaterials:
    portal = palette.add(painted_steel(rng, PAINTS[int(rng.integers(len(PAINTS)))]))
    boom = (
        tuple(palette.add(material) for material in aviation_paints(rng)) if rng.random() < 0.4 else (portal,)
    )
    return QuayCraneMaterials(
        portal=portal,
        boom=boom,
        steel=palette.add(galvanised_steel(rng)),
        dark=palette.add(Material(texture="plain", tint=(0.06, 0.06, 0.06), roughness=0.8)),
        house=palette.add(painted_steel(rng, (0.75, 0.75, 0.72))),
        glass=palette.add(Material(texture="plain", tint=(0.05, 0.07, 0.08), roughness=0.1)),
    )


def _portal(materials: QuayCraneMaterials) -> Mesh:
    """Build the portal: legs, beams, braces, bogies on rails, a lift, and ladders with landings."""
    corner = np.array([(a, b, 0) for a in (GAUGE_M, -GAUGE_M) for b in (BASE_M, -BASE_M)])
    sides = np.array([[1, BASE_M, 1], [1, -BASE_M, 1]])
    wheels = (corner[:, None] + [[0, d, 0.08] for d in (-0.24, -0.08, 0.08, 0.24)]).reshape(-1, 3)
    low, high = sides * [-GAUGE_M, 1, 1.45], sides * [GAUGE_M, 1, GIRDER_M - 0.15]
    height = GIRDER_M - 0.3
    return join_meshes(
        [
            boxes(corner + [0, 0, 0.3 + height / 2], (0.16, 0.14, height), materials.portal),
            boxes(
                [(a, 0, 0.34) for a in (GAUGE_M, -GAUGE_M)], (0.18, 2 * BASE_M + 0.3, 0.16), materials.portal
            ),
            boxes(
                [(a, 0, GIRDER_M - 0.1) for a in (GAUGE_M, -GAUGE_M)],
                (0.17, 2 * BASE_M + 0.14, 0.2),
                materials.portal,
            ),
            boxes(sides * [0, 1, 1.4], (2 * GAUGE_M, 0.13, 0.16), materials.portal),
            tubes(low, high, 0.045, materials.portal, 10),
            boxes(corner + [0, 0, 0.17], (0.12, 0.62, 0.14), materials.dark),
            tubes(wheels - [0.05, 0, 0], wheels + [0.05, 0, 0], 0.08, materials.steel, 14),
            boxes((-GAUGE_M, -BASE_M - 0.15, 2.0), (0.15, 0.14, GIRDER_M - 0.6), materials.house),
            _climb(materials),
        ]
    )


def _climb(materials: QuayCraneMaterials) -> Mesh:
    """Build caged ladders between landings on a landward leg."""
    y = BASE_M + 0.12
    landings = np.array([1.5, 2.6, GIRDER_M - 0.02])
    parts = [boxes([(-GAUGE_M, y + 0.02, z) for z in landings], (0.5, 0.26, 0.015), materials.steel)]
    for x, low, high in zip((0.0, 0.14, -0.14), (0.0, *landings), landings, strict=False):
        foot, head = (x - GAUGE_M, y, low), (x - GAUGE_M, y, high + 0.2)
        parts.append(ladder(foot, head, (1, 0, 0), 0.1, materials.steel))
        parts.append(cage((foot[0], y, low + 0.3), head, (0, 1, 0), 0.1, materials.steel))
    for z in landings:
        path = np.array([[-0.25, -0.1, z], [-0.25, 0.15, z], [0.25, 0.15, z], [0.25, -0.1, z]])
        parts.append(railing(path + [-GAUGE_M, y, 0], 0.2, 0.25, 0.007, materials.steel))
    return join_meshes(parts)


def _boom(materials: QuayCraneMaterials) -> Mesh:
    """Build two lattice girders with walkways and cross beams, and a machinery house at the landward end."""
    x = np.linspace(BACK_M, TIP_M, 22)
    square = np.array([[-0.06, -0.0], [0.06, -0.0], [0.06, 0.26], [-0.06, 0.26]])
    parts = []
    for side in (1, -1):
        joints = np.stack(
            [np.column_stack([x, 0 * x + a + side * 0.28, 0 * x + b + GIRDER_M]) for a, b in square], 1
        )
        parts.append(truss(joints, "zigzag").banded_mesh(0.02, 0.011, materials.boom, (0.6, np.inf)))
        path = np.array([[BACK_M, 0.44 * side, GIRDER_M], [TIP_M, 0.44 * side, GIRDER_M]])
        parts.append(railing(path, 0.2, 0.3, 0.007, materials.steel))
        parts.append(
            boxes(path.mean(0) - [0, 0.06 * side, 0], (TIP_M - BACK_M, 0.16, 0.012), materials.steel)
        )
    across = [(a, 0, GIRDER_M + 0.13) for a in (BACK_M, -GAUGE_M, GAUGE_M, TIP_M)]
    loops = np.linspace(BACK_M + 0.1, 3.0, 15)
    ends = np.column_stack([loops, 0 * loops - 0.28, 0 * loops + GIRDER_M - 0.02])
    return join_meshes(
        [
            *parts,
            boxes(across, (0.14, 0.68, 0.2), materials.portal),
            boxes((-1.75, 0, GIRDER_M + 0.56), (0.95, 0.62, 0.5), materials.house),
            boxes((-1.75, 0, GIRDER_M + 0.84), (1.02, 0.7, 0.06), materials.portal),
            boxes((-1.75, 0, GIRDER_M + 0.285), (1.05, 0.8, 0.05), materials.portal),
            bars(
                chain_segments(sagging_points(ends[:-1], ends[1:], 0.16, 8)), 0.008, materials.dark, sides=4
            ),
        ]
    )


def _stays(materials: QuayCraneMaterials) -> Mesh:
    """Build the A-frame above the portal and the stays from it to the boom."""
    sides = np.array([[1, 1.0, 1], [1, -1.0, 1]])
    apex = sides * [GAUGE_M + 0.1, 0.2, GIRDER_M + 1.95]
    front, back = sides * [GAUGE_M, BASE_M, GIRDER_M], sides * [-GAUGE_M, 0.28, GIRDER_M + 0.26]
    cross = 0.5 * (front + apex)
    stays = [np.stack([apex, sides * [x, 0.28, GIRDER_M + 0.26]], 1) for x in (2.2, 3.75, BACK_M + 0.1)]
    lights = np.array([[GAUGE_M + 0.1, y, GIRDER_M + 1.98] for y in (-0.15, 0.0, 0.15)])
    return join_meshes(
        [
            tubes(front, apex, np.array([[0.065, 0.05]]), materials.portal, 10),
            tubes(back, apex, 0.04, materials.portal, 10),
            tubes(cross[0], cross[1], 0.03, materials.portal, 8),
            boxes((GAUGE_M + 0.1, 0, GIRDER_M + 1.95), (0.14, 0.56, 0.1), materials.portal),
            bars(np.concatenate(stays), 0.012, materials.steel),
            railing(lights[[0, 2]] + [0, 0, 0.02], 0.16, 0.15, 0.006, materials.steel),
            bars(np.stack([lights, lights + [0, 0, 0.4]], 1)[1:2], 0.007, materials.steel),
        ]
    )


def _trolley(rng: np.random.Generator, materials: QuayCraneMaterials, colours: list[int]) -> Mesh:
    """Build the trolley, its cab, ropes and spreader, and often a container."""
    x, low = rng.uniform(-0.4, 3.4), rng.uniform(1.2, 2.6)
    z = GIRDER_M - 0.08
    corners = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    top, bottom = corners * [0.18, 0.18, 0] + [x, 0, z], corners * [0.12, 0.1, 0] + [x, 0, low + 0.06]
    rim = np.concatenate([corners, corners[:1]]) * [0.14, CONTAINER_M[0] / 2 - 0.03, 0] + [x, 0, low]
    cab = np.array([x - 0.34, 0.14, z - 0.2])
    parts = [
        boxes((x, 0, z), (0.5, 0.5, 0.1), materials.portal),
        boxes(cab, (0.22, 0.24, 0.26), materials.house),
        boxes(cab + [0.02, 0, -0.04], (0.2, 0.25, 0.15), materials.glass),
        boxes(cab + [0, 0, 0.16], (0.04, 0.2, 0.1), materials.portal),
        cables(top, bottom, 0.006, materials.steel, count=1),
        boxes((x, 0, low + 0.04), (0.3, 0.24, 0.07), materials.portal),
        bars(chain_segments(rim[None]), 0.022, materials.boom[0], sides=4),
        boxes((x, 0, low), (0.1, CONTAINER_M[0] - 0.06, 0.04), materials.boom[0]),
    ]
    if rng.random() < 0.7:
        carried = _container(colours[int(rng.integers(5))], materials.dark).transform(rotation((0, 0, 1), 90))
        parts.append(carried.translate(x, 0, low - CONTAINER_M[2] - 0.03))
    return join_meshes(parts)


def _container(colour: int, dark: int) -> Mesh:
    """Build a container along x, on z = 0, with ribbed sides, posts, and locking bars on its doors."""
    length, width, height = CONTAINER_M
    x = np.linspace(-0.42, 0.42, 7) * length
    ribs = np.array([(a, b * (width / 2 - 0.004), height / 2) for a in x for b in (1, -1)])
    posts = [(a * (length / 2 - 0.01), b * (width / 2 - 0.01), height / 2) for a in (1, -1) for b in (1, -1)]
    rods = np.array([(length / 2, b, 0.03) for b in (-0.09, -0.03, 0.03, 0.09)])
    return join_meshes(
        [
            boxes((0, 0, height / 2), (length - 0.02, width - 0.02, height - 0.01), colour),
            boxes(ribs, (0.06, 0.014, height - 0.04), colour),
            boxes(posts, (0.03, 0.03, height), colour),
            bars(np.stack([rods, rods + [0, 0, height - 0.06]], 1), 0.006, dark, sides=4),
        ]
    )


def _quay(rng: np.random.Generator, palette: Palette, colours: list[int]) -> Mesh:
    """Build the quay with its rails, fenders, bollards and containers, the sea, and a distant shore."""
    concrete = palette.add(
        Material(
            texture="concrete", variant=int(rng.integers(8)), tint=(0.78, 0.77, 0.74), span_m=3.5, relief=0.4
        )
    )
    rubber = palette.add(Material(texture="plain", tint=(0.05, 0.05, 0.05), roughness=0.9))
    rail = palette.add(galvanised_steel(rng))
    y = np.arange(-30, 31, 1.5)
    fender = lathe([(0, 0), (0.1, 0), (0.1, 0.42), (0, 0.42)], rubber, 12)
    spots = np.stack([np.full_like(y, EDGE_M - 0.22), y + 0.7, 0 * y], -1) / 0.4
    small = np.diag([0.4, 0.4, 0.4, 1.0])
    return join_meshes(
        [
            boxes(((EDGE_M - 60) / 2, 0, -1.5), (EDGE_M + 60, 160, 3.0), concrete),
            boxes((EDGE_M - 0.05, 0, 0.04), (0.12, 160, 0.08), concrete),
            boxes([(a, 0, 0.0) for a in (GAUGE_M, -GAUGE_M)], (0.035, 160, 0.02), rail),
            copies(fender, np.stack([translation(EDGE_M + 0.08, value, -0.5) for value in y])),
            bollards(rng, palette, spots).transform(small),
            _yard(rng, colours, rubber),
            *([_ship(rng, palette, colours, rubber)] if rng.random() < 0.65 else []),
            sea(rng, palette, extent_m=200, level_m=WATER_M),
            hills(rng, palette, distance_m=rng.uniform(110, 150)),
        ]
    )


def _ship(rng: np.random.Generator, palette: Palette, colours: list[int], dark: int) -> Mesh:
    """Build a container ship along the quay, with its bow just past the crane and its containers aft."""
    hull = palette.add(
        painted_steel(rng, ((0.08, 0.12, 0.2), (0.3, 0.06, 0.05), (0.07, 0.2, 0.15))[int(rng.integers(3))])
    )
    white = palette.add(painted_steel(rng, (0.78, 0.78, 0.75)))
    outline = [(2.3, -15), (4.7, -15), (4.7, -0.2), (4.4, 1.0), (3.5, 2.3), (2.6, 1.0), (2.3, -0.2)]
    deck_m = 0.3
    rim = np.insert(np.array(outline)[2:], 2, deck_m, axis=1)
    x, y = (values.ravel() for values in np.meshgrid(2.6 + 0.36 * np.arange(6), -1.6 - 1.25 * np.arange(5)))
    return join_meshes(
        [
            prism(outline, 1.3, hull).translate(z=deck_m - 1.3),
            railing(rim, 0.16, 0.4, 0.008, white),
            boxes((3.5, -9.6, 1.3), (2.2, 1.2, 2.2), white),
            boxes((3.5, -9.0, 1.95), (2.0, 0.04, 0.3), dark),
            bars(np.array([[(3.5, 1.4, deck_m), (3.5, 1.4, 1.3)]]), 0.03, white),
            _stacks(rng, colours, dark, np.stack([x, y, np.full_like(x, deck_m)], -1)),
        ]
    )


def _yard(rng: np.random.Generator, colours: list[int], dark: int) -> Mesh:
    """Build container stacks on the landward side."""
    x, y = (values.ravel() for values in np.meshgrid(-3.2 - 0.31 * np.arange(4), -1.2 - 1.35 * np.arange(8)))
    return _stacks(rng, colours, dark, np.stack([x, y, 0 * x], -1))


def _stacks(rng: np.random.Generator, colours: list[int], dark: int, feet_m: np.ndarray) -> Mesh:
    """Build a stack of zero to four containers along y at each point of `feet_m`."""
    high = rng.integers(0, 5, len(feet_m))
    level = np.concatenate([np.arange(count) for count in high])
    at = np.repeat(feet_m, high, axis=0) + level[:, None] * [0, 0, CONTAINER_M[2]]
    colour = rng.integers(len(colours), size=len(at))
    poses = np.tile(rotation((0, 0, 1), 90), (len(at), 1, 1))
    poses[:, :3, 3] = at
    return join_meshes([copies(_container(tint, dark), poses[colour == k]) for k, tint in enumerate(colours)])


def _mirror(mesh: Mesh) -> Mesh:
    """Mirror the mesh in y, keeping its triangles counter-clockwise."""
    flip = np.array([1, -1, 1], np.float32)
    return replace(
        mesh,
        corners_m=mesh.corners_m[:, ::-1] * flip,
        normals=mesh.normals[:, ::-1] * flip,
        uv_m=mesh.uv_m[:, ::-1].copy(),
    )
