"""Scene `pylon`: a high-voltage line over fields, with one lattice tower close by and others far away."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.lattice import (
    Segments,
    Truss,
    aviation_paints,
    bars,
    cables,
    chain_segments,
    galvanised_steel,
    insulators,
    mast_levels,
    mast_rings,
    painted_steel,
    sagging_points,
    truss,
)
from stereoweave.synth.props.primitives import Points, boxes, copies, spheres, translation
from stereoweave.synth.props.surroundings import bushes, daylight, draw_spots, hills, houses, terrain, trees
from stereoweave.synth.stage import Palette, Stage, outdoor_stage
from stereoweave.synth.viewpoints import Orbit
from stereoweave.synth.world import Material, Mesh, join_meshes

# For each arm: height and reach as fractions of the tower's height, and number of conductors on each side.
KINDS: dict[str, tuple[tuple[float, float, int], ...]] = {
    "single level": ((0.76, 0.33, 3),),
    "danube": ((0.64, 0.30, 2), (0.80, 0.19, 1)),
    "barrel": ((0.56, 0.17, 1), (0.70, 0.23, 1), (0.84, 0.16, 1)),
    "fir tree": ((0.55, 0.24, 1), (0.70, 0.19, 1), (0.85, 0.14, 1)),
}
ARM_PANELS = 6
REACH_M = 4.4  # lines within this distance of the tower's middle belong to the target


@dataclass(frozen=True, kw_only=True)
class PylonPlan:
    """Dimensions of a tower; the line runs along y and the arms along x.

    Attributes:
        arms: One (height_m, reach_m, number of conductors per side) for each arm, lowest first.
        widths_m: Widths of the body at the ground, at the lowest arm and at the highest arm.
        span_m: Distance to the next tower.
        strained: Whether tension insulators along the line replace suspension insulators.
        bundle_m: Distance between the wires of a twin bundle; 0 for single wires.
    """

    height_m: float
    arms: tuple[tuple[float, float, int], ...]
    widths_m: tuple[float, float, float]
    depth_m: float
    string_m: float
    span_m: float
    sag_m: float
    strained: bool
    bundle_m: float
    bar_m: float


def pylon(rng: np.random.Generator) -> Stage:
    """Build a stage with a tower 6.5 to 7.5 m tall."""
    palette, plan = Palette(), _draw_plan(rng)
    tower, steel = _tower(rng, palette, plan)
    lines, wire = _lines(rng, palette, plan)
    far = _far_towers(plan, steel, wire)
    land = _land(rng, palette)
    light = daylight(rng)
    mesh = join_meshes([tower.as_target(), _mark_near(lines, plan), far, land])
    return outdoor_stage(mesh, palette, light, _orbit(rng, plan))


def _draw_plan(rng: np.random.Generator) -> PylonPlan:
    height = rng.uniform(6.5, 7.5)
    kind = KINDS[str(rng.choice(list(KINDS)))]
    slim = rng.uniform(0.85, 1.2)
    return PylonPlan(
        height_m=height,
        arms=tuple((z * height, rng.uniform(0.92, 1.08) * reach * height, n) for z, reach, n in kind),
        widths_m=(0.19 * slim * height, 0.075 * slim * height, 0.06 * slim * height),
        depth_m=0.055 * height,
        string_m=rng.uniform(0.06, 0.085) * height,
        span_m=rng.uniform(24, 36),
        sag_m=rng.uniform(0.4, 0.9),
        strained=bool(rng.random() < 0.3),
        bundle_m=float(rng.choice([0.0, 0.07])),
        bar_m=rng.uniform(0.85, 1.25),
    )


def _orbit(rng: np.random.Generator, plan: PylonPlan) -> Orbit:
    """Return viewpoints that are low or beside the line, so that no wire is right in front of the cameras."""
    beside = bool(rng.random() < 0.6)
    middle = float(rng.choice([90, 270]))
    if beside:
        start = float(rng.choice([28, -68]))
        azimuth_deg = (middle + start, middle + start + 40)
    else:
        azimuth_deg = (middle - 45, middle + 45)
    return Orbit(
        centre_m=(0.0, 0.0, 0.52 * plan.height_m),
        distance_m=(8.2, 11.8),
        azimuth_deg=azimuth_deg,
        elevation_deg=(-20, 14) if beside else (-24, -14),
        aim_m=0.7,
        floor_m=0.7,
    )


def _trusses(plan: PylonPlan) -> list[Truss]:
    """Return the trusses of the body below and above the lowest arm, and of the arms on both sides."""
    foot, waist, neck = plan.widths_m
    lowest, highest = plan.arms[0][0], plan.arms[-1][0] + plan.depth_m
    below = mast_levels((0.0, lowest), (foot, waist), 0.95)
    stations = [z for height, _, _ in plan.arms for z in (height, height + plan.depth_m)]
    widths = np.interp(stations, (lowest, highest), (waist, neck))
    above = mast_levels([*stations, plan.height_m], [*widths, 0.03], 1.1)
    arms = [truss(_arm(plan, height, reach), "zigzag") for height, reach, _ in plan.arms]
    return [
        truss(mast_rings(*below), "cross"),
        truss(mast_rings(*above), "cross"),
        *arms,
        *map(_mirror, arms),
    ]


def _arm(plan: PylonPlan, height_m: float, reach_m: float) -> Float[np.ndarray, "k 4 3"]:
    """Return an arm's rings of four joints, from body to tip; the first two of each are the lower joints."""
    low, high = (_width(plan, z) / 2 for z in (height_m, height_m + plan.depth_m))
    top = height_m + plan.depth_m
    root = np.array([[low, -low, height_m], [low, low, height_m], [high, high, top], [high, -high, top]])
    tip = np.array([[0, -0.03, 0], [0, 0.03, 0], [0, 0.03, 0.06], [0, -0.03, 0.06]]) + [reach_m, 0, height_m]
    share = np.linspace(0, 1, ARM_PANELS + 1)[:, None, None]
    return root + share * (tip - root)


