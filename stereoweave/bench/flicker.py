"""Benchmark of steadiness on noisy rendered videos: flicker and errors of three methods."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stereoweave.bench.edge_metrics import NEAR_PX, near_edge
from stereoweave.bench.flicker_metrics import find_thin, flicker, jumps_share
from stereoweave.bench.flicker_videos import (
    LEFT,
    MIDDLE,
    NOISE_LEVELS,
    RenderedVideo,
    add_noise,
    add_passing_oval,
    expose,
    freeze,
    render_panning,
)
from stereoweave.errors import StereoweaveError
from stereoweave.matching.backend import Backend
from stereoweave.matching.providers import CPU
from stereoweave.rendering.renderer import Renderer
from stereoweave.stereo import Estimate, StereoPair
from stereoweave.synth.sets.pair_rendering import RenderSpec
from stereoweave.system.threads import thread_count
from stereoweave.video.carried_frames import carry_depth
from stereoweave.video.frame_groups import MATCHED_EVERY, FrameGroup
from stereoweave.video.reader import StereoFrame
from stereoweave.video.temporal_filter import TemporalFilter

MEAN = "mean"
FRAME_BY_FRAME, STEADY, CARRIED = "frame by frame", "steady", "carried"
# Length of the whole camera path: five seconds.
_PATH_FRAMES = 120
_BAD_PX = 2.0
# Brightness of a flash, and of the last frame of a fade, as multiples.
_FLASH, _FADED = 1.8, 0.3


@dataclass(frozen=True, kw_only=True)
class FlickerRow:
    """Scores of one method on one video. Errors are means over the pixels of all frames but the first.

    Attributes:
        film: The video's name.
        noise_levels: Standard deviation of the image noise, in levels of 0..255.
        flicker_px: Flicker of the left view's disparity (flicker_metrics.py).
        jumps_share: Share of the left view's points whose disparity jumps between two frames.
        view_flicker_levels: Flicker of the middle view, in levels of 0..255. The view is rendered from the
            noise-free images, so it flickers only if the disparity flickers.
        epe_px: End-point error of the left view.
        moving_epe_px: End-point error on the moving object; NaN if there is none.
        outline_epe_px: End-point error within 3 px of the moving object's outline; NaN if there is none.
        uncovered_epe_px: End-point error at points that the previous frame did not show; NaN if there are
            none.
        edge_epe_px: End-point error within 3 px of a depth edge (edge_metrics.py); NaN if there are none.
        thin_epe_px: End-point error on thin things (`find_thin`); NaN if there are none.
        bad2_percent: Percentage of the pixels that are off by more than 2 px.
        time_ms: Mean time per frame of the temporal filter, and of carrying depth; NaN if neither is used.
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
    jumps_share: float
    view_flicker_levels: float
    epe_px: float
    moving_epe_px: float
    outline_epe_px: float
    uncovered_epe_px: float
    edge_epe_px: float
    thin_epe_px: float
    bad2_percent: float
    time_ms: float


_COLUMNS = [field.name for field in fields(FlickerRow)]
_SCORES = _COLUMNS[_COLUMNS.index("flicker_px") :]


class _MethodOutput(NamedTuple):
    """Output of one method for one video."""

    disparities_px: list[Float[np.ndarray, "h w"]]
    views: list[UInt8[np.ndarray, "h w 3"]]
    time_ms: float


