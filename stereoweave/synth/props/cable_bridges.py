"""Suspension bridges and cable-stayed bridges. The road runs along x."""

import numpy as np

from stereoweave.synth.props.bridges import BridgePlan, beams, pier, roadway
from stereoweave.synth.props.primitives import boxes, loft, sweep, tubes
from stereoweave.synth.stage import Palette
from stereoweave.synth.world import Mesh, join_meshes


def suspension_bridge(rng: np.random.Generator, palette: Palette, plan: BridgePlan) -> Mesh:
    """Build a suspension bridge with two towers, cables to both banks, hangers and a stiffening girder."""
    tower_m, top_m = rng.uniform(2.2, 2.6), plan.level_m + rng.uniform(1.35, 1.9)
    low_m, anchor_m = plan.level_m + 0.14, plan.half_m + 0.5
    masonry_towers = rng.random() < 0.35
    material, thick_m = (plan.masonry, 0.24) if masonry_towers else (plan.steel, 0.13)
    parts = [_girder(plan), roadway(plan, -plan.half_m, plan.half_m).translate(z=plan.level_m)]
    for at in (-tower_m, tower_m):
        portal = _portal(plan, top_m, thick_m, material, crossings=int(rng.integers(2, 4)))
        parts += [portal.translate(x=at), pier(plan, at, 0.45, thick_m=0.6, wide_m=0.5)]
    for y in (-plan.side_m - 0.02, plan.side_m + 0.02):
        x = np.linspace(-tower_m, tower_m, 49)
        main_m = np.stack([x, np.full(49, y), low_m + (top_m + 0.03 - low_m) * (x / tower_m) ** 2], -1)
        outer = np.linspace(tower_m, anchor_m, 15)
        share = (outer - tower_m) / (anchor_m - tower_m)
        side_z = top_m + 0.03 + (plan.level_m - top_m) * share - 0.25 * share * (1 - share)
        side_m = np.stack([outer, np.full(15, y), side_z], -1)
        cable = np.concatenate([side_m[:0:-1] * [-1, 1, 1], main_m, side_m[1:]])
        parts += [sweep(cable, 0.022, plan.steel, 8), _hangers(plan, cable)]
    return join_meshes([*parts, _anchors(plan, anchor_m)])


def cable_stayed_bridge(rng: np.random.Generator, palette: Palette, plan: BridgePlan) -> Mesh:
    """Build a cable-stayed bridge with one or two towers and straight stays to the edges of the road."""
    single = rng.random() < 0.5
    towers_m = [rng.uniform(-0.4, 0.4)] if single else [-0.5 * plan.half_m, 0.5 * plan.half_m]
    top_m = plan.level_m + (rng.uniform(2.4, 3.0) if single else rng.uniform(1.5, 1.9))
    reach_m = plan.half_m - abs(towers_m[0]) - 0.15 if single else 0.48 * plan.half_m
    leaning, harp = bool(rng.random() < 0.5), bool(rng.random() < 0.4)
    count = 11 if single else 8
    slab = boxes([[0, 0, plan.level_m - 0.13]], [[2 * plan.half_m, 0.7 * plan.width_m, 0.14]], plan.dressed)
    parts = [slab, roadway(plan, -plan.half_m, plan.half_m).translate(z=plan.level_m)]
    cable = plan.rail if rng.random() < 0.5 else plan.steel
    for at in towers_m:
        head = (
            _inverted_y_tower(plan, top_m)
            if leaning
            else _portal(plan, top_m, 0.17, plan.dressed, crossings=2)
        )
        parts += [head.translate(x=at), pier(plan, at, 0.35, thick_m=0.7, wide_m=0.6)]
        steps = (np.arange(count) + 1) / count
        for side in (-1, 1):
            for y in (-plan.width_m / 2, plan.width_m / 2):
                feet = np.stack(
                    [at + side * reach_m * steps, np.full(count, y), np.full(count, plan.level_m + 0.02)], -1
                )
                spread = 0.75 if harp else 0.35
                z = top_m - 0.06 - spread * (top_m - plan.level_m) * (1 - steps)
                inset = _inset(plan, z, top_m) if leaning else plan.side_m + 0.04
                heads = np.stack([np.full(count, at), np.sign(y) * inset * np.ones(count), z], -1)
                parts.append(tubes(feet, heads, 0.010, cable, 6))
    return join_meshes(parts)


