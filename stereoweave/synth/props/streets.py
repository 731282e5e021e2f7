"""Streets along x, with a carriageway, house fronts, vehicles, people and street furniture."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.lattice import galvanised_steel
from stereoweave.synth.props.people_and_animals import draw_clothes, person
from stereoweave.synth.props.primitives import boxes, polyline_tubes, prism, rotation, spheres, tubes
from stereoweave.synth.props.random_materials import draw_material_from, draw_muted_colour
from stereoweave.synth.props.surroundings import bollards, bushes, fence, trees
from stereoweave.synth.props.vehicles import fleet
from stereoweave.synth.stage import Palette
from stereoweave.synth.world import Material, Mesh, join_meshes

_FRONTS = ("brick", "plaster", "plain", "concrete", "paint", "stone", "wood")
_KERB_M = 0.12
_START_M, _END_M = -30.0, 110.0


@dataclass(frozen=True, kw_only=True)
class StreetPlan:
    """Dimensions of a street.

    Attributes:
        half_m: half the width of the carriageway.
        pavement_m: width of each pavement.
        lane_m: y coordinate of the cameras' lane.
    """

    half_m: float
    pavement_m: float
    lane_m: float

    @property
    def fronts_m(self) -> float:
        """Distance of the house fronts from the street's centre line."""
        return self.half_m + self.pavement_m


def draw_street_plan(rng: np.random.Generator) -> StreetPlan:
    """Draw a random street plan with parking and one lane each way; traffic keeps right or left."""
    half_m = rng.uniform(4.2, 6.5)
    side = float(rng.choice([-1.0, 1.0], p=[0.75, 0.25]))
    return StreetPlan(half_m=half_m, pavement_m=rng.uniform(1.6, 4.0), lane_m=side * (half_m - 2.1) / 2)


def carriageway(rng: np.random.Generator, palette: Palette, plan: StreetPlan) -> Mesh:
    """Build the carriageway at z = 0, with markings and raised pavements."""
    asphalt = palette.add(
        _ground(rng, str(rng.choice(["asphalt", "plain", "concrete"], p=[0.6, 0.25, 0.15])), 6.0)
    )
    paving = palette.add(_ground(rng, str(rng.choice(["concrete", "asphalt", "tiles", "plain"])), 3.0))
    white = palette.add(Material(texture="paint", tint=(0.85, 0.85, 0.82), variant=int(rng.integers(4))))
    length_m, x = _END_M - _START_M, (_START_M + _END_M) / 2
    road = boxes([[x, 0, -0.2]], [[length_m, 2 * plan.half_m, 0.4]], asphalt)
    middles_m = plan.half_m + plan.pavement_m / 2
    pavements = boxes(
        [[x, side * middles_m, _KERB_M / 2 - 0.2] for side in (-1, 1)],
        [length_m, plan.pavement_m, _KERB_M + 0.4],
        paving,
    )
    dashes_m = np.arange(_START_M, 70.0, rng.uniform(4, 9))
    dashes = boxes([[at, 0, 0.005] for at in dashes_m], [rng.uniform(1.5, 3), 0.12, 0.014], white)
    parts = [road, pavements, dashes]
    if rng.random() < 0.4:
        stripes = np.arange(-plan.half_m + 0.5, plan.half_m - 0.3, 1.0)
        at_m = rng.uniform(0, 20)
        parts.append(boxes([[at_m, y, 0.005] for y in stripes], [3.0, 0.5, 0.014], white))
    return join_meshes(parts)


