"""Deck gear for ships, such as winches, nets, derricks, containers and boats. The bow is at +x.

`at_m` is the position of the gear on the deck.
"""

import numpy as np

from stereoweave.synth.props.deckhouses import ShipMaterials
from stereoweave.synth.props.primitives import (
    Point,
    Points,
    boxes,
    copies,
    lathe,
    loft,
    polyline_tubes,
    rotation,
    sheet,
    spheres,
    sweep,
    translation,
    tubes,
)
from stereoweave.synth.world import Mesh, join_meshes


def winch(at_m: Point, width_m: float, materials: ShipMaterials, load: int) -> Mesh:
    """Build a winch on a bed: a transverse drum, wound with rope or net, between two cheeks."""
    half = width_m / 2
    turns = np.linspace(-0.82 * half, 0.82 * half, 24)
    bulge = 0.19 + 0.05 * np.cos(turns / half * 1.4) + 0.012 * np.sin(np.arange(24) * 2.1)
    drum = [(0.0, -0.85 * half), *np.stack([bulge, turns], -1), (0.0, 0.85 * half)]
    cheek = [(0, -0.02), (0.34, -0.02), (0.34, 0.02), (0, 0.02)]
    lying = rotation((1, 0, 0), 90)
    cheeks = [lathe(cheek, materials.trim, 28).translate(z=side * 0.87 * half) for side in (1, -1)]
    turning = join_meshes([lathe(drum, load, 28, crease_deg=80), *cheeks]).transform(lying).translate(z=0.4)
    bed = boxes(
        [(0, -half, 0.22), (0, half, 0.22), (0, 0, 0.03)],
        [(0.3, 0.06, 0.48), (0.3, 0.06, 0.48), (0.8, width_m + 0.1, 0.06)],
        materials.steel,
    )
    return join_meshes([turning, bed]).translate(*at_m)


def gantry(at_m: Point, width_m: float, height_m: float, materials: ShipMaterials) -> Mesh:
    """Build a gantry that leans aft over the stern and carries hanging blocks."""
    half, lean = width_m / 2, -0.25 * height_m
    frame = [(0, -half, 0), (lean, -0.85 * half, height_m), (lean, 0.85 * half, height_m), (0, half, 0)]
    portal = polyline_tubes(frame, 0.06, materials.trim, sides=12)
    braces = tubes(
        [(0.7, -half, 0), (0.7, half, 0)],
        [(0.75 * lean, -0.88 * half, 0.75 * height_m), (0.75 * lean, 0.88 * half, 0.75 * height_m)],
        0.035,
        materials.trim,
        sides=8,
    )
    y = np.array([-0.55, 0.0, 0.55]) * half
    hung = np.stack([np.full(3, lean), y, np.full(3, height_m)], -1)
    falls = tubes(hung, hung - [0, 0, 0.3], 0.012, materials.steel)
    blocks = tubes(hung - [0, 0.03, 0.36], hung - [0, -0.03, 0.36], 0.075, materials.dark, sides=14)
    knees = spheres(frame, 0.075, materials.trim, 1)
    return join_meshes([portal, braces, falls, blocks, knees]).translate(*at_m)


def derrick(foot_m: Point, tip_m: Point, top_m: Point, materials: ShipMaterials) -> Mesh:
    """Build a derrick: a boom from foot to tip, held by wires from top_m and carrying a hook."""
    middle = (foot_m + tip_m) / 2
    boom = tubes(
        [foot_m, middle], [middle, tip_m], np.array([[0.03, 0.05], [0.05, 0.025]]), materials.trim, sides=12
    )
    side = np.array([0, 0.04, 0])
    lift = tubes(
        [top_m + side, top_m - side, middle + 3 * side],
        [tip_m + side, tip_m - side, tip_m - 0.9 * side],
        0.007,
        materials.steel,
        4,
    )
    low = tip_m - [0, 0, 0.35 * np.linalg.norm(tip_m - foot_m)]
    falls = tubes(
        [tip_m + 0.5 * side, tip_m - 0.5 * side],
        [low + 0.5 * side, low - 0.5 * side],
        0.006,
        materials.steel,
        4,
    )
    block = boxes(low - [0, 0, 0.06], (0.08, 0.1, 0.16), materials.trim)
    angle = np.linspace(-0.5 * np.pi, np.pi, 9)
    hook = np.stack([0 * angle, 0.05 * np.cos(angle), 0.05 * np.sin(angle)], -1)[::-1] - [0, 0, 0.2]
    return join_meshes([boom, lift, falls, block, sweep(low + hook, 0.014, materials.dark, 6)])