def _width(plan: PylonPlan, z_m: float) -> float:
    lowest, highest = plan.arms[0][0], plan.arms[-1][0] + plan.depth_m
    return float(np.interp(z_m, (lowest, highest), plan.widths_m[1:]))


def _mirror(arm: Truss) -> Truss:
    flip = np.array([-1.0, 1.0, 1.0])
    return Truss(legs=arm.legs * flip, struts=arm.struts * flip, braces=arm.braces * flip)


def _hooks(plan: PylonPlan) -> Points:
    """Return the attachment points of the insulator strings below the arms."""
    inner = []
    for height, reach, count in plan.arms:
        low = _width(plan, height) / 2
        share = np.arange(1, count + 1) / count
        inner.append(np.column_stack([low + share * (reach - low), 0 * share, 0 * share + height]))
    right = np.concatenate(inner)
    return np.concatenate([right, right * [-1, 1, 1]])


def _tower(rng: np.random.Generator, palette: Palette, plan: PylonPlan) -> tuple[Mesh, int]:
    """Build the tower with its fittings; return its mesh and the material index of its steel."""
    steel = palette.add(_steel(rng))
    leg, brace = 0.028 * plan.bar_m, 0.013 * plan.bar_m
    trusses = _trusses(plan)
    if rng.random() < 0.3:
        bands = [palette.add(material) for material in aviation_paints(rng)]
        lattice = [part.banded_mesh(leg, brace, bands, (np.inf, plan.height_m / 7)) for part in trusses]
    else:
        lattice = [trusses[0].mesh(leg, brace, steel), trusses[1].mesh(0.8 * leg, brace, steel)]
        lattice += [arm.mesh(0.65 * leg, 0.8 * brace, steel) for arm in trusses[2:]]
    return join_meshes([*lattice, *_fittings(rng, palette, plan, trusses[0], steel)]), steel


def _steel(rng: np.random.Generator) -> Material:
    """Draw galvanised steel, or steel painted green, grey or brown."""
    tints = ((0.22, 0.3, 0.24), (0.35, 0.38, 0.38), (0.3, 0.2, 0.15))
    return galvanised_steel(rng) if rng.random() < 0.6 else painted_steel(rng, tints[int(rng.integers(3))])


def _fittings(
    rng: np.random.Generator, palette: Palette, plan: PylonPlan, body: Truss, steel: int
) -> list[Mesh]:
    """Build the footings, gusset plates, step bolts, anti-climbing guard and sign."""
    concrete = palette.add(Material(texture="concrete", variant=int(rng.integers(8)), span_m=1.0))
    yellow = palette.add(
        Material(texture="sign", variant=int(rng.integers(8)), tint=(0.9, 0.7, 0.1), span_m=0.3)
    )
    corner = plan.widths_m[0] / 2 * np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    joints = body.legs[:, 1]
    guard_m = 0.5 * _body_width(plan, 0.14 * plan.height_m) + 0.05
    fence = corner / corner[0, 0] * (guard_m + np.array([[[0.0]], [[0.05]], [[0.1]]]))
    fence[..., 2] = 0.14 * plan.height_m + np.array([[0.0], [0.03], [0.06]])
    closed = np.concatenate([fence, fence[:, :1]], axis=1)
    spikes = np.stack([fence[0] * [0.94, 0.94, 1], fence[2]], 1)
    half = _body_width(plan, 0.2 * plan.height_m) / 2
    beam = np.array([[[-half, -half, 0.2 * plan.height_m], [half, -half, 0.2 * plan.height_m]]])
    return [
        boxes(corner * 1.02 - [0, 0, 0.1], (0.26, 0.26, 0.5), concrete),
        boxes(joints, (0.065, 0.065, 0.1), steel),
        bars(_steps(plan), 0.006, steel, sides=4),
        bars(np.concatenate([chain_segments(closed), spikes]), 0.005, steel, sides=4),
        bars(beam, 0.012, steel),
        boxes(beam.mean(1) - [0, 0.02, 0], (0.24, 0.012, 0.3), yellow),
    ]


def _body_width(plan: PylonPlan, z_m: float) -> float:
    return float(np.interp(z_m, (0, plan.arms[0][0]), plan.widths_m[:2]))


