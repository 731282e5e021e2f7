"""Textures of tiled and slated roofs."""

import numpy as np

from stereoweave.synth.textures.tiling import (
    SIDE,
    Colours,
    Texture,
    blur,
    mix,
    noise,
    smoothstep,
    stack_texture,
    texel_grid,
    tint_grey,
)
from stereoweave.synth.textures.wear import dirt_map


def pantiles(rng: np.random.Generator) -> Texture:
    """Draw overlapping rows of wavy pantiles."""
    y, x = texel_grid()
    wave = 0.5 + 0.5 * np.sin(2 * np.pi * x / (SIDE / 12) + 0.1 * noise(rng, 1.2, 4))
    row_high = SIDE / 10
    sagging = y + 1.5 * noise(rng, 1.5, 4) + 3 * wave
    fall = (sagging / row_high) % 1
    number = (np.floor(sagging / row_high) % 10 * 12 + np.floor(x / (SIDE / 12))).astype(int)
    colours = _fired_clay(rng, number, 120)
    shade = (
        (0.55 + 0.45 * wave)
        * (1 - 0.5 * smoothstep(0.9, 1.0, fall))
        * (0.85 + 0.15 * smoothstep(0, 0.25, fall))
    )
    return stack_texture(colours * shade[..., None], 1.0 * wave - 0.7 + 0.5 * fall)


def plain_tiles(rng: np.random.Generator) -> Texture:
    """Draw flat clay tiles with rounded ends."""
    return _shingles(rng, rows=20, columns=16, rounded=0.35, fire=True)


def slates(rng: np.random.Generator) -> Texture:
    """Draw roof slates."""
    return _shingles(rng, rows=14, columns=10, rounded=0.0, fire=False)


def _fired_clay(rng: np.random.Generator, number: np.ndarray, count: int) -> Colours:
    """Return the colours of fired-clay tiles in different shades, with lichen and soot."""
    palette = np.array([(124, 72, 54), (142, 86, 64), (108, 66, 54), (156, 104, 78), (118, 88, 72)])
    shades = palette[rng.integers(0, 5, count)] * np.exp(rng.normal(0, 0.08, (count, 1)))
    colours = shades.astype(np.float32)[number] * (1 + 0.07 * noise(rng, 0.9, 6))[..., None]
    colours = mix(colours, (126, 124, 100), 0.6 * smoothstep(1.2, 2.0, noise(rng, 1.1, 12)))
    return colours * (1 - 0.35 * dirt_map(rng))[..., None]


def _shingles(rng: np.random.Generator, rows: int, columns: int, rounded: float, fire: bool) -> Texture:
    """Draw overlapping rows of flat tiles, with every other row shifted by half a tile."""
    y, x = texel_grid()
    y = y + 0.8 * noise(rng, 1.4, 6)
    high, wide = SIDE / rows, SIDE / columns
    row = np.floor(y / high)
    shifted = x + wide * np.where(row % 2 > 0, 0.5, 0)
    aside = np.abs(shifted / wide % 1 - 0.5) * 2
    # A rounded end hangs lowest in its middle; the row below shows on both sides of it.
    fall = (y / high) % 1 + rounded * aside**2
    below = fall > 1
    row, fall = row + below, np.where(below, fall - 1, fall)
    shifted = x + wide * np.where(row % 2 > 0, 0.5, 0)
    aside = np.where(below, 0.0, np.abs(shifted / wide % 1 - 0.5) * 2)
    number = ((row % rows) * columns + np.floor(shifted / wide) % columns).astype(int)
    gap = smoothstep(1 - 3.0 / wide, 1 - 1.0 / wide, aside)
    if fire:
        colours = _fired_clay(rng, number, rows * columns)
    else:
        tone = rng.normal(0, 9, rows * columns).astype(np.float32)[number]
        grey = 92 + tone + 5 * noise(rng, 0.9, 4, stretch=(4, 1)) - 22 * dirt_map(rng)
        colours = mix(
            tint_grey(grey, 0.98, 1.05), (132, 132, 112), 0.5 * smoothstep(1.4, 2.2, noise(rng, 1.1, 10))
        )
    shade = (1 - 0.6 * gap) * (1 - 0.55 * smoothstep(0.16, 0.0, fall))
    return stack_texture(blur(colours * shade[..., None], 0.6), fall - 0.5 - 0.5 * gap)
