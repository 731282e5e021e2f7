"""Scene `wind_turbine`: a wind turbine on land or at sea, or a wind pump."""

from dataclasses import dataclass

import numpy as np

from stereoweave.synth.props.lattice import (
    bars,
    cables,
    galvanised_steel,
    ladder,
    mast_levels,
    mast_rings,
    painted_steel,
    railing,
    truss,
)
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
from stereoweave.synth.props.surroundings import (
    bushes,
    daylight,
    draw_spots,
    fence,
    hills,
    houses,
    rocks,
    sea,
    terrain,
    trees,
)
from stereoweave.synth.props.wind_pumps import wind_pump
from stereoweave.synth.props.wind_rotors import Rotor, TurbineMaterials, composite_skin, turbine_head
from stereoweave.synth.stage import Palette, Stage, outdoor_stage
from stereoweave.synth.viewpoints import Orbit
from stereoweave.synth.world import Colour, Material, Mesh, join_meshes

KINDS = {"tube": 0.45, "sea": 0.25, "lattice": 0.15, "pump": 0.15}


@dataclass(frozen=True, kw_only=True)
class TurbinePlan:
    """Dimensions of a wind turbine.

    Attributes:
        foot_m: Height of the tower's foot, which is on the ground or, at sea, on a platform.
        hub_m: Height of the tower's top.
        radii_m: Radii of the tower at its foot and top; for a lattice tower, half its widths there.
    """

    kind: str
    rotor: Rotor
    foot_m: float
    hub_m: float
    radii_m: tuple[float, float]


def wind_turbine(rng: np.random.Generator) -> Stage:
    """Build a stage with a turbine about 6.5 m high, whose rotor faces +x, or a wind pump about 5 m high."""
    kind = str(rng.choice(list(KINDS), p=list(KINDS.values())))
    return _wind_pump(rng) if kind == "pump" else _turbine(rng, kind)


def _wind_pump(rng: np.random.Generator) -> Stage:
    palette = Palette()
    pump = wind_pump(rng, palette)
    light = daylight(rng)
    mesh = join_meshes([pump.mesh.as_target(), _dry_land(rng, palette)])
    front = float(rng.choice([0, 180]))
    orbit = Orbit(
        centre_m=(0.0, 0.0, 0.5 * pump.top_m),
        distance_m=(6.0, 8.5),
        azimuth_deg=(front - 60, front + 60),
        elevation_deg=(-16, 16),
        aim_m=0.5,
        floor_m=0.5,
    )
    return outdoor_stage(mesh, palette, light, orbit)


def _turbine(rng: np.random.Generator, kind: str) -> Stage:
    palette, plan = Palette(), _draw_plan(rng, kind)
    materials = _draw_materials(rng, palette)
    parts = [turbine_head(plan.rotor, materials).translate(z=plan.hub_m)]
    if kind == "tube":
        parts += [
            _tube(rng, palette, plan, materials),
            _entrance(rng, palette, plan, materials),
            _mast(rng, plan, materials),
        ]
    elif kind == "lattice":
        parts += [_lattice(plan, materials), _mast(rng, plan, materials)]
    else:
        parts += [_tube(rng, palette, plan, materials), _foundation(rng, palette, plan, materials)]
    light = daylight(rng)
    land = (_sea if kind == "sea" else _fields)(rng, palette, plan, materials)
    mesh = join_meshes([join_meshes(parts).as_target(), land])
    top_m = plan.hub_m + plan.rotor.radius_m
    # The cameras are in front or behind, because a rotor is only a line when seen from the side.
    front = float(rng.choice([0, 180], p=[0.7, 0.3]))
    orbit = Orbit(
        centre_m=(0.0, 0.0, 0.5 * top_m),
        distance_m=(1.05 * top_m, 1.45 * top_m),
        azimuth_deg=(front - 50, front + 50),
        elevation_deg=(-17, 14),
        aim_m=0.5,
        floor_m=0.6,
    )
    return outdoor_stage(mesh, palette, light, orbit)