def nets(
    rng: np.random.Generator, at_m: Point, size_m: tuple[float, float], materials: ShipMaterials
) -> Mesh:
    """Build a heap of nets with floats.

    size_m: length along the ship and width across it.
    """
    x, y = np.meshgrid(np.linspace(-1, 1, 22), np.linspace(-1, 1, 20))
    mound = np.clip(1 - x**4, 0, 1) * np.clip(1 - y**4, 0, 1)
    rough = sum(
        rng.uniform(0.1, 0.25) * np.sin(rng.normal(0, 5) * x + rng.normal(0, 5) * y + rng.uniform(0, 6))
        for _ in range(5)
    )
    z = 0.28 * mound * (1 + rough)
    heap = sheet(np.stack([x * size_m[0] / 2, y * size_m[1] / 2, z], -1), materials.rope)
    pick = rng.integers(3, 17, (14, 2))
    floats = np.stack(
        [values[pick[:, 0], pick[:, 1]] for values in (x * size_m[0] / 2, y * size_m[1] / 2, z)], -1
    )
    return join_meshes([heap, spheres(floats, 0.07, materials.orange, 1)]).translate(*at_m)


def containers(at_m: Points, colours: tuple[int, ...]) -> Mesh:
    """Build ribbed containers [N], 1.5 m long, in alternating colours.

    at_m: centre of each container's floor.
    """
    ribs = np.linspace(-0.68, 0.68, 18)
    meshes = []
    for k, material in enumerate(colours):
        spots = at_m[k :: len(colours)]
        if len(spots) == 0:
            continue
        body = boxes((0, 0, 0.33), (1.48, 0.6, 0.62), material)
        walls = boxes(np.stack([ribs, 0 * ribs, 0 * ribs + 0.33], -1), (0.04, 0.635, 0.58), material)
        posts = boxes(
            [(x, y, 0.33) for x in (-0.73, 0.73) for y in (-0.29, 0.29)], (0.07, 0.07, 0.66), material
        )
        ends = boxes(
            [(x, y, 0.33) for x in (-0.735, 0.735) for y in (-0.15, 0.0, 0.15)], (0.05, 0.03, 0.6), material
        )
        poses = np.stack([translation(*spot) for spot in spots])
        meshes.append(copies(join_meshes([body, walls, posts, ends]), poses))
    return join_meshes(meshes)


def hatches(x_m: tuple[float, float], width_m: float, z_m: float, materials: ShipMaterials) -> Mesh:
    """Build a ribbed hatch coaming with covers."""
    length, middle = x_m[1] - x_m[0], sum(x_m) / 2
    coaming = boxes((middle, 0, z_m + 0.1), (length, width_m, 0.3), materials.trim)
    count = max(int(length / 0.55), 2)
    edges = np.linspace(x_m[0], x_m[1], count + 1)
    covers = np.stack([(edges[1:] + edges[:-1]) / 2, np.zeros(count), np.full(count, z_m + 0.29)], -1)
    lids = boxes(covers, (length / count - 0.03, width_m + 0.08, 0.08), materials.roof)
    ribs = np.linspace(x_m[0], x_m[1], 3 * count + 1)[:, None] * [1, 0, 0] + [0, 0, z_m + 0.1]
    return join_meshes([coaming, lids, boxes(ribs, (0.03, width_m + 0.06, 0.28), materials.trim)])


def boat(at_m: Point, length_m: float, materials: ShipMaterials) -> Mesh:
    """Build an inflatable boat on a cradle, with its bow forward."""
    half, wide = length_m / 2, 0.2 * length_m
    share = np.linspace(-1, 1, 31)
    x = half * (1 - 1.75 * np.abs(share) ** 2.2)
    y = wide * np.sign(share) * np.clip(np.abs(share) * 2.4, 0, 1) ** 0.7
    rim = np.stack([x, y, 0.26 + 0.08 * np.clip(x / half, 0, 1) ** 2], -1)
    tube = sweep(rim, 0.09 * (1 - 0.35 * np.abs(share) ** 8), materials.orange, sides=12)
    floor = np.linspace(-0.75 * half, 0.9 * half, 8)
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    breadth = wide * np.sqrt(np.clip(1 - (floor / half) ** 4, 0.05, 1))[:, None]
    keel = np.stack(
        [floor[:, None] + 0 * angle, breadth * np.cos(angle), 0.18 + 0.1 * np.sin(angle) + 0 * breadth], -1
    )
    motor = boxes(
        [(-0.85 * half, 0, 0.42), (-0.86 * half, 0, 0.16)],
        [(0.16, 0.14, 0.22), (0.07, 0.05, 0.4)],
        materials.dark,
    )
    seat = boxes((-0.15 * half, 0, 0.33), (0.3, 0.22, 0.24), materials.white)
    cradle = boxes(
        [(x, 0, 0.05) for x in (-0.5 * half, 0.45 * half)], (0.06, 1.5 * wide, 0.12), materials.steel
    )
    return join_meshes([tube, loft(keel, materials.dark), motor, seat, cradle]).translate(*at_m)


