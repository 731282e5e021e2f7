"""Textures of soil, mud, gravel and asphalt."""

import numpy as np

from stereoweave.synth.textures.tiling import (
    SIDE,
    Canvas,
    Colour,
    Texture,
    blade_outlines,
    blur,
    mix,
    noise,
    paint_polygons,
    ramp,
    smoothstep,
    stack_texture,
    tint_grey,
    voronoi_cells,
)
from stereoweave.synth.textures.wear import crack_map


def soil(rng: np.random.Generator) -> Texture:
    """Draw soil with clods, small stones and bits of straw."""
    clods = voronoi_cells(rng, 36, 36, 0.5, rough=5)
    size = clods.per_texel(rng.uniform(0.3, 1, clods.number))
    lump = size * np.clip((clods.rim + noise(rng, 0.9, 10)) / 6, 0, 1)
    broad, fine = noise(rng, 1.4, 2), noise(rng, 0.8, 8)
    colours = ramp(
        0.3 + 0.12 * broad + 0.14 * fine + 0.28 * lump,
        (48, 38, 30),
        (84, 68, 52),
        (112, 92, 72),
        (136, 118, 96),
    )
    canvas = np.dstack([colours, 100 + 60 * lump]).clip(0, 255).astype(np.uint8)
    _paint_stones(rng, canvas, 260, 3.2, ((126, 116, 102), (106, 98, 88), (148, 138, 124)))
    _paint_straw(rng, canvas, 160)
    return stack_texture(canvas[..., :3] + (4 * fine)[..., None], canvas[..., 3] / 127.5 - 1 + 0.15 * fine)


def dried_mud(rng: np.random.Generator) -> Texture:
    """Draw dried mud that has cracked into plates."""
    plates, parts = voronoi_cells(rng, 9, 9, 0.5, rough=5), voronoi_cells(rng, 22, 22, 0.5, rough=3)
    edge = plates.rim + 0.6 * noise(rng, 0.9, 20)
    gap = smoothstep(3.2, 1.2, edge)
    hair = smoothstep(1.5, 0.5, parts.rim) * smoothstep(-0.2, 0.8, noise(rng, 1.5, 3))
    broad, fine = noise(rng, 1.4, 2), noise(rng, 0.8, 10)
    tone = 0.5 + 0.13 * broad + 0.1 * fine + plates.per_texel(rng.normal(0, 0.07, plates.number))
    colours = ramp(tone, (104, 88, 70), (132, 116, 96), (152, 138, 118))
    colours = mix(colours, (44, 36, 29), gap) * (1 - 0.4 * hair)[..., None]
    return stack_texture(colours, 0.35 * np.clip(edge / 12, 0, 1) + 0.1 * fine - gap - 0.3 * hair)


_PEBBLES = (
    ((132, 126, 116), (150, 142, 128), (112, 106, 98), (162, 154, 140)),
    ((140, 126, 106), (160, 146, 124), (122, 108, 92), (150, 142, 128)),
    ((106, 103, 99), (124, 120, 114), (90, 87, 84), (140, 134, 126)),
)


def gravel(rng: np.random.Generator) -> Texture:
    """Draw gravel of overlapping pebbles of several sizes."""
    canvas = np.full((SIDE, SIDE, 4), (58, 54, 48, 20), np.uint8)
    palette = _PEBBLES[rng.integers(len(_PEBBLES))]
    size = rng.uniform(5, 12)
    for share in (0.7, 1.0):
        _paint_stones(rng, canvas, int(1.3 * (SIDE / (2 * size * share)) ** 2), size * share, palette)
    fine = noise(rng, 0.6, 4)
    colours = canvas[..., :3] * (1 + 0.06 * fine + 0.05 * noise(rng, 1.4, 2))[..., None]
    return stack_texture(colours, blur(canvas[..., 3] / np.float32(127.5) - 1, 1.0) + 0.05 * fine)


def asphalt(rng: np.random.Generator) -> Texture:
    """Draw asphalt with visible stones, open and sealed cracks, patches and oil stains."""
    stones = blur(noise(rng, 0.0), 0.8)
    stones = stones / stones.std()
    broad = noise(rng, 1.4, 2)
    grey = (
        66 + 6 * broad + 9 * stones + 26 * smoothstep(1.9, 2.6, stones) - 14 * smoothstep(-1.6, -2.4, stones)
    )
    patch = smoothstep(1.25, 1.3, noise(rng, 2.2, 2) + 0.02 * noise(rng, 0.8, 20))
    oil = smoothstep(1.4, 2.6, noise(rng, 1.7, 3))
    cracks = crack_map(rng, 5, 0.4)
    sealed = crack_map(rng, 2, 0.4, width=4.5)
    grey *= (1 - 0.2 * patch) * (1 - 0.25 * oil) * (1 - 0.7 * cracks)
    grey = grey + sealed * (36 + 4 * stones - grey)
    return stack_texture(tint_grey(grey, 1.02, 0.97), 0.1 + 0.17 * stones * (1 - sealed) - 0.6 * cracks)


def _paint_stones(
    rng: np.random.Generator, canvas: Canvas, count: int, size: float, palette: tuple[Colour, ...]
) -> None:
    """Paint rounded stones, each darker and lower at its rim."""
    angle = np.arange(9) * 2 * np.pi / 9
    radius = size * np.exp(rng.normal(0, 0.28, count))[:, None] * np.exp(rng.normal(0, 0.1, (count, 9)))
    flat, turn = rng.uniform(0.6, 1, count)[:, None], rng.uniform(0, np.pi, count)[:, None]
    x, y = radius * np.cos(angle), flat * radius * np.sin(angle)
    ring = np.stack([np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y], -1)
    at = rng.uniform(0, SIDE, (count, 1, 2))
    shade = np.array(palette)[rng.integers(0, len(palette), count)] * np.exp(rng.normal(0, 0.13, (count, 1)))
    base = rng.uniform(60, 120, count)
    rings = [(1.0, 0.66, 0), (0.8, 1.0, 70)]
    shapes = np.stack([at + scale * ring for scale, _, _ in rings], 1).reshape(-1, 9, 2)
    levels = np.stack([np.column_stack([shade * gain, base + up]) for _, gain, up in rings], 1).reshape(-1, 4)
    paint_polygons(canvas, shapes, levels)


def _paint_straw(rng: np.random.Generator, canvas: Canvas, count: int) -> None:
    at, turn = rng.uniform(0, SIDE, (count, 2)), rng.uniform(0, 2 * np.pi, count)
    length = rng.uniform(8, 30, count)
    turns = np.stack([turn, turn + rng.normal(0, 0.3, count)], 1)
    straw = blade_outlines(at, turns, length, rng.uniform(0.5, 1.1, count))
    shade = np.array((150, 132, 98)) * np.exp(rng.normal(0, 0.2, (count, 1)))
    paint_polygons(canvas, straw, np.column_stack([shade, rng.uniform(120, 180, count)]))
