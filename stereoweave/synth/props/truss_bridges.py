"""Fixed and lifting steel truss bridges. The road runs along x."""

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.bridges import BridgePlan, beams, pier, roadway
from stereoweave.synth.props.lattice import bars, mast_rings, truss
from stereoweave.synth.props.primitives import boxes, lathe, rotation, tubes
from stereoweave.synth.stage import Palette
from stereoweave.synth.world import Material, Mesh, join_meshes

Joints = Float[np.ndarray, "_ 3"]

_TOWER_M = 0.5  # length of a tower along the road


def truss_bridge(rng: np.random.Generator, palette: Palette, plan: BridgePlan) -> Mesh:
    """Build a bridge of one or two truss spans with straight or curved upper chords."""
    count = int(rng.integers(1, 3))
    length_m = 2 * plan.half_m / count
    panels = 2 * int(rng.integers(4, 7)) if count == 1 else 2 * int(rng.integers(3, 5))
    height_m = rng.uniform(0.75, 0.95) if count == 2 else rng.uniform(0.95, 1.35)
    crown = rng.uniform(0.2, 0.45) * rng.integers(2)
    span = _span(rng, plan, length_m, panels, height_m, crown)
    starts_m = -plan.half_m + length_m * np.arange(count)
    spans = [span.translate(x=start + length_m / 2, z=plan.level_m) for start in starts_m]
    piers = [pier(plan, start, plan.level_m - 0.16) for start in starts_m[1:]]
    return join_meshes([*spans, *piers, roadway(plan, -plan.half_m, plan.half_m).translate(z=plan.level_m)])


def lift_bridge(rng: np.random.Generator, palette: Palette, plan: BridgePlan) -> Mesh:
    """Build a lift bridge: a truss span, sometimes raised, between two lattice towers.

    The towers have counterweights, ropes and sheaves.
    """
    gap_m, height_m = rng.uniform(1.5, 1.8), rng.uniform(2.3, 2.8)
    raised_m = rng.uniform(0.3, 1.1) * float(rng.random() < 0.6)
    lifted = join_meshes(
        [_span(rng, plan, 2 * gap_m - 0.06, 8, 0.55, 0.0), roadway(plan, -gap_m + 0.02, gap_m - 0.02)]
    )
    concrete = palette.add(Material(texture="concrete", variant=int(rng.integers(64)), span_m=1.0))
    glass = palette.add(Material(texture="plain", tint=(0.08, 0.1, 0.12), roughness=0.1))
    tower = _lift_tower(plan, height_m, raised_m, concrete)
    cabin = _cabin(plan, glass).translate(z=0.75 * height_m)
    middle_m, edge_m = gap_m + _TOWER_M / 2, gap_m + _TOWER_M
    approach = _span(rng, plan, plan.half_m - edge_m, 6, 0.42, 0.0).translate(x=(edge_m + plan.half_m) / 2)
    end = join_meshes([tower.translate(x=middle_m), approach, roadway(plan, gap_m + 0.02, plan.half_m)])
    other_end = join_meshes([end, cabin.translate(x=middle_m)]).transform(rotation((0, 0, 1), 180))
    piers = [pier(plan, x, plan.level_m - 0.14, thick_m=0.75) for x in (-middle_m, middle_m)]
    return join_meshes(
        [*piers, *(part.translate(z=plan.level_m) for part in (end, other_end, lifted.translate(z=raised_m)))]
    )


def _span(  # noqa: PLR0913 - dimensions
    rng: np.random.Generator, plan: BridgePlan, length_m: float, panels: int, height_m: float, crown: float
) -> Mesh:
    """Build two trusses, with bracing over the road and beams under it.

    The span is centred on x = 0, and the road is at z = 0.

    crown: curvature of the upper chords; 0 makes them straight.
    """
    x = np.linspace(-length_m / 2, length_m / 2, panels + 1)
    share = x[1:-1] / x[-1]
    high_m = height_m * (1 - crown + crown * (1 - share * share) / (1 - share[0] ** 2))
    braced = str(rng.choice(["pratt", "warren", "cross"]))
    sides = []
    for y in (-plan.side_m, plan.side_m):
        low, top = _line(x, y, np.full(len(x), -0.04)), _line(x[1:-1], y, high_m)
        sides.append(_plane(plan, low, top, braced))
    low, top = (_line(x, 0, np.full(len(x), -0.12)), _line(x[1:-1], 0, high_m))
    out = np.array([0, plan.side_m, 0])
    over = [beams(top - out, top + out, (0.035, 0.05), plan.steel)]
    if height_m > 0.5:
        crossing = [(top[:-1] - out, top[1:] + out), (top[:-1] + out, top[1:] - out)]
        over += [tubes(start, end, 0.011, plan.steel, 5) for start, end in crossing]
    else:
        over = []
    under = beams(low - out, low + out, (0.05, 0.1), plan.steel)
    return join_meshes([*sides, *over, under])


