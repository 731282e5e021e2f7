"""Textures of water and clouds."""

import numpy as np

from stereoweave.synth.textures.tiling import Map, Texture, mix, noise, ramp, smoothstep, stack_texture, warp


def water(rng: np.random.Generator) -> Texture:
    """Draw ripples that mostly run in one direction, with rounded troughs and sharp crests."""
    turn = 5 * noise(rng, 2.0, 4), 5 * noise(rng, 2.0, 4)
    length = rng.uniform(1.5, 3)
    waves = [warp(noise(rng, 2.0, cycles, stretch=(1, length)), *turn) for cycles in (7, 16, 36)]
    crests = [0.8 - np.abs(wave) for wave in waves]
    height = 0.55 * crests[0] + 0.35 * crests[1] + 0.2 * crests[2]
    tone = 0.4 + 0.34 * height + 0.05 * noise(rng, 1.4, 2)
    colours = ramp(tone, (20, 33, 38), (34, 52, 56), (84, 103, 104))
    foam = smoothstep(0.75, 0.95, height + 0.1 * noise(rng, 0.8, 20)) * smoothstep(
        0.5, 2.5, noise(rng, 1.4, 3)
    )
    return stack_texture(mix(colours, (150, 160, 158), 0.5 * foam), rng.uniform(0.3, 0.6) * height)


def cumulus(rng: np.random.Generator) -> Texture:
    """Draw the density of cumulus clouds, from 0 (clear) to 255 (dense)."""
    shape = noise(rng, 1.9, 2) + 0.45 * noise(rng, 1.2, 8)
    cover = rng.uniform(-0.5, 0.3)
    heaps = smoothstep(cover, cover + 1.9, shape) ** 0.8
    return _density(heaps * np.clip(0.9 + 0.08 * noise(rng, 1.3, 4), 0, 1))


def cirrus(rng: np.random.Generator) -> Texture:
    """Draw the density of windswept cirrus clouds."""
    turn = 24 * noise(rng, 3.0, 2), 10 * noise(rng, 3.0, 2)
    veil = warp(noise(rng, 1.1, 5, stretch=(1, 9)), *turn)
    patches = smoothstep(-1.2, 1.6, noise(rng, 1.7, 2))
    return _density(np.clip(0.3 + 0.22 * veil + 0.05 * noise(rng, 1.0, 8), 0, 1) * patches)


def overcast(rng: np.random.Generator) -> Texture:
    """Draw the density of an overcast sky with folds and thin patches."""
    folds = warp(noise(rng, 1.6, 3, stretch=(1, 2)), 25 * noise(rng, 1.9, 2), 25 * noise(rng, 1.9, 2))
    return _density(np.clip(0.72 + 0.13 * folds + 0.03 * noise(rng, 1.1, 8), 0, 1))


def _density(share: Map) -> Texture:
    return stack_texture(np.dstack([share] * 3) * 255, np.zeros_like(share))