def score_flicker(  # noqa: PLR0913 - each is an option of the command line
    scenes: Sequence[str],
    model: str | Path = "small",
    *,
    frames: int = 12,
    size_px: tuple[int, int] = (640, 480),
    seed: int = 0,
    threads: int | None = None,
    provider: str = CPU,
) -> Iterator[FlickerRow]:
    """Yield three rows for each of the six videos of each scene.

    They are without the temporal filter, with it, and with depth carried between matched frames, as in a
    conversion.

    Args:
        scenes: Scene names, as for `stereoweave synth make`.
        model: See `Matcher`.
        frames: Frames per video, at least 2.
        size_px: Width and height of a frame.
        seed: Seed of the scenes and the noise.
        threads: Number of CPU threads. Default: all cores.
        provider: See `Matcher`.

    Raises:
        StereoweaveError: If a scene or the model is unknown, or there are too few frames.
    """
    if frames < 2:
        raise StereoweaveError(
            f"frames: expected at least 2, because flicker is a change between frames, found {frames}"
        )
    specs = [RenderSpec(scene=scene, seed=seed, size_px=size_px, frames=_PATH_FRAMES) for scene in scenes]
    matcher = Backend(model=model, threads=threads, provider=provider).matcher()
    for spec in specs:
        for video in _render_videos(spec, frames):
            pairs = [
                add_noise(expose(pair, gain), np.random.default_rng((seed, number)))
                for number, (pair, gain) in enumerate(zip(video.pairs, video.gains, strict=True))
            ]
            estimates = [matcher.estimate(pair.left, pair.right) for pair in pairs]
            for method, result in _run_methods(video, pairs, estimates, threads).items():
                yield FlickerRow(
                    film=video.name,
                    scene=spec.scene,
                    model=str(model),
                    method=method,
                    width_px=size_px[0],
                    height_px=size_px[1],
                    frames=frames,
                    noise_levels=NOISE_LEVELS,
                    time_ms=result.time_ms,
                    **_measure_errors(video, result),
                )


def average_rows(rows: Sequence[FlickerRow]) -> list[FlickerRow]:
    """Return a mean row over the scenes for each video and method, with both names joined in `film`."""
    groups: dict[tuple[str, str], list[FlickerRow]] = {}
    for row in rows:
        groups.setdefault((row.film, row.method), []).append(row)
    return [_average_group(", ".join(name), group) for name, group in groups.items()]


def _average_group(name: str, rows: Sequence[FlickerRow]) -> FlickerRow:
    """Return the mean row over the scenes. Scenes without a score, such as on thin things, do not count."""
    values: dict[str, Any] = {}
    for column in _SCORES:
        scores = np.array([getattr(row, column) for row in rows])
        values[column] = _mean(scores, np.isfinite(scores))
    return replace(rows[0], film=name, scene=MEAN, **values)


def _render_videos(spec: RenderSpec, frames: int) -> Iterator[RenderedVideo]:
    pan = render_panning(spec, frames)
    yield freeze(pan)
    yield add_passing_oval(pan, "passing", (3.25, 0.75))
    yield add_passing_oval(pan, "nearing", (0.25, 0.0), nearing_px=0.5)
    yield pan
    # The flash is in a frame that is matched where every third one is.
    middle = frames // 2 // MATCHED_EVERY * MATCHED_EVERY
    flash = [_FLASH if frame == middle else 1.0 for frame in range(frames)]
    yield replace(pan, name="flash", gains=flash)
    yield replace(pan, name="fade", gains=np.linspace(1, _FADED, frames).tolist())


def _run_methods(
    video: RenderedVideo, pairs: list[StereoPair], estimates: list[Estimate], threads: int | None
) -> dict[str, _MethodOutput]:
    steady, steady_ms = _steady(_group_frames(pairs, 1), estimates, threads)
    carried, carried_ms = _steady(_group_frames(pairs, MATCHED_EVERY), estimates, threads)
    return {
        FRAME_BY_FRAME: _MethodOutput(*_render_middle(video, estimates, threads), float("nan")),
        STEADY: _MethodOutput(*_render_middle(video, steady, threads), steady_ms),
        CARRIED: _MethodOutput(*_render_middle(video, carried, threads), carried_ms),
    }


