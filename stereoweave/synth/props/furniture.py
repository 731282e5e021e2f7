"""Random furniture, plants and household objects about one metre in size."""

import numpy as np
from jaxtyping import Float

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
from stereoweave.synth.props.solids import PropBuilder, PropStyle
from stereoweave.synth.world import Mesh, join_meshes


def chair(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a chair with round legs and rungs, a seat, and a back of slats or uprights."""
    width_m, seat_m = rng.uniform(0.4, 0.5), rng.uniform(0.42, 0.5)
    leg_m, half_m = rng.uniform(0.012, 0.025), width_m / 2
    feet = np.array([[x, y, 0.0] for y in (-half_m, half_m) for x in (-half_m, half_m)])
    tops = feet * [0.9, 0.9, 1] + [[0, 0, seat_m], [0, 0, seat_m], [0, 0.05, 0.95], [0, 0.05, 0.95]]
    seat = boxes([[0, 0, seat_m]], [[width_m, width_m, 0.04]], style.other)
    count = int(rng.integers(2, 7))
    if rng.random() < 0.5:
        places = np.stack([np.zeros(count), np.full(count, half_m), np.linspace(0.58, 0.92, count)], -1)
        back = boxes(places, [0.9 * width_m, 0.015, 0.2 / count], style.main)
    else:
        x = np.linspace(-0.4, 0.4, count + 2) * width_m
        low = np.stack([x, np.full(count + 2, half_m), np.full(count + 2, seat_m)], -1)
        back = tubes(low, low + [0, 0, 0.45], 0.7 * leg_m, style.main)
        back = join_meshes([back, boxes([[0, half_m, 0.92]], [[width_m, 0.03, 0.06]], style.main)])
    rungs = tubes(
        0.7 * feet[[0, 2, 0]] + 0.3 * tops[[0, 2, 0]],
        0.7 * feet[[1, 3, 2]] + 0.3 * tops[[1, 3, 2]],
        0.8 * leg_m,
        style.main,
    )
    return join_meshes([tubes(feet, tops, leg_m, style.main, 10), seat, back, rungs])


def table(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a round pedestal table, or a rectangular table with four legs, with cups on it."""
    height_m = rng.uniform(0.45, 0.75)
    if rng.random() < 0.4:
        rim = np.array([[0, 0.96], [0.5, 0.96], [0.5, 1.0], [0.0, 1.0]]) * [1, height_m]
        foot = np.array([[0, 0], [0.25, 0], [0.06, 0.1], [0.04, 0.5], [0.08, 0.96]]) * [1, height_m]
        stand = join_meshes([lathe(rim, style.main, 48), lathe(foot, style.other, 24)])
    else:
        legs = np.array([[x, y, 0] for x in (-0.45, 0.45) for y in (-0.28, 0.28)])
        top = boxes([[0, 0, height_m - 0.02]], [[1.0, 0.65, 0.04]], style.main)
        rails = boxes([[0, y, height_m - 0.08] for y in (-0.28, 0.28)], [0.9, 0.02, 0.08], style.other)
        stand = join_meshes([top, rails, tubes(legs, legs + [0, 0, height_m - 0.02], 0.025, style.other, 10)])
    cup = np.array([[0, 0], [0.035, 0], [0.045, 0.1], [0.04, 0.1], [0.032, 0.01], [0, 0.01]])
    spots = [translation(x, y, height_m) for x, y in rng.uniform(-0.25, 0.25, (4, 2))]
    cups = copies(lathe(1.5 * cup, style.other, 24), np.stack(spots))
    return join_meshes([stand, cups])


def leaning_ladder(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a leaning ladder."""
    count, width_m, lean_m = int(rng.integers(5, 11)), rng.uniform(0.12, 0.2), rng.uniform(0.0, 0.3)
    sides = np.array([[-width_m, 0, 0], [width_m, 0, 0]])
    share = (np.arange(count) + 0.5)[:, None] / count
    rungs = [side + share * [0, lean_m, 1.0] for side in sides]
    rails = tubes(sides, sides + [0, lean_m, 1.0], 0.016, style.main, 8)
    return join_meshes([rails, tubes(rungs[0], rungs[1], 0.011, style.other, 8)])


def shelf(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a bookcase filled with books: shelves between two side panels."""
    count, depth_m = int(rng.integers(2, 6)), rng.uniform(0.16, 0.28)
    levels = np.linspace(0.03, 1.0, count + 1)
    boards = boxes([[0, 0, z] for z in levels], [0.7, depth_m, 0.02], style.main)
    sides = boxes([[x, 0, 0.5] for x in (-0.36, 0.36)], [0.02, depth_m, 1.04], style.main)
    gap_m = levels[1] - levels[0]
    rows = [
        _standing_books(rng, style, 0.64, gap_m - 0.03, depth_m).translate(z=z + 0.01) for z in levels[:-1]
    ]
    return join_meshes([boards, sides, *rows])


def book_stack(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build an untidy stack of books, with covers and pages in different materials."""
    count = int(rng.integers(4, 14))
    thick_m = rng.uniform(0.03, 0.1, count)
    middles_m = np.cumsum(thick_m) - thick_m / 2
    turns = np.stack([rotation((0, 0, 1), angle)[:3, :3] for angle in rng.normal(0, 14, count)])
    sizes_m = np.column_stack([rng.uniform(0.45, 0.75, count), rng.uniform(0.35, 0.5, count), 0.97 * thick_m])
    centres_m = np.column_stack([rng.normal(0, 0.02, (count, 2)), middles_m])
    pages = boxes(centres_m + 0.015 * turns[:, :, 0], sizes_m * [0.99, 0.97, 0.8], style.other, turns)
    covers = [
        boxes(
            centres_m + side * np.outer(0.45 * thick_m, [0, 0, 1]), sizes_m * [1, 1, 0.1], style.main, turns
        )
        for side in (-1, 1)
    ]
    spines = boxes(
        centres_m - 0.495 * sizes_m[:, :1] * turns[:, :, 0], sizes_m * [0.02, 1, 1], style.main, turns
    )
    return join_meshes([pages, *covers, spines])


def picture(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a picture in a frame of four bars."""
    width_m, height_m, bar_m = rng.uniform(0.5, 1.0), rng.uniform(0.5, 1.0), rng.uniform(0.02, 0.06)
    x, z = np.array([-width_m, width_m]) / 2, np.array([-height_m, height_m]) / 2
    level = boxes([[0, 0, at] for at in z], [width_m + bar_m, 0.04, bar_m], style.main)
    upright = boxes([[at, 0, 0] for at in x], [bar_m, 0.04, height_m - bar_m], style.main)
    return join_meshes([boxes(np.zeros(3), [width_m, 0.015, height_m], style.other), level, upright])


def plant(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a potted plant with long, bent leaves."""
    count, pot_m = int(rng.integers(20, 70)), rng.uniform(0.12, 0.2)
    pot = (
        np.array([[0, 0], [0.7, 0], [1, 1.4], [1.1, 1.4], [1.1, 1.6], [0.9, 1.6], [0.85, 1.3], [0, 1.3]])
        * pot_m
    )
    blades = [_blade(rng, style.main) for _ in range(3)]
    angle, lean = rng.uniform(0, 2 * np.pi, count), rng.normal(0, 0.2, count)
    (c, s), (cl, sl), zero = (np.cos(angle), np.sin(angle)), (np.cos(lean), np.sin(lean)), np.zeros(count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = np.moveaxis(
        np.array([[c * cl, -s, c * sl], [s * cl, c, s * sl], [-sl, zero, cl]]), 2, 0
    )
    poses[:, :3, :3] *= rng.uniform(0.5, 1.0, (count, 1, 1))
    poses[:, 2, 3] = 1.3 * pot_m
    return join_meshes(
        [lathe(pot, style.other, 28), *(copies(blade, poses[k::3]) for k, blade in enumerate(blades))]
    )


def bush(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a bush: a ball of leaves around a stem."""
    count = int(rng.integers(150, 400))
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    centres_m = directions * 0.36 * rng.uniform(0.55, 1, (count, 1)) + [0, 0, 0.62]
    along = directions + rng.normal(0, 0.6, (count, 3))
    across = np.cross(along, rng.normal(size=(count, 3)))
    along, across = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (along, across))
    length_m, width_m = rng.uniform(0.05, 0.09), rng.uniform(0.02, 0.04)
    leaves = _leaves(centres_m, along * length_m, across * width_m, style.main)
    return join_meshes([leaves, tubes([[0, 0, 0]], [[0, 0, 0.6]], 0.02, style.other, 8)])


def bench(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a slatted bench."""
    count, y = int(rng.integers(3, 6)), np.linspace(-0.15, 0.15, 5)
    slats = boxes(
        [[0, at, 0.42] for at in np.linspace(-0.16, 0.16, count)], [1.0, 0.22 / count, 0.03], style.main
    )
    back = boxes([[0, 0.2 + 0.04 * k, 0.58 + 0.13 * k] for k in range(2)], [1.0, 0.02, 0.08], style.main)
    feet = np.array([[x, at, 0.0] for x in (-0.42, 0.42) for at in (y[0], y[-1])])
    tops = feet + [[0, 0, 0.42], [0, 0.1, 0.8]] * 2
    return join_meshes([slats, back, tubes(feet, tops, 0.018, style.other, 8)])


def stool(rng: np.random.Generator, style: PropStyle) -> Mesh:
    """Build a stool with three or four splayed legs, a round seat and a cushion."""
    legs, height_m = int(rng.integers(3, 5)), rng.uniform(0.5, 0.9)
    angle = np.arange(legs) * 2 * np.pi / legs
    out = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    seat = np.array([[0, -0.04], [0.22, -0.04], [0.24, -0.02], [0.22, 0], [0, 0]]) + [0, height_m]
    load = spheres(
        np.array([0, 0, height_m + 0.1]), np.array([[0.14, 0.14, 0.1]]), style.other, subdivisions=3
    )
    return join_meshes(
        [
            tubes(0.3 * out, 0.15 * out + [0, 0, height_m - 0.03], 0.02, style.main, 8),
            lathe(seat, style.main),
            load,
        ]
    )


def _standing_books(
    rng: np.random.Generator, style: PropStyle, width_m: float, height_m: float, depth_m: float
) -> Mesh:
    """Build books that stand side by side on z = 0, each in one of two materials."""
    thick_m = rng.uniform(0.012, 0.05, 40)
    ends_m = np.cumsum(thick_m)
    used = ends_m < width_m * rng.uniform(0.6, 1)
    heights_m = rng.uniform(0.65, 0.95, 40) * height_m
    sizes_m = np.column_stack([0.94 * thick_m, rng.uniform(0.7, 0.9, 40) * depth_m, heights_m])
    centres_m = np.column_stack([ends_m - thick_m / 2 - width_m / 2, np.zeros(40), heights_m / 2])
    first = rng.random(40) < 0.5
    return join_meshes(
        boxes(centres_m[rows & used], sizes_m[rows & used], material)
        for rows, material in ((first, style.main), (~first, style.other))
    )


def _blade(rng: np.random.Generator, material: int) -> Mesh:
    """Build a leaf that rises from the origin and bends over towards +x."""
    share = np.linspace(0, 1, 9)[:, None]
    bend = rng.uniform(0.6, 2.2) * share
    x, z = np.cumsum(np.sin(bend), 0) / 11, np.cumsum(np.cos(bend), 0) / 11
    width_m = rng.uniform(0.01, 0.06) * np.sin(np.pi * (0.08 + 0.9 * share)) * np.array([[-1, 0, 1]])
    fold = 0.3 * abs(width_m)
    return sheet(np.stack([x - 0 * width_m, width_m, z + fold], -1), material)


def _leaves(
    centres_m: Float[np.ndarray, "n 3"],
    along: Float[np.ndarray, "n 3"],
    across: Float[np.ndarray, "n 3"],
    material: int,
) -> Mesh:
    """Build flat, diamond-shaped leaves."""
    outwards = np.cross(along, across)
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    ring = np.stack([centres_m - along, centres_m + across, centres_m + along, centres_m - across], 1)
    corners = np.stack([ring[:, [0, 1, 2]], ring[:, [0, 2, 3]]], 1).reshape(-1, 3, 3)
    half = np.linalg.norm(along[0])
    uv = np.array([[[-1, 0], [0, 0.5], [1, 0]], [[-1, 0], [1, 0], [0, -0.5]]]) * half
    offset = (np.arange(len(centres_m)) * 0.618 % 7)[:, None, None, None]
    return Mesh(
        corners_m=corners.astype(np.float32),
        normals=np.repeat(outwards, 6, axis=0).reshape(-1, 3, 3).astype(np.float32) * -1,
        uv_m=(uv[None] + offset).reshape(-1, 3, 2).astype(np.float32),
        material=np.full(len(corners), material, np.int32),
        target=np.zeros(len(corners), bool),
    )


FURNITURE: tuple[PropBuilder, ...] = (
    chair,
    table,
    leaning_ladder,
    shelf,
    book_stack,
    picture,
    plant,
    bush,
    bench,
    stool,
)