def _girder(plan: BridgePlan) -> Mesh:
    """Build a shallow truss under each edge of the road, with cross beams between the two."""
    x = np.linspace(-plan.half_m, plan.half_m, 45)
    parts = []
    for y in (-plan.side_m, plan.side_m):
        top, low = (np.stack([x, np.full(45, y), np.full(45, plan.level_m + z)], -1) for z in (-0.02, -0.22))
        chords = beams([top[0], low[0]], [top[-1], low[-1]], (0.04, 0.04), plan.steel)
        zigzag = np.where((np.arange(45) % 2 == 0)[:, None], top, low)
        parts += [chords, tubes(zigzag[:-1], zigzag[1:], 0.012, plan.steel, 5)]
    across = np.stack([x, np.full(45, plan.side_m), np.full(45, plan.level_m - 0.2)], -1)
    return join_meshes([*parts, beams(across * [1, -1, 1], across, (0.025, 0.04), plan.steel)])


def _hangers(plan: BridgePlan, cable: np.ndarray) -> Mesh:
    """Build hangers from the cable to the girder, evenly spaced along the road."""
    x = np.arange(-plan.half_m + 0.12, plan.half_m - 0.1, 0.15)
    tops = np.stack([x, np.full(len(x), cable[0, 1]), np.interp(x, cable[:, 0], cable[:, 2])], -1)
    feet = tops * [1, 1, 0] + [0, 0, plan.level_m - 0.02]
    far = tops[:, 2] - feet[:, 2] > 0.08
    return tubes(feet[far], tops[far], 0.007, plan.steel, 5)


def _anchors(plan: BridgePlan, at_m: float) -> Mesh:
    size_m = [0.8, 0.3, 0.5]
    places = [
        [x, y, plan.level_m - 0.1] for x in (-at_m, at_m) for y in (-plan.side_m - 0.04, plan.side_m + 0.04)
    ]
    return boxes(places, [size_m], plan.dressed)


def _portal(plan: BridgePlan, top_m: float, thick_m: float, material: int, crossings: int) -> Mesh:
    """Build two tapering legs beside the road, one cross beam below it and `crossings` beams above it."""
    y = plan.side_m + 0.04 + thick_m / 2
    legs = [_leg((0, side * (y + 0.06), 0.2), (0, side * y, top_m), thick_m, material) for side in (-1, 1)]
    heights = [plan.level_m - 0.22, *np.linspace(top_m - 0.1, plan.level_m + 0.85, crossings)]
    bars = boxes([[0, 0, z] for z in heights], [[0.7 * thick_m, 2 * y, 0.13]], material)
    caps = boxes([[0, side * y, top_m] for side in (-1, 1)], [[1.5 * thick_m, 1.5 * thick_m, 0.07]], material)
    return join_meshes([*legs, bars, caps])


def _inverted_y_tower(plan: BridgePlan, top_m: float) -> Mesh:
    """Build a tower shaped like an inverted Y: two legs that meet in a mast above the road."""
    fork_m = _fork_m(plan, top_m)
    foot_y = plan.side_m + 0.3
    legs = [_leg((0, side * foot_y, 0.2), (0, side * 0.05, fork_m), 0.17, plan.dressed) for side in (-1, 1)]
    mast = _leg((0, 0, fork_m - 0.12), (0, 0, top_m + 0.08), 0.2, plan.dressed)
    share = (plan.level_m - 0.42) / (fork_m - 0.2)
    below = boxes([[0, 0, plan.level_m - 0.22]], [[0.14, 2 * foot_y * (1 - share) + 0.1, 0.14]], plan.dressed)
    return join_meshes([*legs, mast, below])


def _fork_m(plan: BridgePlan, top_m: float) -> float:
    return plan.level_m + 0.62 * (top_m - plan.level_m)


def _inset(plan: BridgePlan, z: np.ndarray, top_m: float) -> np.ndarray:
    """Return the distances from the axis at which cables meet an inverted-Y tower at the heights z."""
    fork_m = _fork_m(plan, top_m)
    return 0.05 + np.clip((fork_m - z) / (fork_m - 0.2), 0, 1) * (plan.side_m + 0.25)


def _leg(
    foot_m: tuple[float, float, float], head_m: tuple[float, float, float], thick_m: float, material: int
) -> Mesh:
    """Build a tapering shaft with chamfered corners."""
    square = (
        np.array([(1, 0.7), (0.7, 1), (-0.7, 1), (-1, 0.7), (-1, -0.7), (-0.7, -1), (0.7, -1), (1, -0.7)]) / 2
    )
    rings = [
        np.column_stack([square * size, np.zeros(8)]) + at
        for size, at in ((1.35 * thick_m, foot_m), (thick_m, head_m))
    ]
    return loft(np.stack(rings), material)
