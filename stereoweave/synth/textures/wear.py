"""Wear common to all surfaces: dirt and cracks."""

import numpy as np

from stereoweave.synth.textures.tiling import Map, noise, smoothstep, voronoi_cells, warp


def dirt_map(rng: np.random.Generator) -> Map:
    """Return a map of smudges and streaks of dirt, with values in 0..1 that are mostly near 0."""
    clouds = smoothstep(0.2, 2.5, noise(rng, 1.4, 2))
    runs = smoothstep(0.5, 2.5, noise(rng, 0.9, 4, stretch=(12, 1)))
    return np.clip(0.7 * clouds + 0.5 * runs, 0, 1)


def crack_map(rng: np.random.Generator, density: int, sparse: float, width: float = 1.3) -> Map:
    """Return a map, with values in 0..1, of cracks along parts of the warped borders of large cells."""
    rim = voronoi_cells(rng, density, density, 0.5, rough=24).rim
    rim = warp(rim, noise(rng, 1.3, 12), noise(rng, 1.3, 12))
    there = smoothstep(sparse - 0.3, sparse + 0.6, noise(rng, 1.8, 2))
    return smoothstep(width, 0.3 * width, rim / np.maximum(there, 0.01)) * there
