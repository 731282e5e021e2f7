"""Scene `crane`: a tower crane over a building site, or a container crane on a quay."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.building_sites import building_site
from stereoweave.synth.props.lattice import (
    Truss,
    aviation_paints,
    bars,
    cables,
    chain_segments,
    galvanised_steel,
    ladder,
    mast_levels,
    mast_rings,
    painted_steel,
    railing,
    truss,
)
from stereoweave.synth.props.primitives import boxes, lathe, rotation, sweep, tubes
from stereoweave.synth.props.surroundings import daylight
from stereoweave.synth.scenes.quay_crane import quay_crane
from stereoweave.synth.stage import Palette, Stage, outdoor_stage
from stereoweave.synth.viewpoints import Orbit
from stereoweave.synth.world import Colour, Material, Mesh, join_meshes

PAINTS: tuple[Colour, ...] = (
    (0.72, 0.46, 0.05),
    (0.7, 0.52, 0.08),
    (0.55, 0.08, 0.05),
    (0.62, 0.62, 0.6),
    (0.1, 0.2, 0.4),
)


@dataclass(frozen=True, kw_only=True)
class TowerCranePlan:
    """Dimensions of a tower crane; the jib points along x and the counter-jib along -x.

    Attributes:
        ring_m: Height of the slewing ring on top of the mast.
        head_m: Height of the tower head above `deck_m`; 0 if there is no head.
        trolley_m: The x coordinate of the trolley.
        rope_m: Length of the rope from the jib to the hook.
    """

    ring_m: float
    side_m: float
    jib_m: float
    jib_height_m: float
    counter_m: float
    head_m: float
    trolley_m: float
    rope_m: float

    @property
    def deck_m(self) -> float:
        """Height of the jib's lower chords and of the counter-jib."""
        return self.ring_m + 0.22


@dataclass(frozen=True, kw_only=True)
class TowerCraneMaterials:
    """Materials of a tower crane."""

    mast: tuple[int, ...]
    jib: tuple[int, ...]
    frame: int
    concrete: int
    steel: int
    cab: int
    glass: int
    sign: int


def crane(rng: np.random.Generator) -> Stage:
    """Build a stage with a tower crane or a container crane, about 6 m in its largest dimension."""
    return _tower_crane(rng) if rng.random() < 0.68 else quay_crane(rng)


def _tower_crane(rng: np.random.Generator) -> Stage:
    palette, plan = Palette(), _draw_plan(rng)
    # Turn the crane away from the building shell at negative y, so that the load does not intersect it.
    target = _crane(rng, palette, plan).transform(rotation((0, 0, 1), rng.uniform(-8, 30)))
    site = building_site(rng, palette)
    light = daylight(rng)
    mesh = join_meshes([target.as_target(), site])
    orbit = Orbit(
        centre_m=((plan.jib_m - plan.counter_m) * 0.42, 0.0, 0.5 * (plan.deck_m + plan.head_m) + 0.1),
        distance_m=(7.3, 9.8),
        azimuth_deg=(40, 140),
        elevation_deg=(-17, 22),
        aim_m=0.6,
        floor_m=0.6,
    )
    return outdoor_stage(mesh, palette, light, orbit)


def _draw_plan(rng: np.random.Generator) -> TowerCranePlan:
    jib = rng.uniform(3.6, 4.3)
    head = float(rng.choice([0.0, 1.0], p=[0.25, 0.75])) * rng.uniform(0.85, 1.15)
    return TowerCranePlan(
        ring_m=rng.uniform(4.1, 4.7),
        side_m=rng.uniform(0.36, 0.46),
        jib_m=jib,
        jib_height_m=rng.uniform(0.24, 0.32) if head else rng.uniform(0.34, 0.4),
        counter_m=rng.uniform(0.38, 0.46) * jib,
        head_m=head,
        trolley_m=rng.uniform(0.3, 0.85) * jib,
        rope_m=rng.uniform(0.8, 2.4),
    )