def _draw_plan(rng: np.random.Generator, kind: str) -> TurbinePlan:
    radius = rng.uniform(1.5, 1.9) if kind == "lattice" else rng.uniform(2.0, 2.5)
    hub = rng.uniform(4.2, 4.7) if kind == "sea" else rng.uniform(3.8, 4.4)
    rotor = Rotor(
        radius_m=radius,
        chord_m=rng.uniform(0.1, 0.125) * radius,
        pitch_deg=float(rng.choice([rng.uniform(0, 12), 85], p=[0.92, 0.08])),
        angle_deg=rng.uniform(0, 120),
    )
    wide = rng.uniform(0.17, 0.22)
    return TurbinePlan(
        kind=kind,
        rotor=rotor,
        foot_m=rng.uniform(0.9, 1.2) if kind == "sea" else 0.0,
        hub_m=hub,
        radii_m=(0.42, 0.11) if kind == "lattice" else (wide, 0.62 * wide),
    )


def _draw_materials(rng: np.random.Generator, palette: Palette) -> TurbineMaterials:
    white = palette.add(composite_skin(rng))
    red = rng.random() < 0.35
    return TurbineMaterials(
        white=white,
        tip=palette.add(painted_steel(rng, (0.55, 0.07, 0.05))) if red else white,
        steel=palette.add(galvanised_steel(rng)),
        dark=palette.add(Material(texture="plain", tint=(0.07, 0.07, 0.08), roughness=0.6)),
        lamp=palette.add(Material(texture="plain", tint=(0.5, 0.05, 0.04), roughness=0.3, glow=0.4)),
    )


def _tube(rng: np.random.Generator, palette: Palette, plan: TurbinePlan, materials: TurbineMaterials) -> Mesh:
    """Build a tapering tower with flanges, sometimes with a green foot or a red band."""
    low, high = plan.foot_m, plan.hub_m
    z = np.linspace(low, high, 21)
    radius = np.interp(z, (low, high), plan.radii_m)
    skins = [materials.white] * 20
    mark = rng.random()
    if mark < 0.3 and plan.kind == "tube":
        greens = [
            palette.add(painted_steel(rng, (0.1 + 0.15 * k, 0.26 + 0.12 * k, 0.12 + 0.15 * k)))
            for k in range(4)
        ]
        skins[:4] = greens
    elif mark < 0.6:
        skins[11:13] = [palette.add(painted_steel(rng, (0.55, 0.07, 0.05)))] * 2
    shells = [lathe([(radius[k], z[k]), (radius[k + 1], z[k + 1])], skin, 36) for k, skin in enumerate(skins)]
    at = np.linspace(low, high, 4)
    wide = np.interp(at, (low, high), plan.radii_m) + 0.006
    flanges = [
        lathe([(r, h - 0.012), (r, h + 0.012)], materials.steel, 36) for r, h in zip(wide, at, strict=True)
    ]
    return join_meshes([*shells, *flanges])