def fronts(rng: np.random.Generator, palette: Palette, plan: StreetPlan) -> Mesh:
    """Build two rows of houses with some gaps.

    Sometimes, a fence with bushes and trees replaces one row.
    """
    walls = [palette.add(draw_material_from(rng, _FRONTS, 12.0)) for _ in range(6)]
    glass = palette.add(Material(texture="plain", tint=(0.07, 0.09, 0.11), roughness=0.08))
    trim = palette.add(Material(texture="plain", tint=draw_muted_colour(rng, 0.2), roughness=0.7, relief=0.1))
    roof = palette.add(draw_material_from(rng, ("tiles",), 15.0))
    green = int(rng.choice([-1, 1])) if rng.random() < 0.3 else 0
    parts = []
    for side in (-1, 1):
        if side == green:
            parts.append(_green(rng, palette, plan, side))
            continue
        x = _START_M + rng.uniform(0, 6)
        while x < _END_M:
            size_m = rng.uniform([6, 7, 4], [18, 10, 15])
            house = _house(rng, size_m, walls[int(rng.integers(6))], glass, trim)
            roofed = join_meshes([house, _ridge(size_m, roof)]) if rng.random() < 0.5 else house
            away_m = plan.fronts_m + rng.choice([0.0, rng.uniform(0, 3)])
            facing = roofed if side > 0 else roofed.transform(rotation((0, 0, 1), 180)).translate(x=size_m[0])
            parts.append(facing.translate(x=x, y=side * away_m))
            x += size_m[0] + rng.choice([0.0, rng.uniform(2, 9)], p=[0.75, 0.25])
    return join_meshes(parts)


def traffic(rng: np.random.Generator, palette: Palette, plan: StreetPlan) -> Mesh:
    """Build parked and moving vehicles.

    Vehicles are parked along both kerbs. At most one vehicle drives ahead of the cameras, and up to two are
    oncoming.
    """
    kinds = [*fleet(rng, palette), *fleet(rng, palette)[:2]]
    cars = [kinds[k] for k in (0, 1, 4, 5)]
    poses = []
    for side in (-1, 1):
        x, share = -6.0 + rng.uniform(0, 6), rng.uniform(0.3, 1.0)
        while x < 45:
            if rng.random() < share:
                poses.append((x, side * (plan.half_m - 1.1), rng.choice([0.0, 180.0]), cars))
            x += rng.uniform(5.2, 7.5)
    lane = float(np.sign(plan.lane_m))
    if rng.random() < 0.7:
        poses.append((rng.uniform(2, 22), plan.lane_m, 0.0, kinds))
    for x in rng.uniform(8, 45, int(rng.integers(0, 3))):
        poses.append((float(x), -lane * abs(plan.lane_m), 180.0, kinds))
    vehicles = []
    for x, y, heading_deg, choice in poses:
        vehicle = choice[int(rng.integers(len(choice)))]
        turned = vehicle.transform(rotation((0, 0, 1), heading_deg + rng.normal(0, 1.5)))
        vehicles.append(turned.translate(x, y + rng.normal(0, 0.1)))
    return join_meshes(vehicles) if vehicles else kinds[0].translate(25.0, plan.half_m - 1.1)


def walkers(rng: np.random.Generator, palette: Palette, plan: StreetPlan) -> Mesh:
    """Build two to ten people, most of them on the pavements and a few crossing the street."""
    clothes = [draw_clothes(rng, palette) for _ in range(3)]
    people = []
    for _ in range(int(rng.integers(2, 11))):
        side, crossing = rng.choice([-1, 1]), rng.random() < 0.1
        y = rng.uniform(-0.8, 0.8) * plan.half_m if crossing else side * _on_pavement(rng, plan)
        z = 0.0 if crossing else _KERB_M
        heading_deg = rng.uniform(0, 360) if crossing else rng.choice([0, 180]) + rng.normal(0, 15)
        mesh = person(rng, clothes[int(rng.integers(3))]).transform(rotation((0, 0, 1), heading_deg))
        people.append(mesh.translate(rng.uniform(-3, 28), y, z))
    return join_meshes(people)


