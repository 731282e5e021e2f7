"""View synthesis from a pair in one call."""

from pathlib import Path

from stereoweave.io.arrays import ImageLike, as_rgb
from stereoweave.matching.backend import Backend
from stereoweave.matching.estimate import match
from stereoweave.matching.options import MatchOptions
from stereoweave.matching.providers import CPU
from stereoweave.rendering.renderer import check_position, render
from stereoweave.stereo import StereoPair, View


def synthesize(  # noqa: PLR0913 - all but the first three are optional
    left: ImageLike,
    right: ImageLike,
    position: float,
    model: str | Path = "best",
    threads: int | None = None,
    *,
    provider: str = CPU,
) -> View:
    """Estimate the refined disparity of a rectified pair and render the view from a position.

    Args:
        left: Left image, as `as_rgb` takes it: path, PIL image, array or tensor.
        right: Right image of the same size.
        position: Position from -1 to 2; 0 is the left camera and 1 the right one.
        model: See `estimate`. The default is the most accurate one, because a new view shows every error at
            an edge. For many views of a pair, estimate once and use a `Renderer`.
        threads: Number of threads; default: all cores.
        provider: See `estimate`.

    Returns:
        The view, which has the same size as the images; `drawn` is False in filled holes.

    Raises:
        ValueError: See `estimate` and `render`. The position is checked before matching.
    """
    check_position(position)
    pair = StereoPair(left=as_rgb(left, "left"), right=as_rgb(right, "right"))
    matcher = Backend(model=model, threads=threads, provider=provider).matcher()
    found = match(matcher, pair, MatchOptions(refined=True))
    return render(pair.left, pair.right, found, position, threads)
