"""Histograms of depth of the sets, and how far pixels move from one frame to the next."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from experiments.paper_sets.sets import PaperSet
from stereoweave.bench.metrics import depth_error_m
from stereoweave.data.paper_layout import RANGE_M
from stereoweave.synth.sets.pair_rendering import RenderSpec, SceneRenderer, draw_stage_and_rig
from stereoweave.synth.viewpoints import PosedRig

ALL = "all"
_BINS = 15  # of one metre


@dataclass(frozen=True, kw_only=True)
class DepthRow:
    """Share of the left views' pixels in a range of depth; from 15 m on, depth is unknown to the sets."""

    scene: str
    from_m: float
    to_m: float
    percent: float


@dataclass(frozen=True, kw_only=True)
class SetRow:
    """What the measured frames of a set show.

    Attributes:
        scene: Name of the scene; "all" for the mean of all scenes (of nearest_m, the least).
        pairs: Number of pairs of the set.
        measured: Number of frames that were measured.
        nearest_m: Least depth of all pixels in the left views.
        median_m: Median of the known depths.
        known_percent: Share of the pixels nearer than 15 m.
        target_percent: Least share of the target's pixels in a frame.
        moved_px: Median distance by which known pixels move to the next frame.
        next_cm: Mean error of the next frame's depth map as an estimate of a frame's.
    """

    scene: str
    pairs: int
    measured: int
    nearest_m: float
    median_m: float
    known_percent: float
    target_percent: float
    moved_px: float
    next_cm: float


@dataclass(frozen=True)
class _Look:
    """Measurements of one frame: histogram [15], and the values of a `SetRow`."""

    histogram: Float[np.ndarray, "15"]
    nearest_m: float
    median_m: float
    known_percent: float
    target_percent: float
    moved_px: float
    next_cm: float


def measure_sets(
    sets: Iterable[PaperSet], renderer: SceneRenderer, size_px: tuple[int, int], every: int
) -> tuple[list[SetRow], list[DepthRow]]:
    """Measure every `every`-th frame of each world, and the mean over the sets."""
    rows, depths, histograms = [], [], []
    for one in sets:
        looks = list(_look_at(one.spec(size_px), one.worlds, renderer, every))
        rows.append(_summarise(one, looks))
        histograms.append(np.mean([look.histogram for look in looks], axis=0))
        depths += _histogram_rows(one.scene, histograms[-1])
    rows.append(_average(rows))
    return rows, depths + _histogram_rows(ALL, np.mean(histograms, axis=0))


def moved_px(
    depth_m: Float[np.ndarray, "h w"], before: PosedRig, after: PosedRig
) -> Float[np.ndarray, "h w"]:
    """Return the distance in pixels by which each pixel of a left view moves until the rig is elsewhere.

    Points that are then behind the left camera move by infinity.
    """
    camera = before.camera
    rows, columns = np.mgrid[: depth_m.shape[0], : depth_m.shape[1]]
    x, y = (columns - camera.cx_px) / camera.focal_px, (rows - camera.cy_px) / camera.focal_px
    points_m = np.stack([x * depth_m, y * depth_m, depth_m], -1) @ before.axes + before.position_m
    x_m, y_m, z_m = np.moveaxis((points_m - after.position_m) @ after.axes.T, -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = camera.focal_px * np.hypot(x_m / z_m - x, y_m / z_m - y)
    return np.where(z_m > 0, moved, np.inf)


def _look_at(spec: RenderSpec, worlds: int, renderer: SceneRenderer, every: int) -> Iterator[_Look]:
    for world in range(worlds):
        for frame in range(0, spec.frames - 1, every):
            stage, rig = draw_stage_and_rig(renderer, spec, world, frame)
            _, after = draw_stage_and_rig(renderer, spec, world, frame + 1)
            (view,) = renderer.render_views(stage.world, rig, (0.0,))
            known = view.depth_m < RANGE_M
            truth_m = np.where(known, view.depth_m, np.nan)
            next_m = np.minimum(renderer.depth_m(stage.world, after, 0.0), RANGE_M)
            yield _Look(
                histogram=100 * np.histogram(view.depth_m, _BINS, (0, RANGE_M))[0] / known.size,
                nearest_m=float(view.depth_m.min()),
                median_m=float(np.nanmedian(truth_m)),
                known_percent=100 * float(known.mean()),
                target_percent=100 * float(view.target.mean()),
                moved_px=float(np.median(moved_px(np.where(known, view.depth_m, 1.0), rig, after)[known])),
                next_cm=100 * depth_error_m(next_m, truth_m),
            )


def _summarise(one: PaperSet, looks: list[_Look]) -> SetRow:
    def mean(name: str) -> float:
        return float(np.mean([getattr(look, name) for look in looks]))

    return SetRow(
        scene=one.scene,
        pairs=one.pairs,
        measured=len(looks),
        nearest_m=min(look.nearest_m for look in looks),
        median_m=mean("median_m"),
        known_percent=mean("known_percent"),
        target_percent=min(look.target_percent for look in looks),
        moved_px=mean("moved_px"),
        next_cm=mean("next_cm"),
    )


def _average(rows: list[SetRow]) -> SetRow:
    def mean(name: str) -> float:
        return float(np.mean([getattr(row, name) for row in rows]))

    return SetRow(
        scene=ALL,
        pairs=sum(row.pairs for row in rows),
        measured=sum(row.measured for row in rows),
        nearest_m=min(row.nearest_m for row in rows),
        median_m=mean("median_m"),
        known_percent=mean("known_percent"),
        target_percent=min(row.target_percent for row in rows),
        moved_px=mean("moved_px"),
        next_cm=mean("next_cm"),
    )


def _histogram_rows(scene: str, histogram: Float[np.ndarray, "15"]) -> list[DepthRow]:
    edges_m = np.linspace(0, RANGE_M, _BINS + 1)
    rows = [
        DepthRow(scene=scene, from_m=low, to_m=high, percent=percent)
        for low, high, percent in zip(
            edges_m[:-1].tolist(), edges_m[1:].tolist(), histogram.tolist(), strict=True
        )
    ]
    beyond = 100 - float(histogram.sum())
    return [*rows, DepthRow(scene=scene, from_m=RANGE_M, to_m=float("inf"), percent=beyond)]
