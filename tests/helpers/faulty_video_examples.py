"""Shared by the tests of comfort: films of several shots with known defects."""

from pathlib import Path

import cv2
import numpy as np
from video_examples import TEXTURED, Pair, write_side_by_side

from stereoweave.io.images import read_image

WIDTH, HEIGHT = 320, 240
SHIP = Path(__file__).resolve().parents[2] / "examples"


def shot_of(folder: Path, count: int, *, x: int = 100, y: int = 100, step_px: int = 2) -> list[Pair]:
    """Return windows of a pair that move to the right."""
    left, right = (read_image(folder / f"{eye}.png") for eye in ("left", "right"))
    return [
        (
            left[y : y + HEIGHT, start : start + WIDTH].copy(),
            right[y : y + HEIGHT, start : start + WIDTH].copy(),
        )
        for start in range(x, x + count * step_px, step_px)
    ]


def box_at_the_left_border(count: int, box_px: int = 12, seed: int = 1) -> list[Pair]:
    """Return frames of a wall on the screen with a box before it that the left border cuts off.

    The box, of a disparity of `box_px`, is in rows 60 to 179 of the left image's first 80 columns.
    """
    rng = np.random.default_rng(seed)
    wall, box = (
        cv2.resize(rng.integers(0, 256, (size[0] // 6, size[1] // 6, 3), dtype=np.uint8), size[::-1])
        for size in ((HEIGHT, WIDTH), (120, 180))
    )
    left, right = wall.copy(), wall.copy()
    left[60:180, :80] = box[:, 60:140]
    right[60:180, : 80 - box_px] = box[:, 60 + box_px : 140]
    return [(left, right)] * count


def faulty_film(path: Path, count: int = 8) -> Path:
    """Write a film of four shots: sound; swapped; rows 3 px apart and the right eye darker; a box cut off."""
    lower = [
        (left, np.rint(0.6 * np.roll(right, 3, axis=0)).astype(np.uint8))
        for left, right in shot_of(TEXTURED, count, x=220, y=200)
    ]
    swapped = [pair[::-1] for pair in shot_of(SHIP, count)]
    shots = [shot_of(TEXTURED, count), swapped, lower, box_at_the_left_border(count)]
    return write_side_by_side(path, [pair for shot in shots for pair in shot], codec="libx264")