def _steps(plan: PylonPlan) -> Segments:
    """Return the step bolts of the first leg, which stick out on alternating sides."""
    heights = np.arange(0.2 * plan.height_m, plan.arms[0][0], 0.075)
    half = np.interp(heights, (0, plan.arms[0][0]), plan.widths_m[:2]) / 2
    at = np.column_stack([half, half, heights])
    odd = (np.arange(len(at)) % 2)[:, None]
    return np.stack([at, at + 0.07 * np.where(odd, [1.0, 0, 0], [0, 1.0, 0])], 1)


def _lines(rng: np.random.Generator, palette: Palette, plan: PylonPlan) -> tuple[Mesh, int]:
    """Build the insulators, conductors and earth wire; return their mesh and the wires' material index."""
    tints = ((0.32, 0.16, 0.1), (0.55, 0.62, 0.6), (0.2, 0.22, 0.24))
    glass = palette.add(
        Material(texture="plain", tint=tints[int(rng.integers(3))], roughness=0.2, span_m=0.5)
    )
    wire = palette.add(galvanised_steel(rng))
    hooks = _hooks(plan)
    drop = np.array([0, 0.25, -0.15]) if plan.strained else np.array([0, 0, -1.0])
    strings = [drop * [1, way, 1] * plan.string_m / np.linalg.norm(drop) for way in (1, -1)]
    ends = [hooks + string for string in strings]
    pulled = ends if plan.strained else ends[:1]
    parts = [insulators(hooks, end, 0.032, 9, glass) for end in pulled]
    parts += [cables(hooks, end, 0.008, wire, count=1) for end in pulled]
    for way, end in zip((1, -1), ends, strict=True):
        parts.append(_wires(plan, end, way, wire))
        peak = np.array([[0.0, 0.0, plan.height_m]])
        parts.append(
            cables(peak, peak + [0, way * plan.span_m, 0], 0.006, wire, sag_m=0.6 * plan.sag_m, count=20)
        )
    if plan.strained:
        parts.append(cables(ends[0], ends[1], 0.009, wire, sag_m=0.9 * plan.string_m))
    return join_meshes(parts), wire


def _wires(plan: PylonPlan, starts_m: Points, way: int, wire: int) -> Mesh:
    """Build conductors over two spans, single or in twin bundles with spacers."""
    aside = np.array([plan.bundle_m / 2, 0, 0])
    along = np.array([0, way * plan.span_m, 0])
    parts = []
    for offset in (aside, -aside) if plan.bundle_m else (aside,):
        start = starts_m + offset
        parts.append(cables(start, start + along, 0.009, wire, sag_m=plan.sag_m, count=24))
        parts.append(cables(start + along, start + 2 * along, 0.009, wire, sag_m=plan.sag_m))
    if plan.bundle_m:
        middles = sagging_points(starts_m, starts_m + along, plan.sag_m, 16)[:, 1:-1].reshape(-1, 3)
        parts.append(bars(np.stack([middles - aside, middles + aside], 1), 0.012, wire, sides=4))
    weights = sagging_points(starts_m, starts_m + along, plan.sag_m, 80)[:, 1]
    parts.append(spheres(weights - [0, 0, 0.02], [[0.016, 0.05, 0.014]], wire, 1))
    return join_meshes(parts)


def _mark_near(lines: Mesh, plan: PylonPlan) -> Mesh:
    """Mark the lines close to the tower as part of the target."""
    away = lines.corners_m - np.array([0, 0, 0.52 * plan.height_m], np.float32)
    return replace(lines, target=(np.linalg.norm(away, axis=2) < REACH_M).all(1))


def _far_towers(plan: PylonPlan, steel: int, wire: int) -> Mesh:
    """Build simplified copies of the tower along the line."""
    hooks = _hooks(plan)
    tower = [part.mesh(0.03, 0.015, steel, sides=3) for part in _trusses(plan)]
    strings = [] if plan.strained else [cables(hooks, hooks - [0, 0, plan.string_m], 0.03, wire, count=1)]
    poses = np.stack([translation(0, along * plan.span_m) for along in (-1, 1, 2)])
    return copies(join_meshes([*tower, *strings]), poses)


def _land(rng: np.random.Generator, palette: Palette) -> Mesh:
    """Build fields or meadows with trees beside the line and hills behind them."""
    small = np.diag([0.4, 0.4, 0.4, 1.0])
    family = str(rng.choice(["grass", "grass", "grass", "soil"]))
    spots = draw_spots(rng, int(rng.integers(16, 34)), 11, 60)
    # No trees below the wires.
    spots = spots[np.abs(spots[:, 0]) > 4]
    return join_meshes(
        [
            houses(rng, palette, draw_spots(rng, 5, 26 / 0.4, 60 / 0.4)).transform(small),
            terrain(rng, palette, family, extent_m=110, level_m=0.0, bumps_m=0.5, flat_radius_m=12),
            trees(rng, palette, spots, height_m=(1.4, 3.0)),
            bushes(rng, palette, draw_spots(rng, 14, 4 / 0.4, 30 / 0.4)).transform(small),
            hills(rng, palette, distance_m=rng.uniform(80, 120)),
        ]
    )