def _group_frames(pairs: list[StereoPair], size: int) -> list[FrameGroup]:
    """Return groups of a number of frames, after the first frame alone."""
    frames = [StereoFrame(pair.left, pair.right, Fraction(n), None) for n, pair in enumerate(pairs)]
    starts = [0, *range(1, len(pairs), size)]
    return [FrameGroup(frames[start:end], pairs[start:end]) for start, end in pairwise([*starts, len(pairs)])]


def _steady(
    groups: list[FrameGroup], estimates: list[Estimate], threads: int | None
) -> tuple[list[Estimate], float]:
    """Return the steady estimates of all frames, and the mean time per frame in milliseconds."""
    matched = ((group, estimates[int(group.frames[-1].time)]) for group in groups)
    found, times_ms, start_s = list[Estimate](), list[float](), time.perf_counter()
    for estimated in carry_depth(matched, TemporalFilter(threads), thread_count(threads)):
        times_ms.append(1000 * (time.perf_counter() - start_s))
        start_s = time.perf_counter()
        found.append(estimated.estimate)
    # The first frame has no predecessor.
    return found, float(np.mean(times_ms[1:]))


def _render_middle(
    video: RenderedVideo, estimates: list[Estimate], threads: int | None
) -> tuple[list[Float[np.ndarray, "h w"]], list[UInt8[np.ndarray, "h w 3"]]]:
    """Return the left views' disparities, and the middle views rendered without noise and exposure."""
    renderers = (
        Renderer(pair, estimate, threads=threads)
        for pair, estimate in zip(video.pairs, estimates, strict=True)
    )
    views = [renderer.view(MIDDLE).image for renderer in renderers]
    return [estimate.disparity_px for estimate in estimates], views


def _measure_errors(video: RenderedVideo, result: _MethodOutput) -> dict[str, float]:
    """Return the error columns of a row."""
    later = range(1, len(video.pairs))

    def mean_over_frames(
        measure: Callable[..., float], shown: list[np.ndarray], position: float, with_change: bool
    ) -> float:
        per_frame = []
        for frame in later:
            motion_px, change_px = video.change(frame - 1, frame, position)
            visible = video.find_seen_again(frame - 1, frame, position)
            true_change = change_px if with_change else 0.0
            per_frame.append(measure(shown[frame - 1], shown[frame], motion_px, visible, true_change))
        return float(np.mean(per_frame))

    truths_px = np.array([video.disparities_px[frame][LEFT] for frame in later])
    errors_px = np.abs(np.array(result.disparities_px[1:]) - truths_px)
    uncovered = ~np.array([video.find_seen_again(frame, frame - 1, LEFT) for frame in later])
    return {
        "flicker_px": mean_over_frames(flicker, result.disparities_px, LEFT, with_change=True),
        "jumps_share": mean_over_frames(jumps_share, result.disparities_px, LEFT, with_change=True),
        "view_flicker_levels": mean_over_frames(flicker, result.views, MIDDLE, with_change=False),
        "epe_px": float(errors_px.mean()),
        "moving_epe_px": _mean(errors_px, np.array(video.moving[1:])),
        "outline_epe_px": _mean(errors_px, np.array([*map(_find_outline, video.moving[1:])])),
        "uncovered_epe_px": _mean(errors_px, uncovered),
        "edge_epe_px": _mean(errors_px, np.array([*map(near_edge, truths_px)])),
        "thin_epe_px": _mean(errors_px, np.array([*map(find_thin, truths_px)])),
        "bad2_percent": 100 * float((errors_px > _BAD_PX).mean()),
    }


def _find_outline(moving: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the mask of the pixels within three pixels of a moving object's outline."""
    window = np.ones((2 * NEAR_PX + 1, 2 * NEAR_PX + 1), np.uint8)
    return cv2.morphologyEx(moving.astype(np.uint8), cv2.MORPH_GRADIENT, window) > 0


def _mean(values: Float[np.ndarray, "*n"], where: Bool[np.ndarray, "*n"]) -> float:
    return float(values[where].mean()) if where.any() else float("nan")
