"""Scene `bridge`: a truss, arch, cable or lift bridge over a river, with traffic, lamps and banks."""

from collections.abc import Callable, Sequence

import numpy as np

from stereoweave.synth.props.bridges import (
    SCALE,
    BridgePlan,
    abutments,
    draw_bridge_plan,
    stone_arch_bridge,
    street_lamps,
)
from stereoweave.synth.props.cable_bridges import cable_stayed_bridge, suspension_bridge
from stereoweave.synth.props.primitives import boxes, rotation, sheet, translation
from stereoweave.synth.props.surroundings import (
    bushes,
    daylight,
    draw_spots,
    hills,
    houses,
    rocks,
    sea,
    trees,
)
from stereoweave.synth.props.truss_bridges import lift_bridge, truss_bridge
from stereoweave.synth.props.vehicles import fleet
from stereoweave.synth.stage import Palette, Stage, outdoor_stage
from stereoweave.synth.viewpoints import Orbit
from stereoweave.synth.world import Material, Mesh, join_meshes

KINDS: dict[str, Callable[[np.random.Generator, Palette, BridgePlan], Mesh]] = {
    "truss": truss_bridge,
    "suspension": suspension_bridge,
    "stayed": cable_stayed_bridge,
    "arches": stone_arch_bridge,
    "lift": lift_bridge,
}


def bridge(rng: np.random.Generator) -> Stage:
    """Build a stage with a bridge of one of five kinds, seen from the water or from a bank."""
    palette = Palette()
    plan = draw_bridge_plan(rng, palette)
    kind = str(rng.choice(list(KINDS)))
    parts = [KINDS[kind](rng, palette, plan), abutments(plan)]
    # No lamps or vehicles where the road may be lifted.
    parts.append(_traffic(rng, palette, plan, (0, 4) if kind == "lift" else (0, 1, 2, 3, 4)))
    if kind != "lift":
        parts.append(_street_lamps(rng, palette, plan))
    light = daylight(rng)
    around = [
        sea(rng, palette, extent_m=90.0),
        *_banks(rng, palette, plan),
        hills(rng, palette, distance_m=rng.uniform(60, 110)),
    ]
    mesh = join_meshes([join_meshes(parts).as_target(), *around])
    return outdoor_stage(mesh, palette, light, _orbit(rng, plan))


def _orbit(rng: np.random.Generator, plan: BridgePlan) -> Orbit:
    """Return viewpoints on a boat in mid-river, or higher, oblique viewpoints on a bank."""
    side_deg = 90.0 if rng.random() < 0.5 else 270.0
    centre_m = (0.0, 0.0, plan.level_m + 0.3)
    if rng.random() < 0.4:
        return Orbit(
            centre_m=centre_m,
            distance_m=(7.5, 10.0),
            azimuth_deg=(side_deg - 20, side_deg + 20),
            elevation_deg=(-6.0, 8.0),
            floor_m=0.45,
        )
    hand = 1 if rng.random() < 0.5 else -1
    first, second = sorted((side_deg + 22 * hand, side_deg + 55 * hand))
    return Orbit(
        centre_m=centre_m,
        distance_m=(7.5, 10.5),
        azimuth_deg=(first, second),
        elevation_deg=(5.0, 22.0),
        floor_m=plan.level_m + 0.55,
    )


def _street_lamps(rng: np.random.Generator, palette: Palette, plan: BridgePlan) -> Mesh:
    glass = palette.add(Material(texture="plain", tint=(0.9, 0.88, 0.8), roughness=0.3))
    return street_lamps(plan, -plan.half_m, plan.half_m, plan.rail, glass).translate(z=plan.level_m)


def _traffic(rng: np.random.Generator, palette: Palette, plan: BridgePlan, fifths: Sequence[int]) -> Mesh:
    """Build two or more vehicles in two lanes, driving on the right, in the given fifths of the road."""
    kinds = [vehicle.transform(np.diag([SCALE, SCALE, SCALE, 1.0])) for vehicle in fleet(rng, palette)]
    slots = rng.permutation([(fifth, lane) for fifth in fifths for lane in (0, 1)])
    placed = []
    for fifth, lane in slots[: int(rng.integers(2, len(slots)))].tolist():
        kind = kinds[rng.choice(len(kinds), p=[0.35, 0.35, 0.2, 0.1])]
        x = plan.half_m * ((2 * fifth + 1) / 5 - 1) + rng.uniform(-0.12, 0.12)
        pose = translation(x, (lane - 0.5) * 0.36 * plan.width_m, plan.level_m + 0.012) @ rotation(
            (0, 0, 1), 180.0 * lane
        )
        placed.append(kind.transform(pose))
    return join_meshes(placed)