def _entrance(
    rng: np.random.Generator, palette: Palette, plan: TurbinePlan, materials: TurbineMaterials
) -> Mesh:
    """Build the foundation, the door with stairs and railings, and the transformer kiosk."""
    concrete = palette.add(Material(texture="concrete", variant=int(rng.integers(8)), span_m=1.2))
    kiosk = palette.add(painted_steel(rng, (0.25, 0.33, 0.26)))
    foot = plan.radii_m[0]
    steps = np.arange(6)
    treads = np.column_stack([foot + 0.44 - 0.06 * steps, 0 * steps, 0.05 + 0.05 * steps])
    slope = np.array([[foot + 0.47, 0.0, 0.04], [foot + 0.13, 0.0, 0.31], [foot + 0.0, 0.0, 0.31]])
    block = lathe([(0, -0.1), (foot + 0.3, -0.1), (foot + 0.26, 0.05), (0, 0.06)], concrete, 36)
    stairs = [
        boxes(treads, (0.07, 0.2, 0.012), materials.steel),
        boxes((foot + 0.07, 0, 0.31), (0.16, 0.22, 0.015), materials.steel),
        bars(
            np.array([[(foot + 0.47, y, 0.03), (foot + 0.1, y, 0.31)] for y in (0.1, -0.1)]),
            0.012,
            materials.steel,
        ),
        *[railing(slope + [0, y, 0], 0.18, 0.15, 0.006, materials.steel) for y in (0.1, -0.1)],
        boxes((foot - 0.01, 0, 0.5), (0.04, 0.16, 0.36), materials.steel),
        boxes((foot - 0.005, 0, 0.5), (0.04, 0.13, 0.33), kiosk),
        boxes((foot + 0.01, 0, 0.73), (0.12, 0.22, 0.012), materials.steel),
    ]
    box = np.array([-0.2, rng.choice([-1.0, 1.0]) * rng.uniform(0.75, 1.1), 0.0])
    return join_meshes(
        [
            block,
            join_meshes(stairs).transform(rotation((0, 0, 1), rng.uniform(-70, 70))),
            boxes(box + [0, 0, 0.2], (0.55, 0.36, 0.42), kiosk),
            boxes(box + [0, 0, 0.43], (0.62, 0.43, 0.05), concrete),
            boxes(box + [[0.277, y, 0.2] for y in (-0.08, 0.08)], (0.012, 0.13, 0.32), materials.steel),
        ]
    )


def _mast(rng: np.random.Generator, plan: TurbinePlan, materials: TurbineMaterials) -> Mesh:
    """Build a guyed lattice mast with anemometers and wind vanes on booms."""
    top = rng.uniform(0.75, 0.92) * plan.hub_m
    lattice = truss(mast_rings(*mast_levels((0.0, top), (0.11, 0.11), 1.3), corners=3)).mesh(
        0.011, 0.006, materials.steel
    )
    levels_m = top * np.array([0.55, 0.8, 0.97])
    booms = np.array([[(0.0, -0.28, z), (0.0, 0.28, z)] for z in levels_m])
    ends = booms.reshape(-1, 3)
    around = np.radians([30, 150, 270])
    feet = 1.1 * np.column_stack([np.cos(around), np.sin(around), 0 * around])
    tops = np.array([0, 0, 1.0]) * top
    guys = [cables(share * tops, feet, 0.005, materials.steel, sag_m=0.02, count=6) for share in (0.5, 0.93)]
    mesh = join_meshes(
        [
            lattice,
            bars(booms, 0.007, materials.steel),
            bars(np.stack([ends, ends + [0, 0, 0.09]], 1), 0.005, materials.steel),
            spheres(ends + [0, 0, 0.1], [[0.03, 0.03, 0.016]], materials.dark, 1),
            tubes(tops, tops + [0, 0, 0.25], 0.006, materials.steel),
            *guys,
            boxes(feet, (0.12, 0.12, 0.1), materials.dark),
            boxes((0, 0, 0.02), (0.3, 0.3, 0.1), materials.dark),
        ]
    )
    angle = rng.choice([-1, 1]) * rng.uniform(60, 110)
    return mesh.transform(rotation((0, 0, 1), angle)).translate(
        1.9 * np.cos(np.radians(angle)), 1.9 * np.sin(np.radians(angle))
    )


def _lattice(plan: TurbinePlan, materials: TurbineMaterials) -> Mesh:
    """Build the lattice tower with cross bracing, a ladder, a platform below the nacelle, and footings."""
    wide = 2 * np.array(plan.radii_m)
    joints = mast_rings(*mast_levels((0.0, plan.hub_m - 0.1), tuple(wide), 0.95))
    top = plan.hub_m - 0.45
    rim = 0.26 * np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0], [1, 1, 0]])
    return join_meshes(
        [
            truss(joints, "cross").mesh(0.024, 0.011, materials.steel),
            tubes((0, 0, plan.hub_m - 0.35), (0, 0, plan.hub_m), 0.1, materials.white, 20),
            boxes((0, 0, top), (0.52, 0.52, 0.015), materials.steel),
            railing(rim + [0, 0, top], 0.17, 0.2, 0.006, materials.steel),
            ladder((0, wide[0] / 2, 0.1), (0, wide[1] / 2 + 0.03, top), (1, 0, 0), 0.1, materials.steel),
            boxes(joints[0], (0.2, 0.2, 0.14), materials.dark),
        ]
    )