def _draw_materials(rng: np.random.Generator, palette: Palette) -> TowerCraneMaterials:
    paint = PAINTS[int(rng.integers(len(PAINTS)))]
    colour = palette.add(painted_steel(rng, paint))
    banded = (
        tuple(palette.add(material) for material in aviation_paints(rng))
        if rng.random() < 0.25
        else (colour,)
    )
    mast = (palette.add(painted_steel(rng, (0.55, 0.55, 0.53))),) if rng.random() < 0.3 else (colour,)
    return TowerCraneMaterials(
        mast=mast,
        jib=banded,
        frame=colour,
        concrete=palette.add(Material(texture="concrete", variant=int(rng.integers(8)), span_m=1.2)),
        steel=palette.add(galvanised_steel(rng)),
        cab=palette.add(painted_steel(rng, (0.8, 0.8, 0.78), roughness=0.4)),
        glass=palette.add(Material(texture="plain", tint=(0.05, 0.07, 0.08), roughness=0.1)),
        sign=palette.add(Material(texture="sign", variant=int(rng.integers(8)), span_m=0.7, roughness=0.6)),
    )


def _crane(rng: np.random.Generator, palette: Palette, plan: TowerCranePlan) -> Mesh:
    materials = _draw_materials(rng, palette)
    return join_meshes(
        [
            _mast(plan, materials),
            _slewing(plan, materials),
            _jib_mesh(plan, materials),
            _counter_jib(rng, plan, materials),
            _pendants(plan, materials),
            _hook(plan, materials),
            _load(rng, plan, materials),
        ]
    )


def _mast(plan: TowerCranePlan, materials: TowerCraneMaterials) -> Mesh:
    """Build the mast with its ladder and landings, on a slab with four anchors."""
    joints = mast_rings(*mast_levels((0.3, plan.ring_m - 0.1), (plan.side_m, plan.side_m), 0.95))
    lattice = truss(joints, "zigzag").banded_mesh(0.024, 0.012, materials.mast, (np.inf, 0.8))
    landings = np.arange(1.0, plan.ring_m - 0.4, 0.9)[:, None] * [0, 0, 1]
    feet = joints[0] * [1, 1, 0]
    x = 0.12 * plan.side_m
    return join_meshes(
        [
            lattice,
            ladder((x, 0, 0.3), (x, 0, plan.ring_m - 0.1), (0, 1, 0), 0.11, materials.steel),
            boxes(
                landings - [0.25 * plan.side_m, 0, 0],
                (0.45 * plan.side_m, 0.9 * plan.side_m, 0.012),
                materials.steel,
            ),
            boxes((0, 0, 0.06), (1.5, 1.5, 0.22), materials.concrete),
            boxes(feet + [0, 0, 0.24], (0.11, 0.11, 0.16), materials.frame),
            boxes(
                (0, 0, plan.ring_m - 0.07), (plan.side_m + 0.12, plan.side_m + 0.12, 0.06), materials.frame
            ),
        ]
    )


def _slewing(plan: TowerCranePlan, materials: TowerCraneMaterials) -> Mesh:
    """Build the slewing ring, the platform with its railing, the cab, and the tower head if there is one."""
    z, half = plan.ring_m, plan.side_m / 2
    ring = lathe(
        [(0, -0.06), (half, -0.06), (half + 0.02, 0.0), (half, 0.03), (0, 0.03)], materials.steel, 28
    )
    corners = (half + 0.14) * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [-1, -1, 0]])
    middle = np.array([half + 0.2, half + 0.1, z + 0.0])
    size = np.array([0.36, 0.28, 0.38])
    parts = [
        ring.translate(z=z),
        boxes((0, 0, z + 0.13), (plan.side_m + 0.06, plan.side_m + 0.06, 0.18), materials.frame),
        boxes((0, 0, z - 0.12), (plan.side_m + 0.32, plan.side_m + 0.32, 0.015), materials.steel),
        railing(corners + [0, 0, z - 0.12], 0.19, 0.2, 0.007, materials.steel),
        boxes(middle, size, materials.cab),
        boxes(middle + [0.03, 0, 0.04], size * [1.02, 0.86, 0.62], materials.glass),
        boxes(middle + [0.05, 0, 0.04], size * [0.72, 1.03, 0.6], materials.glass),
        boxes(middle + [0, 0, 0.2], size * [1.12, 1.12, 0.05], materials.cab),
    ]
    if plan.head_m:
        stations = (plan.deck_m, plan.deck_m + plan.head_m)
        parts.append(
            truss(mast_rings(*mast_levels(stations, (0.8 * plan.side_m, 0.1), 1.0)), "cross").mesh(
                0.022, 0.011, materials.frame
            )
        )
        parts.append(tubes((0, 0, stations[1]), (0, 0, stations[1] + 0.3), 0.008, materials.steel))
    return join_meshes(parts)


