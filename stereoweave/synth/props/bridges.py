"""Stone arch bridges, and the parts common to all bridges: roads, piers, railings and lamps.

The road runs along x.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.lattice import galvanised_steel, painted_steel, railing
from stereoweave.synth.props.primitives import (
    Numbers,
    boxes,
    copies,
    orthogonal_frames,
    prism,
    rotation,
    sheet,
    sweep,
    translation,
)
from stereoweave.synth.stage import Palette
from stereoweave.synth.world import Colour, Material, Mesh, join_meshes

# Size relative to real bridges.
SCALE = 0.1
_STEEL_PAINTS: tuple[Colour, ...] = (
    (0.2, 0.28, 0.24),
    (0.36, 0.12, 0.08),
    (0.42, 0.44, 0.45),
    (0.2, 0.27, 0.36),
    (0.6, 0.59, 0.54),
    (0.16, 0.17, 0.18),
)


@dataclass(frozen=True, kw_only=True)
class BridgePlan:
    """Dimensions and materials common to all parts of a bridge.

    Attributes:
        level_m: height of the road above the water.
        half_m: half the length of the road between the banks.
        width_m: width of the road.
        steel, masonry, dressed, asphalt, rail: materials; `dressed` is used for edge stones.
    """

    level_m: float
    half_m: float
    width_m: float
    steel: int
    masonry: int
    dressed: int
    asphalt: int
    rail: int

    @property
    def side_m(self) -> float:
        """Distance from the axis to the girders beside the road."""
        return self.width_m / 2 + 0.05


def draw_bridge_plan(rng: np.random.Generator, palette: Palette) -> BridgePlan:
    """Draw a random bridge plan and add its materials to the palette."""
    paint = _STEEL_PAINTS[rng.integers(len(_STEEL_PAINTS))]
    masonry = Material(
        texture=str(rng.choice(["stone", "brick", "concrete"], p=[0.5, 0.15, 0.35])),
        variant=int(rng.integers(64)),
        tint=tuple(rng.uniform(0.85, 1.1) * np.array([1.0, 0.98, 0.94])),
        span_m=rng.uniform(0.9, 1.4),
        roughness=0.9,
        relief=0.6,
    )
    dressed = Material(
        texture="concrete",
        variant=int(rng.integers(64)),
        tint=tuple(rng.uniform(0.8, 1.15) * np.array([1.0, 0.97, 0.92])),
        span_m=1.2,
        roughness=0.9,
    )
    rusty = Material(texture="rust", variant=int(rng.integers(64)), span_m=0.9, relief=0.4)
    asphalt = Material(texture="asphalt", variant=int(rng.integers(64)), span_m=0.8, roughness=0.9)
    return BridgePlan(
        level_m=rng.uniform(1.15, 1.6),
        half_m=rng.uniform(4.0, 4.4),
        width_m=rng.uniform(0.85, 1.1),
        steel=palette.add(rusty if rng.random() < 0.15 else painted_steel(rng, paint)),
        masonry=palette.add(masonry),
        dressed=palette.add(dressed),
        asphalt=palette.add(asphalt),
        rail=palette.add(galvanised_steel(rng)),
    )


def beams(starts_m: Numbers, ends_m: Numbers, size_m: tuple[float, float], material: int) -> Mesh:
    """Build rectangular bars [N] between pairs of points.

    size_m: width and height of the cross-section of a horizontal bar.
    """
    starts, ends = np.broadcast_arrays(np.atleast_2d(starts_m), np.atleast_2d(ends_m))
    along = ends - starts
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = along / length
    turns = np.stack([along, *orthogonal_frames(along)], -1)
    sizes = np.concatenate([length, np.broadcast_to(size_m, (len(along), 2))], 1)
    return boxes((starts + ends) / 2, sizes, material, turns)


def roadway(plan: BridgePlan, start_m: float, end_m: float, *, deep_m: float = 0.1) -> Mesh:
    """Build the slab, asphalt, kerbs and railings from x = start_m to x = end_m, with the road at z = 0."""
    middle_m, length_m = (start_m + end_m) / 2, end_m - start_m
    slab = boxes([[middle_m, 0, -deep_m / 2 - 0.01]], [[length_m, plan.width_m, deep_m]], plan.masonry)
    asphalt = boxes([[middle_m, 0, -0.005]], [[length_m, 0.74 * plan.width_m, 0.03]], plan.asphalt)
    kerbs_y = np.array([-0.435, 0.435]) * plan.width_m
    kerbs = boxes(
        [[middle_m, y, 0.0] for y in kerbs_y], [[length_m, 0.13 * plan.width_m, 0.05]], plan.masonry
    )
    rails = [
        railing(np.array([[start_m, y, 0.025], [end_m, y, 0.025]]), 0.11, 0.16, 0.006, plan.rail, rails=3)
        for y in (-0.49 * plan.width_m, 0.49 * plan.width_m)
    ]
    return join_meshes([slab, asphalt, kerbs, *rails])


def street_lamps(plan: BridgePlan, start_m: float, end_m: float, material: int, glass: int) -> Mesh:
    """Build street lamps on both sides of a road at z = 0, with arms over the road."""
    angle = np.linspace(0, np.pi / 2, 6)
    bow = np.stack([0 * angle, 0.12 - 0.12 * np.cos(angle), 0.6 + 0.12 * np.sin(angle)], -1)
    mast = sweep(np.concatenate([[[0, 0, 0.02]], bow, [[0, 0.2, 0.72]]]), 0.011, material, 6)
    head = boxes([[0, 0.2, 0.725], [0, 0.2, 0.712]], [[0.035, 0.1, 0.02], [0.025, 0.08, 0.01]], material)
    lens = boxes([[0, 0.2, 0.706]], [[0.022, 0.07, 0.006]], glass)
    lamp = join_meshes([mast, head, lens])
    x = np.arange(start_m + 0.5, end_m, 1.1)
    near = [translation(at, -0.45 * plan.width_m) for at in x]
    far = [translation(at + 0.55, 0.45 * plan.width_m) @ rotation((0, 0, 1), 180) for at in x[:-1]]
    return copies(lamp, np.stack(near + far))


def pier(plan: BridgePlan, at_m: float, top_m: float, *, thick_m: float = 0.32, wide_m: float = 0.3) -> Mesh:
    """Build a river pier with pointed ends and its top at z = top_m.

    wide_m: how much wider than the road the pier is, not counting its pointed ends.
    """
    y = plan.width_m / 2 + wide_m / 2
    outline = np.array([(0.5, -y), (0.5, y), (0, y + 0.2), (-0.5, y), (-0.5, -y), (0, -y - 0.2)]) * [
        thick_m,
        1,
    ]
    cap = prism(outline * [1.25, 1.04], 0.08, plan.masonry).translate(x=at_m, z=top_m - 0.08)
    foot = prism(outline * [1.5, 1.08], 0.85, plan.masonry).translate(x=at_m, z=-0.7)
    shaft = prism(outline, top_m + 0.62, plan.masonry).translate(x=at_m, z=-0.7)
    return join_meshes([foot, shaft, cap])


def abutments(plan: BridgePlan) -> Mesh:
    """Build the abutments between the bridge and the banks at both ends."""
    size_m = [0.9, plan.width_m + 0.24, plan.level_m + 0.88]
    x = (plan.half_m + 0.42) * np.array([-1.0, 1.0])
    walls = boxes([[at, 0, (plan.level_m - 1.12) / 2] for at in x], [size_m], plan.masonry)
    posts = boxes(
        [
            [at * (plan.half_m - 0.02) / abs(at), y, plan.level_m + 0.06]
            for at in x
            for y in (-plan.width_m / 2, plan.width_m / 2)
        ],
        [[0.14, 0.14, 0.3]],
        plan.masonry,
    )
    return join_meshes([walls, posts])


def stone_arch_bridge(rng: np.random.Generator, palette: Palette, plan: BridgePlan) -> Mesh:
    """Build a bridge of two to five arches with voussoirs, pointed piers and parapets."""
    count = int(rng.integers(2, 6))
    wide_m = 2 * plan.half_m / count
    pier_m = min(0.16 * wide_m, 0.4)
    half_m, spring_m = (wide_m - pier_m) / 2, rng.uniform(0.1, 0.35)
    rise_m = min(plan.level_m - spring_m - 0.22, half_m)
    middles_m = -plan.half_m + wide_m * (np.arange(count) + 0.5)
    angle = np.linspace(np.pi, 0, 21)
    arch = np.stack([half_m * np.cos(angle), spring_m + rise_m * np.sin(angle)], -1)
    parts = [_arch(plan, arch, wide_m / 2).translate(x=x) for x in middles_m]
    inner_m = middles_m[:-1] + wide_m / 2
    parts += [pier(plan, x, spring_m + 0.1, thick_m=pier_m * 0.96, wide_m=0.06) for x in inner_m]
    cutwaters = [(x, side) for x in inner_m for side in (-1, 1)]
    buttress = prism([(-pier_m / 2, 0), (pier_m / 2, 0), (0, 0.2)], plan.level_m - 0.12, plan.masonry)
    parts += [
        buttress.transform(rotation((0, 0, 1), 0 if side > 0 else 180)).translate(x, side * plan.width_m / 2)
        for x, side in cutwaters
    ]
    return join_meshes([*parts, _parapets(plan)])


def _arch(plan: BridgePlan, arch_m: Float[np.ndarray, "k 2"], reach_m: float) -> Mesh:
    """Build one arch and the wall above it: the faces on both sides, the vault and the voussoirs."""
    y, top_m = plan.width_m / 2, plan.level_m
    below = np.concatenate(
        [[[-reach_m, -0.7], [arch_m[0, 0], -0.7]], arch_m, [[arch_m[-1, 0], -0.7], [reach_m, -0.7]]]
    )
    above = np.column_stack([below[:, 0], np.full(len(below), top_m)])
    face = np.stack([below, (below + above) / 2, above])
    front, back = (np.stack([face[..., 0], np.full(face.shape[:2], at), face[..., 1]], -1) for at in (-y, y))
    inside = below[1:-1]
    vault = np.stack(
        [np.column_stack([inside[:, 0], np.full(len(inside), at), inside[:, 1]]) for at in (-y, y)]
    )
    slopes = np.gradient(arch_m, axis=0)
    outwards = np.stack([-slopes[:, 1], slopes[:, 0]], -1) / np.linalg.norm(slopes, axis=1, keepdims=True)
    starts, ends = arch_m - 0.01 * outwards, arch_m + 0.11 * outwards
    gap_m = np.linalg.norm(np.diff(arch_m, axis=0), axis=1).mean()
    wedges = [
        beams(_upright(starts, at), _upright(ends, at), (0.05, 0.94 * gap_m), plan.dressed) for at in (-y, y)
    ]
    skins = [
        sheet(front, plan.masonry),
        sheet(back[:, ::-1], plan.masonry),
        sheet(vault[:, ::-1], plan.masonry),
    ]
    return join_meshes([*skins, *wedges])


def _parapets(plan: BridgePlan) -> Mesh:
    y = plan.width_m / 2
    length_m = 2 * plan.half_m + 0.5
    walls = boxes([[0, at, plan.level_m + 0.02] for at in (-y, y)], [[length_m, 0.07, 0.2]], plan.masonry)
    ledges = boxes(
        [[0, at, plan.level_m + z] for at in (-y, y) for z in (-0.07, 0.13)],
        [[length_m, 0.12, 0.035]],
        plan.dressed,
    )
    return join_meshes([walls, ledges])


def _upright(points_m: Float[np.ndarray, "k 2"], y_m: float) -> Float[np.ndarray, "k 3"]:
    return np.column_stack([points_m[:, 0], np.full(len(points_m), y_m), points_m[:, 1]])
