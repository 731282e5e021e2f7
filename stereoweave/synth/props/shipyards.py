"""Dry docks and shipyards, with blocks and shores under the hull, scaffolds and work lamps.

Aft is +x, and the propeller is at the origin.
"""

from collections.abc import Callable

import numpy as np

from stereoweave.synth.props import surroundings
from stereoweave.synth.props.lattice import bars, galvanised_steel, ladder, railing
from stereoweave.synth.props.primitives import Points, boxes, rotation, sheet, sweep, translation, tubes
from stereoweave.synth.props.sterns import Stern
from stereoweave.synth.props.surroundings import vary_colour
from stereoweave.synth.stage import Palette
from stereoweave.synth.world import Lamp, Material, Mesh, join_meshes

Clutter = Callable[[np.random.Generator, Palette, Points], Mesh]

_STEP_M = 0.6


def dock(rng: np.random.Generator, palette: Palette, floor_m: float, half_m: float) -> Mesh:
    """Build a dry dock with stepped walls and stairs, and the buildings around it.

    half_m: half the width of the dock's floor.
    """
    wall, bed, land = (_concrete(rng, palette, tone) for tone in (0.75, 0.65, 0.7))
    rise_m = rng.uniform(1.4, 1.9)
    top_m = floor_m + 4 * rise_m
    stern_m = rng.uniform(13, 17)
    steps = np.arange(3)
    inner = half_m + _STEP_M * steps
    pieces = [
        boxes((-11, 0, floor_m - 0.5), (60, 2 * half_m + 1, 1), bed),
        _land(floor_m, top_m, half_m + 3 * _STEP_M, stern_m, land),
    ]
    for side in (1, -1):
        centres = np.stack([np.full(3, -11.0), side * (inner + 2), floor_m + rise_m * (steps + 1) / 2], -1)
        pieces.append(
            boxes(centres, np.stack([np.full(3, 60.0), np.full(3, 4.0), rise_m * (steps + 1)], -1), wall)
        )
    steel = palette.add(galvanised_steel(rng))
    pieces += [_stairs(floor_m, top_m, half_m * side, steel, wall) for side in (1, -1)]
    pieces += [
        _edge(top_m, half_m + 3 * _STEP_M + 0.4, steel),
        _above(rng, palette, half_m).translate(z=top_m),
    ]
    return join_meshes(pieces)


def yard(rng: np.random.Generator, palette: Palette, floor_m: float) -> Mesh:
    """Build the open ground of a shipyard with sheds, a fence, trees and hills."""
    ground = str(rng.choice(["concrete", "asphalt", "gravel"]))
    base = surroundings.terrain(rng, palette, ground, bumps_m=0.1, flat_radius_m=25)
    sheds = surroundings.draw_spots(rng, 14, 20, 60)
    bounds = np.array([[-45, 16, 0], [14, 17, 0], [16, -17, 0], [-45, -16, 0]], float)
    greens = surroundings.draw_spots(rng, 16, 45, 100)
    return join_meshes(
        [
            base,
            surroundings.houses(rng, palette, _keep_clear_of_ship(sheds, 17)),
            surroundings.fence(rng, palette, bounds),
            surroundings.trees(rng, palette, _keep_clear_of_ship(greens, 20)),
            surroundings.hills(rng, palette),
        ]
    ).translate(z=floor_m)


def blocks(rng: np.random.Generator, palette: Palette, stern: Stern, floor_m: float) -> Mesh:
    """Build keel blocks and timber shores that support the hull."""
    concrete = _concrete(rng, palette, 0.6)
    timber = palette.add(
        Material(
            texture="wood", variant=int(rng.integers(64)), tint=vary_colour(rng, (0.6, 0.5, 0.4)), span_m=1.5
        )
    )
    x = np.arange(-2.6, -28, -1.6)[:, None] * [1, 0, 0]
    cap_m, high_m = 0.25, stern.keel_m - floor_m
    lower = boxes(x + [0, 0, floor_m + (high_m - cap_m) / 2], (0.9, 1.2, high_m - cap_m), concrete)
    upper = boxes(x + [0, 0, stern.keel_m - cap_m / 2 + 0.04], (0.8, 1.0, cap_m), timber)
    along = np.arange(-4.5, -24, -2.4)
    props = []
    for side in (1, -1):
        heads = stern.side_m(along, np.full(len(along), stern.water_m + 0.3), side)
        feet = heads * [1, 1, 0] + [0, side * 2.2, floor_m]
        props.append(tubes(feet, heads, 0.11, timber, sides=10))
    return join_meshes([lower, upper, *props])


