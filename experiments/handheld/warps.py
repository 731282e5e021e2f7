"""Distortions beyond those of usual cameras: wide lenses, rolling shutters and warped prints."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from experiments.handheld.pairs import SEED, HandheldPair
from stereoweave.stereo import StereoPair

# Maps places in the distorted picture to places in the original one.
Source = Callable[[Float[np.ndarray, "n 2"]], Float[np.ndarray, "n 2"]]
_INVERSION_STEPS, _INVERSION_STEP = 80, 0.7
_STRENGTHS = (0.15, 0.3, 0.45)
_MOVED_PX, _WAVES = 3.0, 3


def wide_lens(size: tuple[int, int], strength: float) -> Source:
    """Return the mapping of a lens with barrel distortion that keeps the corners in place."""
    centre_px = (np.array(size) - 1) / 2
    radius_px = np.hypot(*size) / 2

    def source(places_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        away = (places_px - centre_px) / radius_px
        squares = (away**2).sum(1, keepdims=True)
        return centre_px + radius_px * away * (1 - strength) / (1 - strength * squares)

    return source


def rolling_shutter(size: tuple[int, int], sway_px: float, phase: float = 0.0) -> Source:
    """Return the mapping of a camera that nodded while the rows were read one after the other."""
    height = size[1]

    def source(places_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        moved_px = places_px.copy()
        moved_px[:, 1] += sway_px * np.sin(2 * np.pi * places_px[:, 1] / height + phase)
        return moved_px

    return source


def warped_print(size: tuple[int, int], moved_px: float, rng: np.random.Generator) -> Source:
    """Return the mapping of an old print: a few random waves in both directions, of this amplitude in all."""
    waves = rng.uniform(-1.5, 1.5, (2, _WAVES, 2)) * 2 * np.pi / np.array(size)
    phases = rng.uniform(0, 2 * np.pi, (2, _WAVES))

    def source(places_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        moves = [np.sin(places_px @ waves[axis].T + phases[axis]).mean(1) for axis in (0, 1)]
        return places_px + moved_px * np.column_stack(moves)

    return source


def warp_in_each_way(made: HandheldPair, index: int) -> Iterator[tuple[str, HandheldPair]]:
    """Yield the name of each distortion, and the pair with both pictures distorted by it.

    Args:
        made: The pair.
        index: Number of the pair; together with the seed, it determines all random numbers.
    """
    rng = np.random.default_rng((SEED, index, 1))
    size = made.pair.left.shape[1], made.pair.left.shape[0]
    for strength in _STRENGTHS:
        lens = wide_lens(size, strength)
        yield f"wide_lens_{strength:g}", distort(made, lens, lens)
    sways = (rolling_shutter(size, _MOVED_PX, rng.uniform(0, 2 * np.pi)) for _ in range(2))
    yield "rolling_shutter", distort(made, *sways)
    yield "warped_print", distort(made, *(warped_print(size, _MOVED_PX, rng) for _ in range(2)))


def distort(made: HandheldPair, left: Source, right: Source) -> HandheldPair:
    """Return the pair with its pictures distorted by these mappings, and the places that both still show."""
    left_px, right_px = invert(made.left_px, left), invert(made.right_px, right)
    height, width = made.pair.left.shape[:2]
    both_px = np.hstack([left_px, right_px])
    inside = ((both_px >= 0) & (both_px <= np.tile([width - 1, height - 1], 2))).all(1)
    return replace(
        made,
        pair=StereoPair(left=remap(made.pair.left, left), right=remap(made.pair.right, right)),
        left_px=left_px[inside],
        right_px=right_px[inside],
    )


def remap(image: UInt8[np.ndarray, "h w 3"], source: Source) -> UInt8[np.ndarray, "h w 3"]:
    """Return the distorted picture, which repeats the original's border."""
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    places_px = source(np.column_stack([columns.ravel(), rows.ravel()]).astype(float)).astype(np.float32)
    x, y = (places_px[:, axis].reshape(rows.shape) for axis in (0, 1))
    return cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def invert(places_px: Float[np.ndarray, "n 2"], source: Source) -> Float[np.ndarray, "n 2"]:
    """Return where the distorted picture shows these places of the original one."""
    found_px = places_px.copy()
    for _ in range(_INVERSION_STEPS):
        found_px += _INVERSION_STEP * (places_px - source(found_px))
    return found_px