def street_furniture(rng: np.random.Generator, palette: Palette, plan: StreetPlan) -> Mesh:
    """Build lamp posts and signs on the pavements and, sometimes, bollards, trees and wires."""
    steel = palette.add(galvanised_steel(rng))
    signs = [palette.add(draw_material_from(rng, ("sign", "paint", "plain"), 6.0)) for _ in range(2)]
    at_m = np.arange(rng.uniform(-8, 4), 80, rng.uniform(12, 26))
    sides = np.where(np.arange(len(at_m)) % 2 == 0, 1.0, -1.0) if rng.random() < 0.5 else np.ones(len(at_m))
    kerb_m = plan.half_m + 0.35
    parts = [_lamp_post(x, side * kerb_m, -side, steel) for x, side in zip(at_m, sides, strict=True)]
    if rng.random() < 0.5:
        parts += [_wires(rng, at_m, sides[0] * kerb_m, steel)]
    for x in rng.uniform(-5, 40, int(rng.integers(2, 7))):
        parts.append(_sign(rng, steel, signs).translate(x, rng.choice([-1, 1]) * kerb_m))
    if rng.random() < 0.6:
        spots = np.array([[x, s * kerb_m, 0] for x in np.arange(-4, 60, rng.uniform(7, 14)) for s in (-1, 1)])
        parts.append(trees(rng, palette, spots[rng.random(len(spots)) < 0.7].reshape(-1, 3), (4, 8)))
    if rng.random() < 0.4:
        line = np.array([[x, rng.choice([-1, 1]) * kerb_m, 0.1] for x in np.arange(-2, 14, 2.0)])
        parts.append(bollards(rng, palette, line))
    return join_meshes(parts)


def _ground(rng: np.random.Generator, family: str, span_m: float) -> Material:
    grey = rng.uniform(0.08, 0.4) if family == "plain" else rng.uniform(0.8, 1.1)
    return Material(
        texture=family,
        variant=int(rng.integers(64)),
        tint=(grey, grey, grey),
        span_m=span_m * rng.uniform(0.7, 2.0),
        roughness=0.95,
        relief=rng.uniform(0.1, 0.6),
    )


def _on_pavement(rng: np.random.Generator, plan: StreetPlan) -> float:
    return plan.half_m + rng.uniform(0.6, max(plan.pavement_m - 0.3, 0.8))


def _house(
    rng: np.random.Generator, size_m: Float[np.ndarray, "3"], wall: int, glass: int, trim: int
) -> Mesh:
    """Build a house that extends from the origin along x and y, with its front at y = 0.

    On the ground floor, the front has shop windows, or a door and windows. The other floors have windows.
    """
    length_m, deep_m, high_m = (float(v) for v in size_m)
    block = boxes([[length_m / 2, deep_m / 2, high_m / 2 - 0.3]], [[length_m, deep_m, high_m + 0.6]], wall)
    cornice = boxes([[length_m / 2, 0, high_m - 0.15]], [[length_m, 0.5, 0.3]], trim)
    columns = np.linspace(0, length_m, int(length_m / rng.uniform(2.0, 3.4)) + 1)
    middles_m, width_m = (columns[1:] + columns[:-1]) / 2, 0.5 * float(columns[1])
    parts = [block, cornice]
    upper = [(x, z) for z in np.arange(4.5, high_m - 1.2, 3.0) for x in middles_m]
    if upper:
        parts.append(_panes(upper, width_m, rng.uniform(1.1, 1.8), glass, trim))
    if rng.random() < 0.35:
        parts.append(_panes([(x, 1.5) for x in middles_m], 1.7 * width_m, 2.2, glass, trim))
    else:
        door = int(rng.integers(len(middles_m)))
        parts.append(boxes([[middles_m[door], 0, 1.1]], [[1.0, 0.16, 2.2]], trim))
        rest = [(x, 1.6) for k, x in enumerate(middles_m) if k != door]
        parts += [_panes(rest, width_m, 1.3, glass, trim)] if rest else []
    return join_meshes(parts)