def _jib(plan: TowerCranePlan) -> Float[np.ndarray, "k 3 3"]:
    """Return the joints of the jib's two lower chords and upper chord, which taper towards the tip."""
    count = max(round((plan.jib_m - 0.2) / 0.3), 2)
    x = np.linspace(0.2, plan.jib_m, count + 1)
    share = (x - 0.2) / (plan.jib_m - 0.2)
    half, height = np.full_like(x, 0.4 * plan.side_m), plan.jib_height_m * (1 - 0.35 * share)
    below = np.stack([x, half, 0 * x + plan.deck_m], -1)
    above = np.stack([x, 0 * x, plan.deck_m + height], -1)
    return np.stack([below * [1, -1, 1], below, above], 1)


def _jib_mesh(plan: TowerCranePlan, materials: TowerCraneMaterials) -> Mesh:
    joints = _jib(plan)
    lattice: Truss = truss(joints, "zigzag")
    # The trolley's rope runs along the jib between its chords.
    start, end = (joints[k, :2].mean(0) + [0, 0, 0.05] for k in (0, -1))
    return join_meshes(
        [
            lattice.banded_mesh(0.018, 0.0095, materials.jib, (0.62, np.inf)),
            cables(start, end, 0.005, materials.steel, sag_m=0.015),
            boxes(joints[-1].mean(0), (0.06, 0.8 * plan.side_m, 0.14), materials.frame),
        ]
    )


def _counter_jib(rng: np.random.Generator, plan: TowerCranePlan, materials: TowerCraneMaterials) -> Mesh:
    """Build the counter-jib: beams with a deck, railings, counterweights, a winch, a cabinet and signs."""
    end, half, z = -plan.counter_m, 0.42 * plan.side_m, plan.deck_m
    beams = [(0.5 * end, side * half, z) for side in (1, -1)]
    count = int(rng.integers(3, 6))
    at = np.array([[end + 0.12 + 0.13 * k, 0, z - 0.12] for k in range(count)])
    edge = np.array([[-0.2, half + 0.05, z + 0.04], [end, half + 0.05, z + 0.04]])
    around = np.concatenate([edge, edge[::-1] * [1, -1, 1]])
    winch = lathe(
        [
            (0, -0.15),
            (0.13, -0.15),
            (0.13, -0.13),
            (0.09, -0.12),
            (0.09, 0.12),
            (0.13, 0.13),
            (0.13, 0.15),
            (0, 0.15),
        ],
        materials.steel,
        20,
    )
    board = (0.55 * end, half + 0.075, z + 0.16)
    return join_meshes(
        [
            boxes(beams, (-end, 0.05, 0.09), materials.frame),
            boxes((0.5 * end, 0, z + 0.045), (-end, 2 * half + 0.12, 0.012), materials.steel),
            boxes(at, (0.12, 2 * half - 0.06, rng.uniform(0.42, 0.6)), materials.concrete),
            railing(around, 0.2, 0.22, 0.007, materials.frame),
            winch.transform(rotation((1, 0, 0), 90)).translate(0.68 * end, 0, z + 0.18),
            boxes((0.38 * end, 0, z + 0.16), (0.3, 0.2, 0.22), materials.cab),
            boxes(board, (0.75, 0.012, 0.22), materials.sign),
            boxes(board * np.array([1, -1, 1]), (0.75, 0.012, 0.22), materials.sign),
        ]
    )


