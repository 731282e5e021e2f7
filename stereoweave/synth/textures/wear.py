"""What years do to all surfaces: dirt, cracks."""

import numpy as np

from stereoweave.synth.textures.tiling import Map, bent, cells, noise, step


def dirt(rng: np.random.Generator) -> Map:
    """0..1, mostly near 0: grime in clouds and in runs."""
    clouds = step(0.2, 2.5, noise(rng, 1.4, 2))
    runs = step(0.5, 2.5, noise(rng, 0.9, 4, stretch=(12, 1)))
    return np.clip(0.7 * clouds + 0.5 * runs, 0, 1)


def crack_lines(rng: np.random.Generator, density: int, sparse: float, width: float = 1.3) -> Map:
    """0..1 along wandering cracks: borders of large cells, of which parts are left out."""
    rim = cells(rng, density, density, 0.5, rough=24).rim
    rim = bent(rim, noise(rng, 1.3, 12), noise(rng, 1.3, 12))
    there = step(sparse - 0.3, sparse + 0.6, noise(rng, 1.8, 2))
    return step(width, 0.3 * width, rim / np.maximum(there, 0.01)) * there