def rafts(at_m: Points, materials: ShipMaterials) -> Mesh:
    """Build life rafts [N] in white canisters that lie lengthwise on cradles."""
    barrel = [(0, -0.27), (0.1, -0.26), (0.14, -0.22), (0.145, 0.0), (0.14, 0.22), (0.1, 0.26), (0, 0.27)]
    bands = [lathe([(0.147, z), (0.147, z + 0.025)], materials.dark, 20) for z in (-0.15, -0.01, 0.12)]
    lying = (
        join_meshes([lathe(barrel, materials.white, 20), *bands])
        .transform(rotation((0, 1, 0), 90))
        .translate(z=0.2)
    )
    cradle = boxes([(x, 0, 0.05) for x in (-0.15, 0.15)], (0.04, 0.24, 0.12), materials.steel)
    return copies(join_meshes([lying, cradle]), np.stack([translation(*spot) for spot in at_m]))


def vents(at_m: Points, materials: ShipMaterials) -> Mesh:
    """Build mushroom-shaped vents [N]."""
    profile = [(0.06, 0), (0.06, 0.24), (0.11, 0.23), (0.12, 0.28), (0.08, 0.33), (0, 0.345)]
    return copies(lathe(profile, materials.white, 14), np.stack([translation(*spot) for spot in at_m]))


def bitts(at_m: Points, materials: ShipMaterials) -> Mesh:
    """Build pairs of bitts [N] in line with the ship, with a rope belayed around each pair."""
    post = [(0.045, 0), (0.045, 0.17), (0.06, 0.18), (0.06, 0.21), (0, 0.22)]
    pair = [lathe(post, materials.dark, 12).translate(x=x) for x in (-0.1, 0.1)]
    angle = np.linspace(0, 6 * np.pi, 49)
    eight = np.stack([0.14 * np.cos(angle), 0.065 * np.sin(angle), 0.05 + 0.005 * angle], -1)
    one = join_meshes([*pair, sweep(eight, 0.013, materials.rope, 5)])
    return copies(one, np.stack([translation(*spot) for spot in at_m]))


def coil(at_m: Point, materials: ShipMaterials) -> Mesh:
    """Build a coil of rope."""
    angle = np.linspace(0, 12 * np.pi, 110)
    radius = 0.2 - 0.05 * (angle / (12 * np.pi)) + 0.03 * np.sin(angle * 0.51)
    path = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.02 + angle * 0.0035], -1)
    return sweep(path, 0.017, materials.rope, 6).translate(*at_m)


def flag(
    rng: np.random.Generator, foot_m: Point, height_m: float, materials: ShipMaterials, cloth: int
) -> Mesh:
    """Build a flag on a staff, blowing aft."""
    top = foot_m + [-0.1, 0, height_m]
    staff = tubes(foot_m, top, 0.011, materials.white)
    x, z = np.meshgrid(np.linspace(0, 0.5, 20), np.linspace(-0.3, 0, 8))
    wave = 0.16 * x * np.sin(9 * x + 1.5 * z + rng.uniform(0, 6))
    blown = sheet(top + np.stack([-x, wave, z - 0.25 * x * x], -1), cloth)
    return join_meshes([staff, spheres(top, 0.02, materials.white, 1), blown])


def anchor(at_m: Point, side: float, materials: ShipMaterials) -> Mesh:
    """Build an anchor at the bow, with its shank in the hawsepipe."""
    out = np.array([0.1, side, 0])
    shank = tubes(at_m + 0.03 * out, at_m + 0.05 * out + [0, 0, -0.26], 0.022, materials.dark, 8)
    crown = at_m + 0.06 * out + [0, 0, -0.27]
    flukes = tubes(
        crown + [[0.13, 0, 0.0], [-0.13, 0, 0.0]],
        crown + [[0.12, 0, 0.15], [-0.12, 0, 0.15]],
        np.array([[0.035, 0.006]] * 2),
        materials.dark,
        8,
    )
    arm = tubes(crown - [0.14, 0, 0], crown + [0.14, 0, 0], 0.03, materials.dark, 8)
    pipe = spheres(at_m, 0.07, materials.dark, 1)
    return join_meshes([shank, flukes, arm, pipe])