def _pendants(plan: TowerCranePlan, materials: TowerCraneMaterials) -> Mesh:
    """Build ties from the tower head to both jibs or, without a head, struts to the jib's upper chord."""
    joints = _jib(plan)
    half = 0.42 * plan.side_m
    sides = np.array([[1, half, 1], [1, -half, 1]])
    if not plan.head_m:
        back = sides * [-0.55 * plan.counter_m, 1, plan.deck_m + 0.04]
        return bars(np.stack([np.broadcast_to(joints[0, 2], (2, 3)), back], 1), 0.02, materials.frame)
    apex = np.array([0, 0, plan.deck_m + plan.head_m])
    count = len(joints) - 1
    ahead = joints[[round(0.4 * count), round(0.78 * count)], 2]
    back = sides * [-0.9 * plan.counter_m, 1, plan.deck_m + 0.04]
    ties = np.stack([np.broadcast_to(apex, (4, 3)), np.concatenate([ahead, back])], 1)
    return bars(ties, 0.011, materials.steel)


def _hook(plan: TowerCranePlan, materials: TowerCraneMaterials) -> Mesh:
    """Build the trolley, ropes, hook block and hook."""
    x, z = plan.trolley_m, plan.deck_m
    low = z - plan.rope_m
    half = 0.4 * plan.side_m
    corner = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    angle = np.radians(np.linspace(90, -170, 10))
    hook = np.column_stack([0.045 * np.cos(angle), 0 * angle, 0.045 * np.sin(angle) - 0.15])
    ends = corner * [0.05, 0.03, 0]
    return join_meshes(
        [
            bars(
                chain_segments((corner[[0, 1, 2, 3, 0]] * [0.14, half, 0] + [x, 0, z - 0.05])[None]),
                0.014,
                materials.frame,
            ),
            tubes(
                corner * [0.14, half, 0] + [x, -0.012, z - 0.01],
                corner * [0.14, half, 0] + [x, 0.012, z - 0.01],
                0.03,
                materials.steel,
                10,
            ),
            boxes((x, 0, z - 0.05), (0.1, 2 * half, 0.03), materials.frame),
            tubes(ends + [x, 0, z - 0.05], ends + [x, 0, low + 0.08], 0.0055, materials.steel, 4),
            boxes((x, 0, low + 0.02), (0.16, 0.08, 0.14), materials.frame),
            tubes((x, 0, low - 0.05), (x, 0, low - 0.11), 0.012, materials.steel),
            sweep(hook, 0.013, materials.steel).translate(x, 0, low),
        ]
    )


def _load(rng: np.random.Generator, plan: TowerCranePlan, materials: TowerCraneMaterials) -> Mesh:
    """Build the load: a concrete panel or a bundle of bars in slings, or a bucket."""
    at = np.array([plan.trolley_m, 0, plan.deck_m - plan.rope_m - 0.19])
    kind = str(rng.choice(["panel", "bars", "bucket"]))
    if kind == "bucket":
        cone = lathe(
            [(0, -0.6), (0.06, -0.6), (0.06, -0.52), (0.19, -0.34), (0.19, -0.1), (0.175, -0.1), (0, -0.36)],
            materials.frame,
            24,
        )
        return join_meshes(
            [
                cone.translate(*at),
                cables(at, at + [[0.18, 0, -0.1], [-0.18, 0, -0.1]], 0.006, materials.steel, count=1),
            ]
        )
    corners = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]]) * [0.35, 0.06, 0] - [0, 0, 0.4]
    slings = cables(at, at + corners, 0.005, materials.steel, count=1)
    if kind == "panel":
        return join_meshes([slings, boxes(at - [0, 0, 0.63], (1.0, 0.1, 0.5), materials.concrete)])
    y, z = (
        values.ravel() for values in np.meshgrid(np.linspace(-0.06, 0.06, 5), np.linspace(-0.47, -0.4, 3))
    )
    ends = np.stack([0 * y, y, z], -1) + at
    return join_meshes([slings, tubes(ends - [0.75, 0, 0], ends + [0.75, 0, 0], 0.014, materials.steel, 5)])
