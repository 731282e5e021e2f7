"""Scene `antenna`: a radio mast with panel and drum antennas, roof antennas, or a large dish."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.antennas import dipoles, drum, panel, whip, yagi
from stereoweave.synth.props.lattice import (
    Bracing,
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
    sagging_points,
    truss,
)
from stereoweave.synth.props.primitives import boxes, rotation, translation, tubes
from stereoweave.synth.props.surroundings import (
    bushes,
    daylight,
    draw_spots,
    hills,
    houses,
    rocks,
    terrain,
    trees,
)
from stereoweave.synth.scenes.radio_dish import radio_dish
from stereoweave.synth.scenes.roof_antennas import roof_antennas
from stereoweave.synth.stage import Palette, Stage, outdoor_stage
from stereoweave.synth.viewpoints import Orbit
from stereoweave.synth.world import Material, Mesh, join_meshes


@dataclass(frozen=True, kw_only=True)
class MastPlan:
    """Dimensions of a mast.

    Attributes:
        corners: Number of legs, 3 or 4.
        widths_m: Side lengths at the foot and at the top.
        guyed: Whether the mast is slim and held by guy wires; otherwise it is free-standing.
        banded: Whether the mast is painted in red and white bands.
    """

    height_m: float
    corners: int
    widths_m: tuple[float, float]
    guyed: bool
    banded: bool


@dataclass(frozen=True, kw_only=True)
class MastMaterials:
    """Materials of a mast and its antennas."""

    steel: int
    bands: tuple[int, ...]
    cover: int
    radome: int
    cable: int


def antenna(rng: np.random.Generator) -> Stage:
    """Build a stage with a mast about 6 m tall, roof antennas up to 3.3 m tall, or a 4 m dish."""
    kind = str(rng.choice(["mast", "roof", "dish"], p=[0.5, 0.25, 0.25]))
    return {"mast": _mast_site, "roof": roof_antennas, "dish": radio_dish}[kind](rng)


def _mast_site(rng: np.random.Generator) -> Stage:
    palette, plan = Palette(), _draw_plan(rng)
    materials = _draw_materials(rng, palette, plan)
    mast = join_meshes(
        [
            _mast(rng, plan, materials),
            _sectors(rng, plan, materials),
            _links(rng, plan, materials),
            _top(rng, plan, materials),
        ]
    )
    site = _site(rng, palette, materials)
    light = daylight(rng)
    mesh = join_meshes([mast.as_target(), site, _land(rng, palette)])
    orbit = Orbit(
        centre_m=(0.0, 0.0, 0.57 * plan.height_m),
        distance_m=(8.2, 11.4),
        elevation_deg=(-18, 20),
        aim_m=0.5,
        floor_m=0.6,
    )
    return outdoor_stage(mesh, palette, light, orbit)


def _draw_plan(rng: np.random.Generator) -> MastPlan:
    guyed = bool(rng.random() < 0.45)
    top = rng.uniform(0.2, 0.28)
    return MastPlan(
        height_m=rng.uniform(5.8, 6.5),
        corners=3 if guyed else int(rng.choice([3, 4])),
        widths_m=(top, top) if guyed else (rng.uniform(0.9, 1.2), top + 0.04),
        guyed=guyed,
        banded=bool(rng.random() < 0.5),
    )


def _draw_materials(rng: np.random.Generator, palette: Palette, plan: MastPlan) -> MastMaterials:
    steel = palette.add(galvanised_steel(rng))
    bands = tuple(palette.add(material) for material in aviation_paints(rng)) if plan.banded else (steel,)
    grey = rng.uniform(0.6, 0.85)
    return MastMaterials(
        steel=steel,
        bands=bands,
        cover=palette.add(Material(texture="plain", tint=(grey, grey, grey * 0.97), roughness=0.5)),
        radome=palette.add(Material(texture="plain", tint=(0.78, 0.78, 0.75), roughness=0.6)),
        cable=palette.add(Material(texture="plain", tint=(0.05, 0.05, 0.055), roughness=0.6)),
    )


def _width(plan: MastPlan, z_m: float) -> float:
    return float(np.interp(z_m, (0, plan.height_m), plan.widths_m))


def _mast(rng: np.random.Generator, plan: MastPlan, materials: MastMaterials) -> Mesh:
    """Build the lattice mast with a ladder, cables, and landings or guy wires."""
    joints = mast_rings(*mast_levels((0.0, plan.height_m), plan.widths_m, 1.0), corners=plan.corners)
    thick = 1.0 if plan.guyed else 1.35
    bracing: Bracing = "zigzag" if plan.guyed or rng.random() < 0.5 else "cross"
    lattice = truss(joints, bracing).banded_mesh(
        0.017 * thick, 0.009 * thick, materials.bands, (np.inf, plan.height_m / 7)
    )
    # The ladder is inside the mast, near the middle of its first face.
    foot, head = (joints[k, :2].mean(0) * [0.8, 0.8, 1] for k in (0, -1))
    sideways = joints[0, 1] - joints[0, 0]
    trunk = foot * [0.4, 0.4, 1] + np.linspace(-0.05, 0.05, 6)[:, None] * sideways / np.linalg.norm(sideways)
    rises = np.stack([trunk, trunk - foot * [0.4, 0.4, 1] + head * [0.4, 0.4, 0.9]], 1)
    parts = [
        lattice,
        ladder(tuple(foot), tuple(head), tuple(sideways), 0.11, materials.steel),
        bars(rises, 0.008, materials.cable, sides=4),
        boxes(joints[0] + [0, 0, 0.02], (0.26, 0.26, 0.16), materials.radome),
        *[
            _landing(plan, z, materials)
            for z in (() if plan.guyed else (0.42 * plan.height_m, 0.66 * plan.height_m))
        ],
    ]
    if plan.guyed:
        parts.append(_guys(plan, materials))
    return join_meshes(parts)


def _landing(plan: MastPlan, z_m: float, materials: MastMaterials) -> Mesh:
    half = 0.5 * _width(plan, z_m) + 0.14
    rim = half * np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0], [1, 1, 0]])
    return join_meshes(
        [
            boxes((0, 0, z_m), (2 * half, 2 * half, 0.012), materials.steel),
            railing(rim + [0, 0, z_m], 0.2, 0.2, 0.006, materials.steel),
        ]
    )


def _guys(plan: MastPlan, materials: MastMaterials) -> Mesh:
    """Build guy wires from three heights to three anchors, with tensioners near the ground."""
    angle = np.radians([60, 180, 300])
    around = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    radius = plan.widths_m[0] / np.sqrt(3)
    feet = 2.5 * around + [0, 0, 0.12]
    tops = [radius * around + [0, 0, share * plan.height_m] for share in (0.4, 0.68, 0.94)]
    wires = [cables(top, feet, 0.006, materials.steel, sag_m=0.03, count=8) for top in tops]
    strainers = [
        tubes(feet + 0.04 * (top - feet), feet + 0.09 * (top - feet), 0.014, materials.steel) for top in tops
    ]
    return join_meshes([*wires, *strainers, boxes(feet - [0, 0, 0.09], (0.24, 0.24, 0.2), materials.radome)])


def _sectors(rng: np.random.Generator, plan: MastPlan, materials: MastMaterials) -> Mesh:
    """Build one or two rings of sector antennas around the mast."""
    heights = [0.93] if rng.random() < 0.5 else [0.93, 0.78]
    turned = rng.uniform(0, 120)
    crowns = []
    for share in heights:
        size, high = rng.uniform(0.5, 0.75), rng.uniform(0.5, 0.75)
        crowns.append(
            _crown(plan, share * plan.height_m, size, high, materials).transform(rotation((0, 0, 1), turned))
        )
    return join_meshes(crowns)


def _crown(plan: MastPlan, z_m: float, side_m: float, panel_m: float, materials: MastMaterials) -> Mesh:
    """Build a ring of three frames with two panel antennas each."""
    out = 0.42 * side_m + 0.5 * _width(plan, z_m)
    half = side_m / 2
    rails = np.array([[(out, -half, z), (out, half, z)] for z in (-0.2, 0.2)])
    poles = np.array([[(out, y, -0.42), (out, y, 0.42)] for y in (-half, half)])
    arms = np.array([[(0.02, 0, z), (out, y, z)] for z in (-0.2, 0.2) for y in (-0.6 * half, 0.6 * half)])
    antennas = [
        panel(panel_m, materials.cover, materials.steel).translate(out + 0.1, y) for y in (-half, half)
    ]
    frame = join_meshes([bars(np.concatenate([rails, poles, arms]), 0.014, materials.steel), *antennas])
    return join_meshes([frame.transform(rotation((0, 0, 1), angle)) for angle in (0, 120, 240)]).translate(
        z=z_m
    )


def _links(rng: np.random.Generator, plan: MastPlan, materials: MastMaterials) -> Mesh:
    """Build drum, Yagi and dipole antennas on the sides of the mast."""
    parts = []
    for share in rng.uniform(0.35, 0.68, int(rng.integers(2, 5))):
        radius = rng.uniform(0.14, 0.32)
        parts.append(_on_arm(rng, plan, share, drum(radius, materials.radome, materials.steel), materials))
    for share in rng.uniform(0.3, 0.7, int(rng.integers(1, 3))):
        antenna = yagi(rng.uniform(0.6, 0.9), 9, materials.steel, materials.cable)
        parts.append(_on_arm(rng, plan, share, antenna.translate(0.15), materials))
    parts.append(
        _on_arm(rng, plan, rng.uniform(0.45, 0.62), dipoles(3, materials.steel).translate(0.1), materials)
    )
    return join_meshes(parts)


def _on_arm(
    rng: np.random.Generator, plan: MastPlan, share: float, mesh: Mesh, materials: MastMaterials
) -> Mesh:
    """Mount a mesh on an arm at a fraction of the mast's height, in a random direction."""
    z = share * plan.height_m
    out = 0.55 * _width(plan, z) + 0.16
    arm = bars(
        np.array([[(0, 0, 0), (out, 0, 0)], [(out - 0.02, 0, -0.18), (out - 0.02, 0, 0.18)]]),
        0.02,
        materials.steel,
    )
    placed = join_meshes([mesh.translate(out), arm])
    return placed.transform(translation(z=z) @ rotation((0, 0, 1), rng.uniform(0, 360)))


