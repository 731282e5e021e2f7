"""Random solid objects about one metre in size, such as boxes, vases, twisted prisms and bent pipes."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.primitives import boxes, lathe, loft, rotation, sheet, spheres, sweep, tubes
from stereoweave.synth.world import Mesh, join_meshes


@dataclass(frozen=True, kw_only=True)
class PropStyle:
    """Materials and bar thickness of an object.

    Attributes:
        main, other: the two materials of the object.
        bar_m: radius of thin bars in an object 1 m in size.
    """

    main: int
    other: int
    bar_m: float


PropBuilder = Callable[[np.random.Generator, PropStyle], Mesh]


def box(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a flat or tall box with a protruding band at a random height."""
    size_m = rng.uniform(0.2, 1.0, 3)
    block = boxes(np.zeros(3), size_m, style.main)
    band_m = size_m * np.array([1.03, 1.03, rng.uniform(0.08, 0.3)])
    height_m = rng.uniform(-0.5, 0.5) * size_m[2]
    return join_meshes([block, boxes(np.array([0, 0, height_m]), band_m, style.other)])


def ball(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a ball."""
    return spheres(np.zeros(3), 0.5, style.main, subdivisions=3)


def ellipsoid(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build an ellipsoid."""
    return spheres(np.zeros(3), rng.uniform(0.15, 0.5, (1, 3)), style.main, subdivisions=3)


def cylinder(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a cylinder with bevelled rims and a band."""
    radius_m, height_m, bevel_m = rng.uniform(0.15, 0.5), rng.uniform(0.2, 1.0), rng.uniform(0.01, 0.04)
    rim = np.array([[radius_m - bevel_m, 0], [radius_m, bevel_m]])
    top = np.array([[radius_m, height_m - bevel_m], [radius_m - bevel_m, height_m], [0, height_m]])
    drum = lathe(np.concatenate([[[0.0, 0.0]], rim, top]), style.main, sections=48)
    low_m, high_m = np.sort(rng.uniform(0.2, 0.8, 2)) * height_m
    band_m = np.array([[radius_m, low_m], [radius_m * 1.02, low_m], [radius_m * 1.02, high_m]])
    return join_meshes(
        [drum, lathe(np.concatenate([band_m, [[radius_m, high_m]]]), style.other, sections=48)]
    )


def cone(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a truncated cone."""
    radius_m, height_m, tip_m = rng.uniform(0.2, 0.5), rng.uniform(0.4, 1.0), rng.uniform(0, 0.15)
    share = np.linspace(0, 1, 9)[:, None]
    side_m = (1 - share) * [[radius_m, 0]] + share * [[tip_m, height_m]]
    return lathe(np.concatenate([[[0.0, 0.0]], side_m, [[0.0, height_m]]]), style.main, sections=40)


def torus(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a thin or thick torus."""
    tube_m = rng.uniform(0.04, 0.17)
    angle = np.linspace(0, 2 * np.pi, 17)
    circle_m = tube_m * np.stack([np.cos(angle), np.sin(angle)], -1)
    return lathe(circle_m + [[0.5 - tube_m, tube_m]], style.main, sections=48)


def vase(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a vase or turned post with a smooth, wavy profile."""
    share = np.linspace(0, 1, 18)
    waves = sum(rng.uniform(-1, 1) / k * np.cos(np.pi * k * share + rng.uniform(0, 6)) for k in range(1, 6))
    radii_m = rng.uniform(0.12, 0.3) * np.exp(0.45 * waves)
    outside = np.stack([radii_m, share], -1)
    # The profile continues down the inside.
    inside = np.stack([radii_m[:11:-1] * 0.86, share[:11:-1]], -1)
    return lathe(np.concatenate([[[0.0, 0.0]], outside, inside, [[0.0, share[12]]]]), style.main, sections=40)


def bottle(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a bottle with a label and a cap."""
    radius_m, neck_m, shoulder = rng.uniform(0.12, 0.22), rng.uniform(0.03, 0.06), rng.uniform(0.5, 0.75)
    share = np.linspace(0, 1, 8)
    bend_m = neck_m + (radius_m - neck_m) * (1 + np.cos(np.pi * share)) / 2
    curve = np.stack([bend_m, shoulder + (0.9 - shoulder) * share], -1)
    body = np.concatenate([[[0, 0], [radius_m * 0.95, 0], [radius_m, 0.03]], curve, [[neck_m, 0.97]]])
    cap = np.array([[neck_m, 0.94], [neck_m * 1.25, 0.94], [neck_m * 1.25, 1.0], [0.0, 1.0]])
    label_m = radius_m * 1.01
    label = np.array([[label_m, 0.15], [label_m, shoulder * 0.85]])
    return join_meshes(
        [lathe(body, style.main), lathe(cap, style.other, 20), lathe(label, style.other, sections=36)]
    )


def lamp(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a floor lamp with a base, a pole and a shade."""
    foot_m, rod_m, low_m = rng.uniform(0.12, 0.22), rng.uniform(0.012, 0.03), rng.uniform(0.55, 0.7)
    stand = np.array([[0, 0], [foot_m, 0], [foot_m, 0.03], [rod_m, 0.06], [rod_m, 0.9], [0.0, 0.9]])
    wide_m, narrow_m = rng.uniform(0.2, 0.32), rng.uniform(0.08, 0.2)
    shade = np.array([[wide_m, low_m], [narrow_m, 1.0], [narrow_m - 0.01, 1.0], [wide_m - 0.01, low_m]])
    return join_meshes([lathe(stand, style.main, 24), lathe(shade, style.other, 48)])


def twisted_prism(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a twisted, tapering prism with three to six sides."""
    corners, steps = int(rng.integers(3, 7)), 5
    angle = np.arange(corners * steps) / steps
    part = (angle % 1)[:, None]
    at = np.stack([_on_circle(np.floor(angle) / corners), _on_circle((np.floor(angle) + 1) / corners)])
    polygon = (1 - part) * at[0] + part * at[1]
    share = np.linspace(0, 1, 20)
    twist = rng.uniform(-2.5, 2.5) * share
    size_m = rng.uniform(0.15, 0.4) * (1 + rng.uniform(-0.6, 0.6) * share)
    x = size_m[:, None] * (np.cos(twist)[:, None] * polygon[:, 0] - np.sin(twist)[:, None] * polygon[:, 1])
    y = size_m[:, None] * (np.sin(twist)[:, None] * polygon[:, 0] + np.cos(twist)[:, None] * polygon[:, 1])
    return loft(np.stack([x, y, share[:, None] + 0 * x], -1), style.main)


def bent_pipe(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a pipe of varying thickness along a random curve."""
    path_m = wander_m(rng, 26)
    return sweep(path_m, rng.uniform(0.02, 0.12) * (1 + 0.3 * np.sin(np.linspace(0, 9, 26))), style.main, 14)


def blob(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a boulder: a sphere with smooth bumps."""
    polar, around = np.linspace(3.12, 0.02, 24)[:, None], np.arange(36) * 2 * np.pi / 36
    radius_m = 0.4 + np.sum(
        [
            rng.normal(0, 0.06) * np.sin(k * polar) ** 2 * np.cos(k * around + rng.uniform(0, 6))
            for k in range(1, 5)
        ],
        axis=0,
    )
    x, y = np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around)
    directions = np.stack([x, y, np.cos(polar) + 0 * around], -1)
    return loft(radius_m[..., None] * directions * rng.uniform(0.5, 1.0, 3), style.main)


def plate(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a thin, flat board."""
    return boxes(np.zeros(3), np.array([rng.uniform(0.4, 1.0), rng.uniform(0.01, 0.04), 1.0]), style.main)


def bowl(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a deep or shallow bowl."""
    depth_m, angle = rng.uniform(0.12, 0.4), np.linspace(0.05, np.pi / 2, 10)
    outside = np.stack([0.5 * np.sin(angle), depth_m * (1 - np.cos(angle))], -1)
    inside = outside[::-1] * [0.94, 0.94] + [0, 0.06 * depth_m]
    return lathe(np.concatenate([[[0.0, outside[0, 1]]], outside, inside]), style.main, sections=44)


def dumbbell(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build two or three balls on a rod."""
    count = int(rng.integers(2, 4))
    centres_m = np.stack([np.zeros(count), np.zeros(count), np.linspace(-0.4, 0.4, count)], -1)
    balls = spheres(centres_m, rng.uniform(0.06, 0.5 / count, count), style.main, subdivisions=3)
    return join_meshes(
        [balls, tubes(centres_m[:1], centres_m[-1:], rng.uniform(0.01, 0.04), style.other, 12)]
    )


def cloth(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a wavy sheet of cloth."""
    x, z = np.meshgrid(np.linspace(-0.5, 0.5, 36), np.linspace(0, rng.uniform(0.6, 1.1), 26))
    y = sum(
        rng.uniform(0.01, 0.12) / np.sqrt(k) * np.sin(k * rng.uniform(2, 6) * x + rng.normal(0, 3) * z)
        for k in range(1, 5)
    )
    return sheet(np.stack([x, y, z], -1), style.main)


def arch(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build an arch: half a ring on two posts."""
    angle, radius_m, leg_m = np.linspace(0, np.pi, 24), rng.uniform(0.25, 0.45), rng.uniform(0.1, 0.5)
    bend = np.stack([radius_m * np.cos(angle), 0 * angle, leg_m + radius_m * np.sin(angle)], -1)
    path_m = np.concatenate([[[radius_m, 0, 0]], bend, [[-radius_m, 0, 0]]])
    return sweep(path_m, rng.uniform(0.03, 0.12), style.main, 16)


def stairs(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build stairs from blocks of increasing height."""
    count = int(rng.integers(4, 9))
    step_m, wide_m = 1.0 / count, rng.uniform(0.3, 0.8)
    k = np.arange(count)
    heights_m = (k + 1) * step_m * rng.uniform(0.5, 0.9)
    sizes_m = np.stack([np.full(count, step_m), np.full(count, wide_m), heights_m], -1)
    centres_m = np.stack([k * step_m, np.zeros(count), heights_m / 2], -1)
    return join_meshes(
        [boxes(centres_m[::2], sizes_m[::2], style.main), boxes(centres_m[1::2], sizes_m[1::2], style.other)]
    )


def tower_of_blocks(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a tower of rotated blocks."""
    count = int(rng.integers(3, 7))
    sizes_m = np.stack([*rng.uniform(0.2, 0.45, (2, count)), rng.uniform(0.6, 1.0, count) / count], -1)
    tops_m = np.cumsum(sizes_m[:, 2])
    centres_m = np.stack([*rng.normal(0, 0.03, (2, count)), tops_m - sizes_m[:, 2] / 2], -1)
    turns = np.stack([rotation((0, 0, 1), angle)[:3, :3] for angle in rng.uniform(0, 90, count)])
    pick = np.arange(count) % 2 == 0
    return join_meshes(
        boxes(centres_m[rows], sizes_m[rows], material, turns[rows])
        for rows, material in ((pick, style.main), (~pick, style.other))
    )


def wander_m(rng: np.random.Generator, count: int) -> Float[np.ndarray, "n 3"]:
    """Draw a smooth, random path about one metre in size."""
    share = np.linspace(0, 1, count)[:, None]
    waves = sum(
        rng.normal(0, 0.22 / k, 3) * np.sin(np.pi * k * share + rng.uniform(0, 6, 3)) for k in (1, 2, 3)
    )
    return share * np.array([[0.3, 0.0, 0.8]]) + waves


def _on_circle(turns: np.ndarray) -> Float[np.ndarray, "n 2"]:
    return np.stack([np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)], -1)


SOLIDS: tuple[PropBuilder, ...] = (
    (box, ball, ellipsoid, cylinder, cone, torus, vase, bottle, lamp, twisted_prism, bent_pipe, blob)
    + (plate, bowl, dumbbell, cloth, arch, stairs, tower_of_blocks)
)  # fmt: skip
