"""Textures of bark, boards, leaves and grass."""

import numpy as np
from jaxtyping import Float

from stereoweave.synth.textures.tiling import (
    SIDE,
    Colour,
    Map,
    Texture,
    blade_outlines,
    distance_to_lines,
    mix,
    noise,
    paint_polygons,
    ramp,
    smoothstep,
    stack_texture,
    texel_grid,
    voronoi_cells,
    warp,
)
from stereoweave.synth.textures.wear import dirt_map


def furrowed_bark(rng: np.random.Generator) -> Texture:
    """Draw oak bark with dark furrows between ridges that run along y, split and join."""
    wander = 5 * noise(rng, 1.6, 5)
    fibres = warp(noise(rng, 0.9, 8, stretch=(6, 1)), wander, wander)
    furrows = np.abs(warp(noise(rng, 1.9, 9, stretch=(4.5, 1)), wander, wander))
    across = np.abs(noise(rng, 1.9, 14, stretch=(1, 2)))
    depth = np.clip(furrows / 0.8, 0, 1) * (0.55 + 0.45 * np.clip(across / 0.35, 0, 1)) + 0.07 * fibres
    tone = 0.06 + 0.8 * depth + 0.06 * noise(rng, 1.3, 3)
    colours = ramp(tone, (36, 30, 26), (82, 71, 60), (114, 102, 88), (134, 123, 109))
    lichen = smoothstep(1.0, 2.0, noise(rng, 1.2, 4)) * smoothstep(0.4, 0.9, depth)
    colours = mix(colours, (122, 128, 106), 0.5 * lichen)
    return stack_texture(colours, 1.5 * depth - 0.85)


def plated_bark(rng: np.random.Generator) -> Texture:
    """Draw pine bark of reddish, flaking plates."""
    plates, flakes = voronoi_cells(rng, 8, 13, 0.5, rough=9), voronoi_cells(rng, 24, 30, 0.5, rough=5)
    depth = np.clip((plates.rim + 0.9 * noise(rng, 1.1, 12)) / 8, 0, 1)
    leaf = flakes.per_texel(rng.normal(0, 1, flakes.number)) - 0.8 * smoothstep(2.0, 0.5, flakes.rim)
    tone = 0.08 + 0.55 * depth**0.6 + 0.08 * leaf + 0.07 * noise(rng, 0.9, 6)
    colours = ramp(tone, (38, 30, 26), (84, 66, 56), (120, 97, 82), (142, 124, 110))
    return stack_texture(colours, 1.3 * depth - 0.8 + 0.12 * leaf)


def smooth_bark(rng: np.random.Generator) -> Texture:
    """Draw grey beech or birch bark with lens-shaped marks, scars and lichen."""
    lens = noise(rng, 1.1, 12, stretch=(1, 6))
    marks, lips = smoothstep(1.5, 1.9, lens), smoothstep(1.0, 1.5, lens)
    wrinkles = warp(noise(rng, 1.1, 6, stretch=(1, 5)), 8 * noise(rng, 1.8, 3), 8 * noise(rng, 1.8, 3))
    scars = smoothstep(1.9, 2.4, noise(rng, 1.7, 4, stretch=(1, 1.5)) + 0.2 * noise(rng, 0.9, 20))
    broad = noise(rng, 1.3, 2)
    colours = ramp(0.5 + 0.16 * broad + 0.14 * wrinkles, (88, 84, 77), (120, 116, 107), (150, 146, 136))
    colours = mix(colours, (140, 144, 124), 0.6 * smoothstep(0.9, 2.2, noise(rng, 1.1, 5)))
    colours = mix(mix(colours, (150, 143, 130), 0.5 * lips), (58, 50, 45), 0.85 * marks)
    colours = mix(colours, ramp(0.5 + 0.25 * wrinkles, (40, 36, 33), (84, 76, 68)), scars)
    return stack_texture(colours, 0.15 * wrinkles + 0.25 * lips - 0.5 * marks + 0.3 * scars * wrinkles)


def planks(rng: np.random.Generator) -> Texture:
    """Draw boards along y with growth rings, knots, splits and gaps."""
    y, x = texel_grid()
    count = int(rng.choice([4, 6, 8]))
    width = SIDE / count
    board = np.floor(x / width).astype(int)
    shift = rng.integers(0, SIDE, count)
    fibres = _shift_boards(noise(rng, 0.8, 8, stretch=(24, 1)), shift, board)
    bend = _shift_boards(noise(rng, 1.7, 2, stretch=(5, 1)), shift, board)
    rings = np.sin((x % width) / width * rng.uniform(5, 16, count).astype(np.float32)[board] + 4.5 * bend)
    weathered = rng.random() < 0.5
    dark, light = ((92, 84, 74), (158, 148, 134)) if weathered else ((96, 72, 52), (170, 138, 104))
    tone = 0.5 + 0.16 * rings + 0.13 * fibres + rng.normal(0, 0.1, count)[board]
    colours = ramp(tone.astype(np.float32), dark, light)
    knots = _knots(rng, count)
    colours = mix(colours, (64, 46, 34), 0.8 * knots)
    gap = smoothstep(1.8, 0.7, distance_to_lines(x, 0, width))
    split = smoothstep(2.0, 2.4, fibres) * 0.5
    colours *= (1 - 0.75 * gap - 0.45 * split - 0.15 * dirt_map(rng))[..., None]
    return stack_texture(colours, 0.1 + 0.12 * rings + 0.1 * fibres - gap - 0.3 * split)


