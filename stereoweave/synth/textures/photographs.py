"""Tileable textures cut from scikit-image's photographs."""

import functools

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from stereoweave.synth.textures.tiling import SIDE, Texture, blur, stack_texture

# A crop is larger than its texture by this margin, which is blended into the opposite side.
_OVERLAP = SIDE // 4


def photograph_crop(name: str, rng: np.random.Generator) -> Texture:
    """Return a random crop of one of scikit-image's photographs; brighter texels are slightly higher."""
    part = _mute(rng, _draw_crop(rng, _load_photograph(name)))
    rows = _blend_ends(part)
    colours = _blend_ends(rows.transpose(1, 0, 2)).transpose(1, 0, 2)
    grey = colours.mean(-1)
    return stack_texture(colours, (grey - blur(grey, 24)) / 160)


@functools.cache
def _load_photograph(name: str) -> UInt8[np.ndarray, "_ _ 3"]:
    from skimage import data

    picture = getattr(data, name)()
    return np.dstack([picture] * 3) if picture.ndim == 2 else picture


def _draw_crop(
    rng: np.random.Generator, photograph: UInt8[np.ndarray, "_ _ 3"]
) -> Float[np.ndarray, "_ _ 3"]:
    height, width = photograph.shape[:2]
    side = int(min(height, width) * rng.uniform(0.55, 1))
    y, x = rng.integers(height - side + 1), rng.integers(width - side + 1)
    wanted = SIDE + _OVERLAP
    way = cv2.INTER_AREA if side > wanted else cv2.INTER_CUBIC
    part = cv2.resize(photograph[y : y + side, x : x + side], (wanted, wanted), interpolation=way)
    return part[:, :: rng.choice([-1, 1])].astype(np.float32)


def _mute(rng: np.random.Generator, part: Float[np.ndarray, "_ _ 3"]) -> Float[np.ndarray, "_ _ 3"]:
    """Reduce the saturation, as in a faded print, and add a slight tint."""
    grey = part.mean(-1, keepdims=True)
    warm = rng.normal(0, 0.03)
    return (grey + rng.uniform(0.3, 0.5) * (part - grey)) * np.array([1 + warm, 1, 1 - warm], np.float32)


def _blend_ends(part: Float[np.ndarray, "_ _ 3"]) -> Float[np.ndarray, "_ _ 3"]:
    """Return the first SIDE rows, made tileable.

    The remaining rows are blended into the first rows.
    """
    share = np.linspace(0, 1, _OVERLAP, dtype=np.float32)[:, None, None]
    share = share * share * (3 - 2 * share)
    rows = part[:SIDE].copy()
    rows[:_OVERLAP] = part[SIDE:] + share * (rows[:_OVERLAP] - part[SIDE:])
    return rows
