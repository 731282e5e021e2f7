"""Textures of stone walls."""

import numpy as np

from stereoweave.synth.textures.tiling import (
    SIDE,
    Map,
    Texture,
    mix,
    noise,
    ramp,
    smoothstep,
    stack_texture,
    voronoi_cells,
    warp,
)

_ROCKS = (
    ((132, 126, 116), (150, 142, 128), (112, 106, 98), (162, 154, 140)),
    ((146, 128, 104), (166, 148, 122), (126, 108, 90), (152, 142, 126)),
    ((104, 102, 98), (124, 121, 115), (88, 86, 83), (140, 134, 126)),
)


def rubble_wall(rng: np.random.Generator) -> Texture:
    """Draw a wall of field stones in mortar."""
    rows = int(rng.choice([9, 12]))
    stones = voronoi_cells(rng, rows, int(rows * 0.65), 0.42, rough=7)
    edge = stones.rim + 0.7 * noise(rng, 1.0, 16)
    mortar = smoothstep(4.5, 2.0, edge)
    return _masonry(rng, stones.label, stones.number, edge, mortar)


def coursed_wall(rng: np.random.Generator) -> Texture:
    """Draw a wall of hewn blocks of varying length, laid in courses."""
    label, edge, count = _lay_courses(rng)
    edge = edge + 0.8 * noise(rng, 1.0, 16)
    return _masonry(rng, label, count, edge, smoothstep(3.4, 1.4, edge))


def _lay_courses(rng: np.random.Generator) -> tuple[np.ndarray, Map, int]:
    """Return maps of the block labels and of the distance to the nearest joint, and the number of blocks.

    Distances are in texels.
    """
    heights = rng.choice([2, 3, 4], 12)
    edges = np.round(np.concatenate([[0], np.cumsum(heights)]) * SIDE / heights.sum()).astype(int)
    label = np.zeros((SIDE, SIDE), int)
    edge = np.full((SIDE, SIDE), np.inf, np.float32)
    count = 0
    for top, bottom in zip(edges[:-1], edges[1:], strict=True):
        lengths = rng.uniform(0.6, 2.4, max(4, int(SIDE / (1.6 * (bottom - top)))))
        ends = np.cumsum(lengths) / lengths.sum() * SIDE + rng.uniform(0, SIDE)
        away = np.abs((np.arange(SIDE)[:, None] - ends + SIDE / 2) % SIDE - SIDE / 2).min(1)
        label[top:bottom] = count + np.searchsorted(np.sort(ends % SIDE), np.arange(SIDE)) % len(ends)
        y = np.arange(top, bottom)
        edge[top:bottom] = np.minimum(away, np.minimum(y - top, bottom - y)[:, None])
        count += len(ends)
    wander = noise(rng, 1.5, 6), noise(rng, 1.5, 6)
    label = warp(label.astype(np.float32), 2.0 * wander[0], 2.0 * wander[1], 0).astype(int)
    return label, warp(edge, 2.0 * wander[0], 2.0 * wander[1]), count


def _masonry(rng: np.random.Generator, label: np.ndarray, count: int, edge: Map, mortar: Map) -> Texture:
    """Draw stones in mortar, in different shades and rounded towards their edges."""
    palette = np.array(_ROCKS[rng.integers(len(_ROCKS))])
    shades = palette[rng.integers(0, 4, count)] * np.exp(rng.normal(0, 0.08, (count, 1)))
    grain, veins = noise(rng, 0.8, 8), noise(rng, 1.4, 8)
    colours = shades.astype(np.float32)[label] * (1 + 0.06 * grain + 0.06 * veins)[..., None]
    colours *= (0.72 + 0.28 * smoothstep(0, 11, edge))[..., None]
    bed = ramp(0.5 + 0.2 * noise(rng, 0.6), (118, 112, 102), (146, 138, 126)) * rng.uniform(0.45, 0.7)
    colours = mix(colours, bed, mortar)
    grime = smoothstep(0.2, 2.5, noise(rng, 1.3, 3, stretch=(3, 1)))
    moss = smoothstep(1.4, 2.6, noise(rng, 1.4, 3) + 0.4 * mortar)
    colours = mix(colours * (1 - 0.3 * grime)[..., None], (88, 92, 64), 0.45 * moss)
    round_top = np.clip(edge / 14, 0, 1) ** 0.5
    proud = rng.normal(0, 0.12, count).astype(np.float32)[label]
    return stack_texture(colours, (0.5 * round_top + proud + 0.12 * veins) * (1 - mortar) - 0.6 * mortar)