def _foundation(
    rng: np.random.Generator, palette: Palette, plan: TurbinePlan, materials: TurbineMaterials
) -> Mesh:
    """Build an offshore foundation: a monopile or lattice, a platform, a boat landing and a crane."""
    yellow = palette.add(painted_steel(rng, (0.75, 0.5, 0.04)))
    weathered = palette.add(
        Material(texture="rust", variant=int(rng.integers(8)), tint=(0.6, 0.5, 0.35), span_m=0.8)
    )
    top, foot = plan.foot_m, plan.radii_m[0]
    angle = np.linspace(0, 2 * np.pi, 17)
    rim = 0.5 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    parts = [
        lathe(
            [(0, top - 0.06), (0.52, top - 0.06), (0.52, top - 0.02), (0, top - 0.02)], materials.steel, 32
        ),
        railing(rim + [0, 0, top - 0.02], 0.2, 0.3, 0.007, yellow),
        boxes((foot, 0, top + 0.22), (0.04, 0.15, 0.36), materials.dark),
        _davit(top, yellow, materials),
    ]
    if rng.random() < 0.35:
        joints = mast_rings(*mast_levels((-0.6, top - 0.06), (1.5, 0.75), 0.7))
        parts.append(truss(joints, "cross").mesh(0.05, 0.03, yellow, sides=9))
        out = 0.62
    else:
        parts.append(lathe([(foot + 0.05, -0.8), (foot + 0.05, 0.18)], weathered, 36))
        parts.append(lathe([(foot + 0.045, 0.18), (foot + 0.045, top)], yellow, 36))
        parts.append(
            tubes([(0, foot + 0.09, -0.5)], [(0, foot + 0.09, top - 0.05)], 0.025, materials.dark, 8)
        )
        out = foot + 0.16
    fenders = np.array([[(out, y, -0.5), (out, y, top - 0.25)] for y in (-0.09, 0.09)])
    stubs = np.array([[(out, y, z), (foot, y, z)] for y in (-0.09, 0.09) for z in (0.15, top - 0.28)])
    parts += [
        bars(np.concatenate([fenders, stubs]), 0.025, yellow, sides=8),
        ladder((out - 0.03, 0, -0.3), (out - 0.03, 0, top + 0.05), (0, 1, 0), 0.09, yellow),
    ]
    return join_meshes(parts).transform(rotation((0, 0, 1), rng.uniform(-60, 60)))


def _davit(top_m: float, yellow: int, materials: TurbineMaterials) -> Mesh:
    """Build the platform's small crane."""
    mast = np.array(
        [
            [(-0.1, 0.4, top_m), (-0.1, 0.4, top_m + 0.38)],
            [(-0.1, 0.4, top_m + 0.38), (0.12, 0.72, top_m + 0.46)],
        ]
    )
    rope = cables(mast[1, 1], mast[1, 1] - [0, 0, 0.4], 0.005, materials.steel, count=1)
    return join_meshes(
        [bars(mast, 0.022, yellow, sides=8), rope, spheres(mast[1, 1] - [0, 0, 0.42], 0.025, yellow, 1)]
    )


def _far(rng: np.random.Generator, plan: TurbinePlan, materials: TurbineMaterials, base: int) -> Mesh:
    """Build simplified, distant turbines of the wind farm, facing the same way as the near one."""
    tower = lathe([(1.1 * plan.radii_m[0], -0.3), (1.1 * plan.radii_m[0], plan.foot_m + 0.1)], base, 12)
    tube = lathe([(plan.radii_m[0], plan.foot_m), (plan.radii_m[1], plan.hub_m)], materials.white, 12)
    at = draw_spots(rng, int(rng.integers(3, 7)), 16, 75)
    kinds = []
    for k in range(2):
        rotor = Rotor(
            radius_m=plan.rotor.radius_m,
            chord_m=plan.rotor.chord_m,
            pitch_deg=4,
            angle_deg=rng.uniform(0, 120),
        )
        turbine = join_meshes([tower, tube, turbine_head(rotor, materials, around=6).translate(z=plan.hub_m)])
        kinds.append(copies(turbine, np.stack([translation(x, y) for x, y, _ in at[k::2]])))
    return join_meshes(kinds)