def _banks(rng: np.random.Generator, palette: Palette, plan: BridgePlan) -> list[Mesh]:
    """Build ground and roads at road level on both banks, slopes to the water, vegetation and houses."""
    grass = palette.add(
        Material(
            texture=str(rng.choice(["grass", "grass", "soil"])),
            variant=int(rng.integers(64)),
            span_m=2.5,
            roughness=0.95,
            relief=0.5,
        )
    )
    slope = palette.add(
        Material(
            texture=str(rng.choice(["gravel", "stone", "soil"])),
            variant=int(rng.integers(64)),
            span_m=1.6,
            roughness=0.9,
            relief=0.7,
        )
    )
    road = boxes(
        [[side * 32.5, 0, plan.level_m - 0.04] for side in (-1, 1)],
        [[56.0, 0.75 * plan.width_m, 0.08]],
        plan.asphalt,
    )
    ground = [_bank(rng, plan, side, grass, slope) for side in (-1, 1)]
    return [*ground, road, *_growth(rng, palette, plan)]


def _bank(rng: np.random.Generator, plan: BridgePlan, side: int, grass: int, slope: int) -> Mesh:
    """Build a bank's slope from below the water to road level, and the land behind it."""
    y = 9 * np.sinh(np.linspace(-3.0, 3.0, 61))
    edge = (
        plan.half_m
        + 0.55
        + np.minimum(abs(y) / 6, 1)
        * sum(
            rng.uniform(0, 0.5) * (1 + np.sin(y / length + rng.uniform(0, 6))) for length in (2.3, 5.0, 11.0)
        )
    )
    rise = np.array([-0.6, -0.1, 0.15, 0.45, 0.75, 0.93, 1.0])[:, None]
    out = np.array([-1.1, -0.62, -0.42, -0.2, 0.05, 0.35, 0.8])[:, None]
    rough = 0.05 * rng.normal(size=(7, 61)) * (abs(y) > 0.9) * (rise < 0.99)
    bank = np.stack(
        [edge + out + rough, np.broadcast_to(y, (7, 61)), rise * (plan.level_m - 0.05) + rough], -1
    )
    back = np.concatenate([[0.0, 0.6], np.geomspace(1.5, 70, 14)])[:, None]
    x = edge + 0.8 + back
    level = np.minimum(np.minimum(abs(y) / 2.5, 1) * np.minimum(back / 3, 1), 1)
    bumps = sum(
        rng.uniform(0.05, 0.3) * np.sin(x / a + y / b + rng.uniform(0, 6))
        for a, b in ((3, 4), (6, -5), (11, 9))
    )
    land = np.stack([x, np.broadcast_to(y, x.shape), plan.level_m - 0.05 + level * bumps], -1)
    # The sheet must face up on both banks, so one of them reverses its columns.
    order = slice(None, None, -1)
    return join_meshes(
        sheet((points if side < 0 else points[:, order]) * [side, 1, 1], material)
        for points, material in ((bank, slope), (land, grass))
    )


def _growth(rng: np.random.Generator, palette: Palette, plan: BridgePlan) -> list[Mesh]:
    """Build trees, bushes, boulders and houses on the banks, at the bridge's scale and away from the road."""

    def spots(count: int, nearest_m: float, farthest_m: float) -> np.ndarray:
        around = draw_spots(rng, count, nearest_m, farthest_m)
        dry = (abs(around[:, 0]) > plan.half_m + 2.2) & (abs(around[:, 1]) > 1.3)
        return around[dry] + [0, 0, plan.level_m - 0.08]

    houses_at = spots(14, 12, 45)
    shrink = 0.22
    village = houses(rng, palette, houses_at / shrink).transform(np.diag([shrink, shrink, shrink, 1.0]))
    wood = trees(rng, palette, spots(60, 7, 50), (0.7, 2.0))
    low = bushes(rng, palette, spots(45, 5, 25) / 0.3).transform(np.diag([0.3, 0.3, 0.3, 1.0]))
    y = rng.uniform(1.0, 7.0, 16) * rng.choice([-1, 1], 16)
    shore = np.stack([rng.choice([-1, 1], 16) * (plan.half_m + rng.uniform(-0.2, 0.3, 16)), y, 0 * y], -1)
    boulders = rocks(rng, palette, shore / 0.4).transform(np.diag([0.4, 0.4, 0.4, 1.0]))
    return [village, wood, low, boulders]
