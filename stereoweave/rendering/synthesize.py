"""A pair becomes a new view in one call."""

from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from stereoweave.matching.estimate import estimate
from stereoweave.matching.providers import CPU
from stereoweave.rendering.renderer import check_position, render
from stereoweave.stereo import View


def synthesize(  # noqa: PLR0913 - all but the first three can be left out
    left: UInt8[np.ndarray, "h w 3"],
    right: UInt8[np.ndarray, "h w 3"],
    position: float,
    model: str | Path = "base",
    threads: int | None = None,
    *,
    provider: str = CPU,
) -> View:
    """The view from a position on the line through two cameras: `estimate`, refined, then `render`.

    Args:
        left: The left photograph, uint8 RGB [H, W, 3], rectified.
        right: The right one, of the same size.
        position: 0 is the left camera, 1 the right one; -1 to 2.
        model: As for `estimate`; by default the exact one, because a new view shows every error at an edge.
        threads: How many threads may be used; all cores if left out.
        provider: As for `estimate`.

    Returns:
        The view, of the photographs' size; `drawn` is False where the colour was invented.

    Raises:
        ValueError: As `estimate` and `render`; a position out of its range before anything is matched.
    """
    check_position(position)
    found = estimate(left, right, model=model, threads=threads, provider=provider, refined=True)
    return render(left, right, found, position, threads)