def scaffold(rng: np.random.Generator, palette: Palette, floor_m: float, high_m: float) -> Mesh:
    """Build scaffolds on both sides of the hull, forward of the propeller; some have netting."""
    steel = palette.add(galvanised_steel(rng))
    planks = palette.add(
        Material(
            texture="wood",
            variant=int(rng.integers(64)),
            tint=vary_colour(rng, (0.75, 0.65, 0.5)),
            span_m=1.2,
        )
    )
    cloth = palette.add(
        Material(
            texture="cloth",
            variant=int(rng.integers(2)),
            tint=vary_colour(
                rng, [(0.78, 0.8, 0.74), (1.0, 0.98, 0.94), (0.62, 0.65, 0.7)][int(rng.integers(3))]
            ),
            span_m=0.7,
            roughness=1.0,
        )
    )
    pieces = []
    for side in (1, -1):
        tower = [_tower(rng, high_m, steel, planks)]
        if rng.random() < 0.6:
            tower.append(_netting(rng, high_m, cloth))
        near_m = rng.uniform(1.7, 2.6)
        pose = translation(-rng.uniform(2.6, 4.0), side * (near_m + 2.25), floor_m) @ rotation(
            (0, 0, 1), rng.normal(0, 4)
        )
        pieces.append(join_meshes(tower).transform(pose))
    return join_meshes(pieces)


def litter(rng: np.random.Generator, palette: Palette, floor_m: float, half_m: float) -> Mesh:
    """Build drums, crates, pallets, cones and hoses on the ground, away from the cameras."""
    kinds: tuple[Clutter, ...] = (
        surroundings.barrels,
        surroundings.crates,
        surroundings.pallets,
        surroundings.cones,
    )
    spots = np.stack(
        [rng.uniform(-9, -1.4, 16), rng.choice([-1, 1], 16) * rng.uniform(2.2, half_m - 1, 16), np.zeros(16)],
        -1,
    )
    things = [
        kind(rng, palette, spots[4 * k : 4 * k + int(rng.integers(2, 5))]) for k, kind in enumerate(kinds)
    ]
    rubber = palette.add(Material(texture="plain", tint=(0.05, 0.05, 0.06), roughness=0.7))
    hoses = [sweep(_hose_path(rng, half_m), rng.uniform(0.025, 0.05), rubber, sides=6) for _ in range(3)]
    return join_meshes([*things, *hoses]).translate(z=floor_m)


def work_lamps(rng: np.random.Generator, palette: Palette, floor_m: float) -> tuple[Mesh, tuple[Lamp, ...]]:
    """Build two work lamps on tripods beside the propeller; return the mesh and the light sources."""
    steel = palette.add(Material(texture="paint", tint=vary_colour(rng, (0.22, 0.2, 0.16)), roughness=0.5))
    glass = palette.add(Material(texture="plain", tint=(1.0, 0.97, 0.9), glow=2.5))
    strength = rng.uniform(2, 7)
    pieces, lights = [], []
    for side in (1, -1):
        foot = np.array([rng.uniform(0.6, 1.8), side * rng.uniform(3.0, 3.7), floor_m])
        head = foot + [0, 0, rng.uniform(1.4, 2.2)]
        legs = np.array([[0.5, 0, 0], [-0.3, 0.45, 0], [-0.3, -0.45, 0]])
        pieces.append(tubes(np.concatenate([foot + legs, [head - [0, 0, 0.4]]]), head, 0.014, steel))
        pieces.append(boxes(head + [0, 0, 0.12], (0.1, 0.26, 0.18), steel))
        pieces.append(boxes(head + [-0.03, 0, 0.12], (0.06, 0.22, 0.14), glass))
        # The light source is in front of its lamp; otherwise the lamp would be the brightest surface.
        light = head + [-0.4, -side * 0.4, 0.4]
        lights.append(Lamp(position_m=_triple(light), light=(strength, 0.93 * strength, 0.8 * strength)))
    return join_meshes(pieces), tuple(lights)


def _land(floor_m: float, top_m: float, half_m: float, stern_m: float, material: int) -> Mesh:
    """Build the ground around the dock from four blocks that extend below the dock's floor."""
    low_m, middle_m = floor_m - 1, (top_m + floor_m - 1) / 2
    deep_m, far_m = top_m - low_m, 110.0
    wide_m = far_m - half_m
    centres = [(0.0, side * (half_m + wide_m / 2), middle_m) for side in (1, -1)]
    centres += [((stern_m + far_m) / 2, 0.0, middle_m), ((-36 - far_m) / 2, 0.0, middle_m)]
    sizes = [(2 * far_m, wide_m, deep_m)] * 2
    sizes += [(far_m - stern_m, 2 * half_m, deep_m), (far_m - 36, 2 * half_m, deep_m)]
    return boxes(centres, sizes, material)


def _above(rng: np.random.Generator, palette: Palette, half_m: float) -> Mesh:
    """Build the surroundings of a dock: sheds, bollards, trees and hills."""
    far = _keep_clear_of_ship(surroundings.draw_spots(rng, 14, 22, 60), half_m + 9)
    x = np.arange(-28, 13, 8.0)
    beside = np.concatenate([np.stack([x, 0 * x + side * (half_m + 3.4), 0 * x], -1) for side in (1, -1)])
    return join_meshes(
        [
            surroundings.houses(rng, palette, far),
            surroundings.bollards(rng, palette, beside),
            surroundings.trees(
                rng, palette, _keep_clear_of_ship(surroundings.draw_spots(rng, 16, 40, 90), half_m + 20)
            ),
            surroundings.hills(rng, palette),
        ]
    )


