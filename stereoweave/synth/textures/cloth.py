"""Textures of woven, twilled, knitted and checked cloth."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool

from stereoweave.synth.textures.tiling import SIDE, Colour, Map, Texture, noise, stack_texture, texel_grid

_Choice = Bool[np.ndarray, "side side"]
_Rule = Callable[[Map, Map], _Choice]  # whether the warp is on top, given the row and column of the threads


def woven_cloth(rng: np.random.Generator) -> Texture:
    """Draw plain-woven cloth, such as canvas or linen, with threads of uneven thickness."""
    colour = _draw_cloth_colour(rng)
    lift, over = _weave(rng, 64, lambda row, column: (row + column) % 2 > 0)
    thread = np.where(over, noise(rng, 0.8, 4, stretch=(30, 1)), noise(rng, 0.8, 4, stretch=(1, 30)))
    folds = noise(rng, 1.8, 2)
    shade = 0.62 + 0.38 * lift + 0.07 * thread + 0.06 * folds
    return stack_texture(np.array(colour, np.float32) * shade[..., None], 0.8 * lift - 0.5 + 0.1 * folds)


def twill(rng: np.random.Generator) -> Texture:
    """Draw twill of two yarns in a herringbone pattern."""
    colour = np.array(_draw_cloth_colour(rng), np.float32)
    lift, over = _weave(rng, 96, lambda row, column: (np.where(row % 32 < 16, row, -row) + column) % 4 < 2)
    yarn = np.where(over[..., None], colour, 0.55 * colour + 70)
    shade = 0.66 + 0.34 * lift + 0.06 * noise(rng, 1.0, 6) + 0.07 * noise(rng, 1.6, 2)
    return stack_texture(yarn * shade[..., None], 0.8 * lift - 0.5)


def knitted_cloth(rng: np.random.Generator) -> Texture:
    """Draw knitted cloth with columns of V-shaped stitches."""
    y, x = texel_grid()
    y, x = y + 1.5 * noise(rng, 1.6, 4), x + 1.5 * noise(rng, 1.6, 4)
    wide, high = SIDE / 24, SIDE / 32
    side = np.abs((x / wide) % 1 - 0.5) * 2
    leg = (y / high + 0.9 * side) % 1
    lift = np.sqrt(np.clip(np.sin(np.pi * leg) * np.sin(np.pi * np.clip(side, 0, 1)), 0, 1)).astype(
        np.float32
    )
    shade = 0.45 + 0.5 * lift + 0.06 * noise(rng, 0.4) + 0.07 * noise(rng, 1.5, 2)
    rows = (np.floor(y / high) % 32 // 4 % 4 == 0) & (rng.random() < 0.7)
    colour, other = (np.array(_draw_cloth_colour(rng), np.float32) for _ in range(2))
    return stack_texture(np.where(rows[..., None], other, colour) * shade[..., None], lift - 0.5)


def tartan(rng: np.random.Generator) -> Texture:
    """Draw tartan with bands of several colours in both directions, woven as twill."""
    bands = [np.array(_draw_cloth_colour(rng), np.float32) for _ in range(4)]
    widths = rng.integers(2, 14, 10)
    order = np.repeat(rng.integers(0, 4, 10), widths)
    order = np.concatenate([order, order[::-1]])
    index = order[(np.arange(SIDE) * 2 * len(order) // SIDE) % len(order)]
    line = np.stack(bands)[index]
    lift, over = _weave(rng, 128, lambda row, column: (row + column) % 4 < 2)
    colours = np.where(over[..., None], line[None], line[:, None])
    shade = 0.74 + 0.26 * lift + 0.05 * noise(rng, 1.0, 4) + 0.05 * noise(rng, 1.6, 2)
    return stack_texture(colours * shade[..., None], 0.7 * lift - 0.4)


def _draw_cloth_colour(rng: np.random.Generator) -> Colour:
    palette = (
        (122, 118, 108), (150, 138, 118), (88, 92, 104), (74, 82, 92), (116, 84, 74), (132, 110, 84),
        (92, 98, 82), (168, 160, 146), (126, 96, 98), (70, 68, 70), (182, 172, 150), (104, 112, 122),
    )  # fmt: skip
    return palette[rng.integers(len(palette))]


def _weave(rng: np.random.Generator, threads: int, warp_on_top: _Rule) -> tuple[Map, _Choice]:
    """Return the height of a weave in 0..1 and the mask of texels where the warp (along y) is on top."""
    y, x = texel_grid()
    pitch = SIDE / threads
    y, x = y + 0.8 * noise(rng, 1.5, 6), x + 0.8 * noise(rng, 1.5, 6)
    row, column = np.floor(y / pitch) % threads, np.floor(x / pitch) % threads
    over = warp_on_top(row, column)
    along, across = np.where(over, y, x) / pitch % 1, np.where(over, x, y) / pitch % 1
    lift = np.sin(np.pi * across) ** 0.5 * (0.6 + 0.4 * np.sin(np.pi * along))
    return lift.astype(np.float32), over