def _plane(plan: BridgePlan, low: Joints, top: Joints, braced: str) -> Mesh:
    """Build one truss: chords, end posts, verticals, diagonals and gusset plates."""
    count = len(top)
    chords = beams(
        np.concatenate([low[:-1], top[:-1]]), np.concatenate([low[1:], top[1:]]), (0.07, 0.085), plan.steel
    )
    posts = beams(low[[0, -1]], top[[0, -1]], (0.07, 0.085), plan.steel)
    uprights = beams(low[1:-1], top, (0.05, 0.04), plan.steel)
    half = count // 2
    rising = np.array([(k + 2, k) for k in range(half)] + [(k, k) for k in range(half + 1, count)])
    falling = np.array(
        [(k + 1, k + 1) for k in range(half)] + [(k + 1, k - 1) for k in range(half + 1, count)]
    )
    pairs = {
        "pratt": rising,
        "warren": np.array([(k + 2, k) if k % 2 == 0 else (k + 1, k + 1) for k in range(count - 1)]),
        "cross": np.concatenate([rising, falling]),
    }[braced]
    diagonals = beams(low[pairs[:, 0]], top[pairs[:, 1]], (0.035, 0.045), plan.steel)
    plates = boxes(np.concatenate([low, top]), [[0.16, 0.078, 0.13]], plan.steel)
    return join_meshes([chords, posts, uprights, diagonals, plates])


def _lift_tower(plan: BridgePlan, height_m: float, raised_m: float, concrete: int) -> Mesh:
    """Build a tower that the road passes through, on the +x side of the lift span.

    The higher the span is raised, the lower the counterweight hangs.
    """
    z = np.linspace(-0.12, height_m, 9)
    frame = truss(mast_rings(z, _TOWER_M, 4) * [1, 2 * plan.side_m / _TOWER_M, 1], "cross")
    others = np.concatenate([frame.struts, frame.braces])
    # The two faces that the road passes through stay open.
    along_road, overhead = abs(np.diff(others[..., 1], axis=1))[:, 0] < 1e-6, others[..., 2].min(1) > 0.5
    steel = [
        beams(frame.legs[:, 0], frame.legs[:, 1], (0.07, 0.07), plan.steel),
        bars(others[along_road | overhead], 0.014, plan.steel),
        boxes([[0, 0, height_m + 0.04]], [[_TOWER_M + 0.2, 2 * plan.side_m + 0.24, 0.08]], plan.steel),
    ]
    weight_m = 0.45 * height_m - raised_m + 0.55
    weight = boxes([[0.0, 0, weight_m]], [[0.3, 1.5 * plan.side_m, 0.5]], concrete)
    return join_meshes([*steel, weight, _hoist(plan, height_m, raised_m, weight_m)])


def _hoist(plan: BridgePlan, height_m: float, raised_m: float, weight_m: float) -> Mesh:
    """Build two sheaves on top of a tower, with ropes from the span to the counterweight."""
    groove = [(0.03, -0.03), (0.24, -0.03), (0.22, 0), (0.24, 0.03), (0.03, 0.03)]
    wheel = lathe(groove, plan.steel, 28).transform(rotation((1, 0, 0), 90))
    y, top_m = np.array([-0.6, 0.6]) * plan.side_m, height_m + 0.3
    sides = [[0, at + d, height_m + 0.19] for at in y for d in (-0.06, 0.06)]
    strands = np.concatenate([y - 0.02, y, y + 0.02])
    front, back = (np.column_stack([0 * strands + x, strands, 0 * strands + top_m]) for x in (-0.23, 0.23))
    ropes = [
        tubes(front, front * [1, 1, 0] + [-0.04, 0, 0.55 + raised_m], 0.006, plan.rail, 4),
        tubes(back, back * [0.5, 1, 0] + [0, 0, weight_m + 0.25], 0.006, plan.rail, 4),
    ]
    return join_meshes(
        [*(wheel.translate(y=at, z=top_m) for at in y), boxes(sides, [[0.12, 0.03, 0.3]], plan.steel), *ropes]
    )


def _cabin(plan: BridgePlan, glass: int) -> Mesh:
    """Build the operator's cabin at the side of a tower."""
    at_y = -plan.side_m - 0.2
    return join_meshes(
        [
            boxes([[0, at_y, 0]], [[0.4, 0.34, 0.3]], plan.dressed),
            boxes([[0, at_y, 0.05]], [[0.41, 0.35, 0.12]], glass),
            boxes([[0, at_y, 0.17]], [[0.48, 0.42, 0.04]], plan.steel),
            boxes([[0, at_y + 0.02, -0.17]], [[0.4, 0.44, 0.04]], plan.steel),
        ]
    )


def _line(x: np.ndarray, y: float, z: np.ndarray) -> Joints:
    return np.stack([x, np.full(len(x), float(y)), z], -1)