_FOLIAGE: tuple[tuple[Colour, ...], ...] = (
    ((52, 64, 36), (66, 80, 44), (82, 94, 54), (98, 108, 64)),
    ((58, 68, 44), (76, 86, 54), (92, 100, 62), (110, 110, 72)),
    ((46, 58, 36), (60, 73, 45), (76, 88, 56), (92, 102, 70)),
    ((64, 70, 40), (84, 88, 50), (104, 100, 60), (122, 106, 66)),
)


def foliage(rng: np.random.Generator) -> Texture:
    """Draw foliage as seen from a few metres away, with overlapping leaves and dark gaps."""
    palette = np.array(_FOLIAGE[rng.integers(len(_FOLIAGE))])
    size, slim = rng.uniform(9, 17), rng.uniform(0.28, 0.5)
    canvas = np.full((SIDE, SIDE, 4), (20, 24, 16, 10), np.uint8)
    count = int(5.5 * SIDE**2 / (size * size * slim * 4))
    depth = np.sort(rng.uniform(0, 1, count))
    at = rng.uniform(0, SIDE, (count, 2))
    # Leaves grow in bunches with shade between them.
    bunch = noise(rng, 1.3, 6)[at[:, 1].astype(int), at[:, 0].astype(int)]
    light = np.clip(0.25 + 0.7 * depth + 0.17 * bunch, 0.15, 1.2) * np.exp(rng.normal(0, 0.13, count))
    shade = palette[rng.integers(0, 4, count)] * light[:, None] + rng.normal(0, 3, (count, 3))
    turn = rng.normal(np.pi / 2, 0.9, count)
    length = size * np.exp(rng.normal(0, 0.25, count))
    halves = _leaf_halves(at, turn, length, slim)
    # One half of each leaf is brighter.
    lit = shade[:, None] * np.array([1.12, 0.86])[:, None]
    levels = np.concatenate([lit, np.broadcast_to(25 + 200 * depth, (2, count)).T[..., None]], -1)
    paint_polygons(canvas, halves.reshape(-1, 6, 2), levels.reshape(-1, 4))
    colours = canvas[..., :3] * (1 + 0.05 * noise(rng, 0.6))[..., None]
    return stack_texture(colours, canvas[..., 3] / 127.5 - 1)


def grass(rng: np.random.Generator) -> Texture:
    """Draw grass seen from above: fresh and dry blades in all directions, with soil between them."""
    fresh = np.array(((64, 78, 40), (78, 92, 50), (94, 106, 60), (86, 94, 62)))
    dry = np.array(((136, 126, 92), (122, 112, 84)))
    dryness, count = rng.uniform(0.02, 0.25), 8500
    canvas = np.full((SIDE, SIDE, 4), (32, 34, 21, 20), np.uint8)
    depth = np.sort(rng.uniform(0, 1, count))
    at = rng.uniform(0, SIDE, (count, 2))
    clump = noise(rng, 1.4, 3)[at[:, 1].astype(int), at[:, 0].astype(int)]
    shade = fresh[rng.integers(0, 4, count)]
    is_dry = rng.random(count) < dryness * np.exp(0.7 * clump)
    shade = np.where(is_dry[:, None], dry[rng.integers(0, 2, count)], shade)
    shade = shade * ((0.45 + 0.6 * depth + 0.07 * clump) * np.exp(rng.normal(0, 0.12, count)))[:, None]
    turn = rng.uniform(0, 2 * np.pi, count)
    length = rng.uniform(18, 52) * np.exp(rng.normal(0, 0.3, count))
    turns = np.stack([turn, turn + rng.normal(0, 0.7, count)], 1)
    shapes = blade_outlines(at, turns, length, rng.uniform(0.8, 1.8, count))
    paint_polygons(canvas, shapes, np.column_stack([shade, 40 + 190 * depth]))
    colours = canvas[..., :3] * (1 + 0.07 * noise(rng, 1.4, 2) + 0.04 * noise(rng, 0.5))[..., None]
    return stack_texture(colours, canvas[..., 3] / 127.5 - 1)


def _knots(rng: np.random.Generator, boards: int) -> Map:
    y, x = texel_grid()
    knots = np.zeros((SIDE, SIDE), np.float32)
    for board in range(boards):
        if rng.random() < 0.7:
            middle, at = (board + rng.uniform(0.3, 0.7)) * SIDE / boards, rng.uniform(0, SIDE)
            size = rng.uniform(3, 8)
            distance = np.hypot(x - middle, distance_to_lines(y, at, SIDE) / 1.5) / size
            knots = np.maximum(knots, smoothstep(1.3, 0.5, distance))
    return knots


def _shift_boards(values: Map, shift: np.ndarray, board: np.ndarray) -> Map:
    """Shift the values of each board along y by a different amount."""
    rows = (np.arange(SIDE)[:, None] + shift[board]) % SIDE
    return np.take_along_axis(values, rows, 0)


def _leaf_halves(
    at: Float[np.ndarray, "n 2"],
    turn: Float[np.ndarray, " n"],
    length: Float[np.ndarray, " n"],
    slim: float,
) -> Float[np.ndarray, "n 2 6 2"]:
    """Return the outlines of both halves of pointed leaves.

    at: centres of the leaves.
    length: half the length of each leaf.
    """
    along = np.linspace(-1, 1, 6)
    bow = slim * (1 - np.abs(along) ** 1.7)
    halves = np.stack([np.stack([along, side * bow], -1) for side in (1, -1)])
    axes = np.stack([np.cos(turn), np.sin(turn), -np.sin(turn), np.cos(turn)], -1).reshape(-1, 2, 2)
    return at[:, None, None] + length[:, None, None, None] * np.einsum("hks,nsd->nhkd", halves, axes)