def _edge(top_m: float, half_m: float, steel: int) -> Mesh:
    paths = [np.array([[-36.0, side * half_m, top_m], [12.0, side * half_m, top_m]]) for side in (1, -1)]
    return join_meshes([railing(path, 1.1, 2.5, 0.03, steel) for path in paths])


def _stairs(floor_m: float, top_m: float, wall_m: float, steel: int, concrete: int) -> Mesh:
    """Build a flight of solid steps along the dock's wall at y = wall_m, with a handrail."""
    count = int((top_m - floor_m) / 0.24)
    step = np.arange(count)
    heights = (top_m - floor_m) * (step + 1) / count
    inside = -np.sign(wall_m)
    x, y = -14 + 0.32 * step, np.full(count, wall_m + inside * 0.6)
    centres = np.stack([x, y, floor_m + heights / 2], -1)
    flight = boxes(centres, np.stack([np.full(count, 0.32), np.full(count, 1.3), heights], -1), concrete)
    rail = np.stack([x, y + inside * 0.55, floor_m + heights], -1)[[0, -1]]
    return join_meshes([flight, railing(rail, 0.95, 1.2, 0.025, steel)])


def _tower(rng: np.random.Generator, high_m: float, steel: int, planks: int) -> Mesh:
    """Build a scaffold, 0.9 m deep, with three bays of 1.5 m along y.

    It consists of standards, ledgers, braces, planks and a ladder.
    """
    y, x = np.linspace(-2.25, 2.25, 4), np.array([-0.45, 0.45])
    levels = np.arange(0.3, high_m, 1.9)
    gx, gy = (v.ravel() for v in np.meshgrid(x, y))
    feet = np.stack([gx, gy, 0 * gx], -1)
    lx, lz = (v.ravel() for v in np.meshgrid(x, np.concatenate([levels, levels[1:] + 0.95])))
    along = np.stack([lx, 0 * lx - 2.4, lz], -1)
    ty, tz = (v.ravel() for v in np.meshgrid(y, levels))
    across = np.stack([0 * ty - 0.6, ty, tz], -1)
    brace = np.array([[[0.45, y[k], levels[0]], [0.45, y[k + 1], levels[-1]]] for k in (0, 2)])
    segments = np.concatenate(
        [
            np.stack([feet, feet + [0, 0, high_m]], 1),
            np.stack([along, along + [0, 4.8, 0]], 1),
            np.stack([across, across + [1.2, 0, 0]], 1),
            brace,
        ]
    )
    boards_x, boards_z = (v.ravel() for v in np.meshgrid([-0.3, 0, 0.3], levels[1:] + 0.05))
    boards = boxes(np.stack([boards_x, 0 * boards_x, boards_z], -1), (0.26, 4.8, 0.04), planks)
    at = float(rng.uniform(-1.5, 1.5))
    climb = ladder((1.0, at, 0.0), (0.5, at, float(levels[-1]) + 0.9), (0, 1, 0), 0.4, steel)
    return join_meshes([bars(segments, 0.028, steel, sides=6), boards, climb])


def _netting(rng: np.random.Generator, high_m: float, cloth: int) -> Mesh:
    """Build netting that hangs in folds on the front of a scaffold."""
    y, z = np.meshgrid(np.linspace(-2.3, 2.3, 28), np.linspace(rng.uniform(0.3, 1.2), high_m - 0.1, 14))
    folds = 0.05 * np.sin(y * rng.uniform(4, 7) + rng.uniform(0, 6)) * np.sin(z * 1.7 + rng.uniform(0, 6))
    return sheet(np.stack([0.53 + abs(folds), y, z], -1), cloth)


def _hose_path(rng: np.random.Generator, half_m: float) -> Points:
    """Draw a random path [40, 3] for a hose on the floor."""
    share = np.linspace(0, 1, 40)
    sway = sum(rng.normal(0, 0.6) / k * np.sin(k * np.pi * share + rng.uniform(0, 6)) for k in (2, 3, 5))
    ends = rng.uniform(-half_m + 1, half_m - 1, 2)
    x = rng.uniform(-7, 1) + 3 * share + sway
    return np.stack([x, ends[0] + (ends[1] - ends[0]) * share + np.roll(sway, 7), np.full(40, 0.04)], -1)


def _keep_clear_of_ship(spots: Points, half_m: float) -> Points:
    """Return the spots more than half_m away from the ship's centre line."""
    return spots[np.abs(spots[:, 1]) > half_m]


def _concrete(rng: np.random.Generator, palette: Palette, tone: float) -> int:
    return palette.add(
        Material(
            texture="concrete",
            variant=int(rng.integers(64)),
            tint=vary_colour(rng, (tone, tone * 0.98, tone * 0.94)),
            span_m=rng.uniform(3, 6),
            roughness=0.9,
            relief=0.5,
        )
    )


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