def _panes(spots_m: list[tuple[float, float]], width_m: float, high_m: float, glass: int, trim: int) -> Mesh:
    """Build windows at points (x, z) on a house front.

    The frames protrude from the wall, and the panes protrude from the frames.
    """
    centres = np.array([[x, 0, z] for x, z in spots_m])
    frames = boxes(centres, [width_m + 0.2, 0.1, high_m + 0.2], trim)
    panes = boxes(centres, [width_m, 0.16, high_m], glass)
    bars = boxes(centres, [0.06, 0.2, high_m], trim)
    return join_meshes([frames, panes, bars])


def _ridge(size_m: Float[np.ndarray, "3"], material: int) -> Mesh:
    """Build a roof over a house, with its ridge along x."""
    length_m, deep_m, high_m = (float(v) for v in size_m)
    outline = [(-0.3, high_m), (deep_m + 0.3, high_m), (deep_m / 2, high_m + 0.35 * deep_m)]
    upright = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    return prism(outline, length_m, material).transform(upright)


def _green(rng: np.random.Generator, palette: Palette, plan: StreetPlan, side: int) -> Mesh:
    """Build a fence along the pavement, with bushes and trees behind it."""
    y = side * (plan.fronts_m + 0.3)
    line = np.array([[x, y, 0.0] for x in (_START_M / 2, 70.0)])
    x = np.arange(-10, 60, 3.0)
    shrubs = np.stack([x + rng.normal(0, 0.5, len(x)), y + side * rng.uniform(1, 4, len(x)), 0 * x], -1)
    far = np.stack([x[::2], y + side * rng.uniform(5, 14, len(x[::2])), 0 * x[::2]], -1)
    return join_meshes(
        [fence(rng, palette, line), bushes(rng, palette, shrubs), trees(rng, palette, far, (5, 11))]
    )


def _lamp_post(x: float, y: float, inwards: float, steel: int) -> Mesh:
    """Build a lamp post with an arm over the carriageway."""
    top, arm = [x, y, 6.2], [x, y + 1.3 * inwards, 6.5]
    post = tubes([[x, y, 0], top], [top, arm], [[0.09, 0.06], [0.05, 0.04]], steel, 10)
    return join_meshes([post, spheres([arm], [[0.12, 0.35, 0.08]], steel)])


def _wires(rng: np.random.Generator, at_m: Float[np.ndarray, " n"], y: float, steel: int) -> Mesh:
    """Build one to four wires that sag between posts."""
    share = np.linspace(0, 1, 9)
    sag_m = rng.uniform(0.2, 0.6)
    wires = []
    for k in range(int(rng.integers(1, 5))):
        for start, end in zip(at_m[:-1], at_m[1:], strict=True):
            z = 5.9 - 0.25 * k - 4 * sag_m * share * (1 - share)
            points = np.stack([start + share * (end - start), y + 0 * share, z], -1)
            wires.append(polyline_tubes(points, 0.012, steel, 5))
    return join_meshes(wires)


def _sign(rng: np.random.Generator, steel: int, faces: list[int]) -> Mesh:
    """Build a round, square or triangular sign on a post, facing the traffic."""
    high_m, half_m = rng.uniform(2.0, 2.8), rng.uniform(0.25, 0.45)
    corners = int(rng.choice([3, 4, 24]))
    angle = np.arange(corners) * 2 * np.pi / corners + np.pi / 2
    outline = half_m * np.stack([np.cos(angle), np.sin(angle)], -1)
    plate = prism(outline, 0.02, faces[int(rng.integers(len(faces)))])
    # This turns the x axis of the outline across the street, y upwards and z towards the traffic.
    facing = np.array([[0.0, 0, -1, -0.06], [-1, 0, 0, 0], [0, 1, 0, high_m - half_m], [0, 0, 0, 1]])
    post = tubes([[0, 0, 0]], [[0, 0, high_m]], 0.035, steel, 8)
    return join_meshes([post, plate.transform(rotation((0, 0, 1), rng.normal(0, 8)) @ facing)])