def _top(rng: np.random.Generator, plan: MastPlan, materials: MastMaterials) -> Mesh:
    """Build the whip antennas and the lamp on top of the mast."""
    z = plan.height_m
    around = 0.5 * plan.widths_m[1] * np.array([(1, 1), (-1, 1), (0, -1.2)])
    rods = [
        whip(rng.uniform(0.4, 1.0), materials.cover, materials.steel).translate(x, y, z) for x, y in around
    ]
    plate = boxes((0, 0, z), (plan.widths_m[1] * 1.3, plan.widths_m[1] * 1.3, 0.015), materials.steel)
    return join_meshes([*rods, plate, tubes((0, 0, z), (0, 0, z + 0.2), 0.05, materials.bands[0], 12)])


def _site(rng: np.random.Generator, palette: Palette, materials: MastMaterials) -> Mesh:
    """Build the equipment cabin, the cable bridge to it, and the fence."""
    wall = palette.add(
        painted_steel(rng, ((0.45, 0.5, 0.44), (0.7, 0.68, 0.62))[int(rng.integers(2))], roughness=0.8)
    )
    gravel = palette.add(Material(texture="gravel", variant=int(rng.integers(8)), span_m=1.5, relief=0.6))
    away = 1.15
    posts = np.array([[(x, 0.0, 0), (x, 0.0, 0.72)] for x in (0.35, 0.75)])
    wires = sagging_points(
        [(0.05, y, 0.75) for y in (-0.03, 0, 0.03)], [(away, y, 0.72) for y in (-0.03, 0, 0.03)], 0.02, 6
    )
    rim = 2.0 * np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0], [1, 1, 0]]) + [0.4, 0.2, 0]
    cabin = [
        boxes((away + 0.45, 0, 0.42), (0.9, 0.8, 0.76), wall),
        boxes((away + 0.45, 0, 0.83), (1.02, 0.92, 0.06), materials.radome),
        boxes((away + 0.45, 0, 0.02), (1.1, 1.0, 0.1), materials.radome),
        boxes((away + 0.3, 0.41, 0.36), (0.28, 0.03, 0.58), materials.steel),
        boxes((away + 0.72, 0.45, 0.5), (0.22, 0.12, 0.22), materials.radome),
        boxes((away + 0.72, 0.51, 0.5), (0.16, 0.01, 0.16), materials.cable),
    ]
    mesh = join_meshes(
        [
            *cabin,
            ladder((0.1, 0, 0.7), (away, 0, 0.7), (0, 1, 0), 0.14, materials.steel),
            bars(posts, 0.016, materials.steel),
            bars(chain_segments(wires), 0.009, materials.cable, sides=4),
            railing(rim, 0.62, 0.5, 0.011, materials.steel, rails=7),
            boxes((0.4, 0.2, 0), (3.96, 3.96, 0.03), gravel),
        ]
    )
    return mesh.transform(rotation((0, 0, 1), float(rng.choice([0, 90, 180, 270])) + rng.uniform(-20, 20)))


def _land(rng: np.random.Generator, palette: Palette) -> Mesh:
    """Build a hilltop or the edge of a village."""
    small: Float[np.ndarray, "4 4"] = np.diag([0.4, 0.4, 0.4, 1.0])
    village = draw_spots(rng, int(rng.integers(0, 9)), 16 / 0.4, 50 / 0.4)
    parts = [
        terrain(
            rng,
            palette,
            str(rng.choice(["grass", "grass", "grass", "soil"])),
            extent_m=110,
            bumps_m=0.6,
            flat_radius_m=11,
        ),
        trees(rng, palette, draw_spots(rng, int(rng.integers(12, 30)), 11, 60), height_m=(1.8, 4.0)),
        bushes(rng, palette, draw_spots(rng, 14, 4 / 0.4, 30 / 0.4)).transform(small),
        hills(rng, palette, distance_m=rng.uniform(80, 120)),
    ]
    if len(village):
        parts.append(houses(rng, palette, village).transform(small))
    else:
        parts.append(rocks(rng, palette, draw_spots(rng, 14, 3.5, 20)))
    return join_meshes(parts)