def _sea(rng: np.random.Generator, palette: Palette, plan: TurbinePlan, materials: TurbineMaterials) -> Mesh:
    yellow = palette.add(painted_steel(rng, (0.75, 0.5, 0.04)))
    parts = [sea(rng, palette, extent_m=220), _far(rng, plan, materials, yellow)]
    if rng.random() < 0.4:
        parts.append(hills(rng, palette, distance_m=180))
    return join_meshes(parts)


def _fields(
    rng: np.random.Generator, palette: Palette, plan: TurbinePlan, materials: TurbineMaterials
) -> Mesh:
    """Build fields with a track, trees, houses, hills, and the other turbines of the wind farm."""
    family = str(rng.choice(["grass", "grass", "grass", "soil"]))
    small = np.diag([0.4, 0.4, 0.4, 1.0])
    corners = np.array([(9.0, -30, 0), (9.5, -8, 0), (-9, -10, 0), (-30, -13, 0)]) * [
        rng.choice([-1, 1]),
        1,
        1,
    ]
    return join_meshes(
        [
            terrain(rng, palette, family, extent_m=120, bumps_m=0.6, flat_radius_m=40),
            _track(rng, palette),
            trees(rng, palette, draw_spots(rng, int(rng.integers(10, 22)), 13, 70), height_m=(1.2, 3.0)),
            bushes(rng, palette, draw_spots(rng, 14, 4 / 0.4, 30 / 0.4)).transform(small),
            houses(rng, palette, draw_spots(rng, 3, 25 / 0.4, 60 / 0.4)).transform(small),
            fence(rng, palette, corners / 0.4).transform(small),
            hills(rng, palette, distance_m=rng.uniform(85, 130)),
            _far(rng, plan, materials, materials.white),
        ]
    )


def _track(rng: np.random.Generator, palette: Palette) -> Mesh:
    """Build a gravel track past the tower, and a crane pad."""
    tint: Colour = (0.9, 0.87, 0.82)
    gravel = palette.add(
        Material(texture="gravel", variant=int(rng.integers(8)), tint=tint, span_m=2.0, relief=0.6)
    )
    along = np.linspace(-42, 42, 60)
    bend = rng.uniform(-1, 1) * 0.02 * along**2 / 2 + 1.6
    across = np.array([-0.55, 0.0, 0.55])[:, None]
    path = np.stack(np.broadcast_arrays(along, bend + across, 0.015 - 0.02 * np.abs(across)), -1)
    yard = boxes((0.4, 0.3, 0.0), (3.2, 2.6, 0.02), gravel)
    return join_meshes([sheet(path, gravel), yard]).transform(rotation((0, 0, 1), rng.uniform(0, 360)))


def _dry_land(rng: np.random.Generator, palette: Palette) -> Mesh:
    """Build dry ground with scrub, stones, a few trees, a fence and hills."""
    small = np.diag([0.5, 0.5, 0.5, 1.0])
    corners = np.array([(-40, 14, 0), (-6, 11, 0), (18, 12, 0), (50, 18, 0)]) * [1, rng.choice([-1, 1]), 1]
    return join_meshes(
        [
            terrain(
                rng, palette, str(rng.choice(["soil", "grass"])), extent_m=110, bumps_m=0.8, flat_radius_m=9
            ),
            bushes(rng, palette, draw_spots(rng, 26, 3.5 / 0.5, 40 / 0.5)).transform(small),
            rocks(rng, palette, draw_spots(rng, 14, 2.5 / 0.5, 25 / 0.5)).transform(small),
            trees(rng, palette, draw_spots(rng, 12, 12, 60), height_m=(1.5, 3.5)),
            fence(rng, palette, corners / 0.5).transform(small),
            hills(rng, palette, distance_m=rng.uniform(85, 130)),
        ]
    )
