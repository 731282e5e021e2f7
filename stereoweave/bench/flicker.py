"""What steadying is worth: flicker and errors, frame by frame and steady, on rendered films with noise."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from stereoweave.bench.flicker_films import (
    LEFT,
    MIDDLE,
    NOISE_LEVELS,
    RenderedVideo,
    add_noise,
    add_passing_oval,
    freeze,
    render_panning,
)
from stereoweave.bench.flicker_metrics import flicker
from stereoweave.errors import StereoweaveError
from stereoweave.matching.backend import Backend
from stereoweave.matching.providers import CPU
from stereoweave.rendering.renderer import Renderer
from stereoweave.stereo import Estimate, StereoPair
from stereoweave.synth.sets.pair_rendering import RenderSpec
from stereoweave.video.temporal_filter import Steadier

MEAN = "mean"
FRAME_BY_FRAME, STEADY = "frame by frame", "steady"
# Five seconds of a camera on its way.
_PATH_FRAMES = 120


@dataclass(frozen=True, kw_only=True)
class FlickerRow:
    """How one method did on one film. Errors are means over all such pixels from the second frame on.

    Attributes:
        noise_levels: The noise's standard deviation, 0 to 255.
        flicker_px: Of the left view's disparity (flicker.py).
        view_flicker_levels: Of the view half-way, 0 to 255, painted from the pictures without their noise, so
            that disparity alone makes it flicker.
        epe_px: End-point error of the left view.
        moving_epe_px: On the pixels of the thing that moves; NaN without one.
        uncovered_epe_px: On the pixels that show what the frame before did not; NaN without such.
        time_ms: Of steadying a frame, the median; NaN without.
    """

    film: str
    scene: str
    model: str
    method: str
    width_px: int
    height_px: int
    frames: int
    noise_levels: float
    flicker_px: float
    view_flicker_levels: float
    epe_px: float
    moving_epe_px: float
    uncovered_epe_px: float
    time_ms: float


class _Result(NamedTuple):
    """What a method made of a film."""

    disparities_px: list[Float[np.ndarray, "h w"]]
    views: list[UInt8[np.ndarray, "h w 3"]]
    time_ms: float


def score_flicker(  # noqa: PLR0913 - each is a word of the command line
    scenes: Sequence[str],
    model: str | Path = "small",
    *,
    frames: int = 12,
    size_px: tuple[int, int] = (640, 480),
    seed: int = 0,
    threads: int | None = None,
    provider: str = CPU,
) -> Iterator[FlickerRow]:
    """Two rows, frame by frame and steady, of each of four films of each scene.

    Args:
        scenes: Names as `stereoweave synth make` takes them.
        model: As for `Matcher`, and so is `threads`.
        frames: Of each film, 2 or more.
        size_px: Width and height.
        seed: Of the scenes and of the noise.
        threads: How many may be used; all cores if left out.
        provider: As for `Matcher`.

    Raises:
        StereoweaveError: A scene or the model is unknown, or there are too few frames.
    """
    if frames < 2:
        raise StereoweaveError(f"frames: expected 2 or more, for flicker is between two; got {frames}")
    orders = [RenderSpec(scene=scene, seed=seed, size_px=size_px, frames=_PATH_FRAMES) for scene in scenes]
    matcher = Backend(model=model, threads=threads, provider=provider).matcher()
    for order in orders:
        for film in _render_videos(order, frames):
            pairs = [
                add_noise(pair, np.random.default_rng((seed, number)))
                for number, pair in enumerate(film.pairs)
            ]
            estimates = [matcher.estimate(pair.left, pair.right) for pair in pairs]
            for method, taken in _run_methods(film, pairs, estimates, threads).items():
                yield FlickerRow(
                    film=film.name,
                    scene=order.scene,
                    model=str(model),
                    method=method,
                    width_px=size_px[0],
                    height_px=size_px[1],
                    frames=frames,
                    noise_levels=NOISE_LEVELS,
                    time_ms=taken.time_ms,
                    **_measure_errors(film, taken),
                )


def average_rows(rows: Sequence[FlickerRow]) -> list[FlickerRow]:
    """The mean over the scenes of each film and method, the two in one name."""
    groups: dict[tuple[str, str], list[FlickerRow]] = {}
    for row in rows:
        groups.setdefault((row.film, row.method), []).append(row)
    return [_average_group(", ".join(name), group) for name, group in groups.items()]


def _average_group(name: str, rows: Sequence[FlickerRow]) -> FlickerRow:
    numbers = ("flicker_px", "view_flicker_levels", "epe_px", "moving_epe_px", "uncovered_epe_px", "time_ms")
    values: dict[str, Any] = {n: float(np.mean([getattr(row, n) for row in rows])) for n in numbers}
    return replace(rows[0], film=name, scene=MEAN, **values)


def _render_videos(order: RenderSpec, frames: int) -> Iterator[RenderedVideo]:
    pan = render_panning(order, frames)
    yield freeze(pan)
    yield add_passing_oval(pan, "passing", (3.25, 0.75))
    yield add_passing_oval(pan, "nearing", (0.25, 0.0), nearing_px=0.5)
    yield pan


def _run_methods(
    film: RenderedVideo, pairs: list[StereoPair], estimates: list[Estimate], threads: int | None
) -> dict[str, _Result]:
    steadier, steady, times_ms = Steadier(threads), [], []
    for pair, estimate in zip(pairs, estimates, strict=True):
        start_s = time.perf_counter()
        steady.append(steadier(pair.left, pair.right, estimate))
        times_ms.append(1000 * (time.perf_counter() - start_s))
    return {
        FRAME_BY_FRAME: _Result(*_render_middle(film, estimates, threads), float("nan")),
        STEADY: _Result(*_render_middle(film, steady, threads), float(np.median(times_ms[1:]))),
    }


def _render_middle(
    film: RenderedVideo, estimates: list[Estimate], threads: int | None
) -> tuple[list[Float[np.ndarray, "h w"]], list[UInt8[np.ndarray, "h w 3"]]]:
    """The disparities of the left view, and the views half-way: of the film itself, without the noise."""
    renderers = (
        Renderer(pair, estimate, threads=threads)
        for pair, estimate in zip(film.pairs, estimates, strict=True)
    )
    views = [renderer.view(MIDDLE).image for renderer in renderers]
    return [estimate.disparity_px for estimate in estimates], views


def _measure_errors(film: RenderedVideo, taken: _Result) -> dict[str, float]:
    """The columns of a row that are errors."""
    later = range(1, len(film.pairs))

    def mean_flicker(shown: list[np.ndarray], position: float, with_change: bool) -> float:
        of_frames = []
        for frame in later:
            motion_px, change_px = film.change(frame - 1, frame, position)
            visible = film.seen_again(frame - 1, frame, position)
            true_change = change_px if with_change else 0.0
            of_frames.append(flicker(shown[frame - 1], shown[frame], motion_px, visible, true_change))
        return float(np.mean(of_frames))

    errors_px = np.abs([taken.disparities_px[frame] - film.disparities_px[frame][LEFT] for frame in later])
    uncovered = ~np.array([film.seen_again(frame, frame - 1, LEFT) for frame in later])
    return {
        "flicker_px": mean_flicker(taken.disparities_px, LEFT, with_change=True),
        "view_flicker_levels": mean_flicker(taken.views, MIDDLE, with_change=False),
        "epe_px": float(errors_px.mean()),
        "moving_epe_px": _mean(errors_px, np.array(film.moving[1:])),
        "uncovered_epe_px": _mean(errors_px, uncovered),
    }


def _mean(values: Float[np.ndarray, "n h w"], where: Bool[np.ndarray, "n h w"]) -> float:
    return float(values[where].mean()) if where.any() else float("nan")
