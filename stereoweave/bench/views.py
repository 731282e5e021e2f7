"""Scores of new views against reference images from the same position, by method and by kind of pixel.

The methods see only the two input images. If both true disparities are known, pixels are classified by the
ground truth of the view at the reference's nominal position (view_truth.py):

    smooth    known disparity, more than three pixels from any depth edge
    edge      known disparity, within three pixels of a depth edge (edge_metrics.py)
    one       smooth or edge, and seen by only one of the two cameras
    neither   seen by neither camera, and therefore of unknown disparity
"""

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stereoweave.bench.edge_metrics import near_edge
from stereoweave.bench.metrics import mae, psnr_db, ssim
from stereoweave.bench.opencv_matchers import OPENCV_MATCHERS, SGBM, fill_rows, left_right_confidence
from stereoweave.bench.pairs import TURNS, SceneLister, merge_machines, score_all
from stereoweave.bench.tables import MEAN
from stereoweave.bench.view_scenes import ReferenceView, ViewScene
from stereoweave.bench.view_truth import fill_unknown, find_view_truth
from stereoweave.data.samples import find_occluded
from stereoweave.rendering.renderer import Renderer
from stereoweave.stereo import Estimate, Sample, StereoPair
from stereoweave.system.ray_engine import Engine

Estimator = Callable[[StereoPair], Estimate]
"""Returns the estimate of a pair, from which views are rendered."""

Viewer = Callable[[float], UInt8[np.ndarray, "h w 3"]]
"""Returns one method's view of one scene from a position."""

_BEHIND_ALL_PX = -1e9
NEAREST, CROSS_FADE, GROUND_TRUTH = "nearest photograph", "cross-fade", "ground truth"


@dataclass(frozen=True, kw_only=True)
class ViewScoreRow:
    """Scores of one method's view of a scene from one position against the reference image.

    In a method's mean row (scene "mean", position NaN), each score is averaged first over the positions of a
    scene, then over the scenes; NaN scores are left out.

    Attributes:
        psnr_db, ssim, mae: Scores over all pixels; mae is in levels of 0..255.
        smooth_psnr_db, edge_psnr_db, one_psnr_db, neither_psnr_db: PSNR over the pixels of one kind (see
            views.py); NaN if there are none or the truth is unknown.
        smooth_mae, edge_mae, one_mae, neither_mae: Mean absolute error over the same pixels.
        time_ms: Median time per view, excluding the matching of the pair.
    """

    scene: str
    position: float
    method: str
    psnr_db: float
    ssim: float
    mae: float
    smooth_psnr_db: float
    smooth_mae: float
    edge_psnr_db: float
    edge_mae: float
    one_psnr_db: float
    one_mae: float
    neither_psnr_db: float
    neither_mae: float
    time_ms: float


class ViewScores(NamedTuple):
    """A row per scene, position and method, then a mean row per method, and the machine's description."""

    rows: list[ViewScoreRow]
    machine: dict[str, str]


def score_view_scenes(
    networks: Mapping[str, Callable[[], Estimator]],
    scenes: SceneLister[ViewScene],
    threads: int | None = None,
    engine: Engine | None = None,
) -> ViewScores:
    """Score the views of several methods against reference images.

    Every table has four baselines. "nearest photograph" and "cross-fade", the weighted mean of both images,
    need no disparity. "sgbm" uses the disparity of OpenCV's matcher. "ground truth" uses the true disparity
    of both views, where known, and is an upper bound. The disparities of these two baselines are filled along
    rows, and views are rendered as for the networks' estimates.

    Args:
        networks: Factories of further methods, by name.
        scenes: Function that lists at least one scene.
        threads: Number of threads for rendering. Default: all cores.
        engine: See `score_pairs`, also for the errors raised.
    """
    found = score_all(networks, scenes, partial(_score_scene, threads), engine)
    rows = [row for scene in found for row in scene.result]
    methods = dict.fromkeys(row.method for row in rows)
    means = [_average_rows(method, [row for row in rows if row.method == method]) for method in methods]
    return ViewScores(rows + means, merge_machines(found))


def shift_image(
    image: UInt8[np.ndarray, "h w 3"], offset_px: tuple[float, float]
) -> UInt8[np.ndarray, "h w 3"]:
    """Shift an image's content to the right and down by offset_px; an offset of zero changes nothing."""
    if offset_px == (0, 0):
        return image
    shift = np.array([[1, 0, offset_px[0]], [0, 1, offset_px[1]]], np.float32)
    size = image.shape[1], image.shape[0]
    return cv2.warpAffine(image, shift, size, flags=cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)


def _score_scene(
    threads: int | None, networks: Mapping[str, Estimator], scene: ViewScene
) -> list[ViewScoreRow]:
    viewers = _make_viewers(networks, scene.sample, threads)
    rows = []
    for true in scene.views:
        # These first calls warm up the renderer before timing.
        images = {method: viewer(true.position) for method, viewer in viewers.items()}
        times_ms = _measure_times_ms(viewers, true.position)
        kinds = _classify_pixels(scene.sample, true.position)
        rows += [
            ViewScoreRow(
                scene=scene.name,
                position=true.position,
                method=method,
                time_ms=times_ms[method],
                **_measure_errors(shift_image(image, true.offset_px), true, kinds),
            )
            for method, image in images.items()
        ]
    return rows


def _make_viewers(
    networks: Mapping[str, Estimator], sample: Sample, threads: int | None
) -> dict[str, Viewer]:
    pair = StereoPair(left=sample.left, right=sample.right, camera=sample.camera)
    estimates = {SGBM: _estimate_by_sgbm(pair)}
    if _has_truth(sample):
        estimates[GROUND_TRUTH] = _estimate_from_truth(sample)
    estimates |= {name: match(pair) for name, match in networks.items()}
    rendered = {
        name: partial(_render_view, Renderer(pair, estimate, threads=threads))
        for name, estimate in estimates.items()
    }
    return {NEAREST: partial(_pick_nearest, pair), CROSS_FADE: partial(_cross_fade, pair), **rendered}


def _pick_nearest(pair: StereoPair, position: float) -> UInt8[np.ndarray, "h w 3"]:
    return pair.left if position < 0.5 else pair.right


def _cross_fade(pair: StereoPair, position: float) -> UInt8[np.ndarray, "h w 3"]:
    share = min(max(position, 0.0), 1.0)
    return np.round(pair.left * (1 - share) + pair.right * share).astype(np.uint8)


def _render_view(renderer: Renderer, position: float) -> UInt8[np.ndarray, "h w 3"]:
    return renderer.view(position).image


def _estimate_by_sgbm(pair: StereoPair) -> Estimate:
    """Match both views with SGBM, fill holes along rows, and take confidence from the left-right check."""
    match = OPENCV_MATCHERS[SGBM]()
    left_px, mirrored_px = match(pair), match(pair.mirror())
    filled_px, right_filled_px = fill_rows(left_px), fill_rows(mirrored_px)[:, ::-1]
    return Estimate(
        disparity_px=filled_px,
        right_disparity_px=right_filled_px,
        # The same formula as in `Matcher` for a network without a confidence output.
        confidence=np.exp(left_right_confidence(left_px, mirrored_px[:, ::-1])),
        occluded=find_occluded(filled_px, right_filled_px),
    )


def _estimate_from_truth(sample: Sample) -> Estimate:
    return Estimate(
        disparity_px=fill_unknown(sample.disparity_px),
        right_disparity_px=fill_unknown(sample.right_disparity_px),
        confidence=np.isfinite(sample.disparity_px).astype(np.float32),
        occluded=sample.occluded,
    )


def _has_truth(sample: Sample) -> bool:
    return all(np.isfinite(side_px).any() for side_px in (sample.disparity_px, sample.right_disparity_px))


def _classify_pixels(sample: Sample, position: float) -> dict[str, Bool[np.ndarray, "h w"]]:
    """Return masks by kind of pixel, named as in the column prefixes; all False if the truth is unknown."""
    if not _has_truth(sample):
        return dict.fromkeys(("smooth", "edge", "one", "neither"), np.zeros(sample.left.shape[:2], bool))
    truth = find_view_truth(sample, position)
    known = np.isfinite(truth.disparity_px)
    # Areas that neither camera sees lie behind their surroundings.
    near = near_edge(np.where(truth.none_sees, _BEHIND_ALL_PX, truth.disparity_px))
    return {"smooth": known & ~near, "edge": known & near, "one": truth.one_sees, "neither": truth.none_sees}


def _measure_errors(
    image: UInt8[np.ndarray, "h w 3"], true: ReferenceView, kinds: Mapping[str, Bool[np.ndarray, "h w"]]
) -> dict[str, float]:
    """Return the score columns that compare the image with the reference image."""
    errors = {
        "psnr_db": psnr_db(image, true.image),
        "ssim": ssim(image, true.image),
        "mae": mae(image, true.image),
    }
    for kind, where in kinds.items():
        errors[f"{kind}_psnr_db"] = psnr_db(image[where][None], true.image[where][None])
        errors[f"{kind}_mae"] = mae(image, true.image, where)
    return errors


def _measure_times_ms(viewers: Mapping[str, Viewer], position: float) -> dict[str, float]:
    # Take turns, so that a slowdown of the machine affects all alike.
    turns_ms = [
        {name: _measure_time_ms(viewer, position) for name, viewer in viewers.items()} for _ in range(TURNS)
    ]
    return {name: float(np.median([turn_ms[name] for turn_ms in turns_ms])) for name in viewers}


def _measure_time_ms(viewer: Viewer, position: float) -> float:
    start_s = time.perf_counter()
    viewer(position)
    return 1000 * (time.perf_counter() - start_s)


def _average_rows(method: str, rows: Iterable[ViewScoreRow]) -> ViewScoreRow:
    scenes: dict[str, list[ViewScoreRow]] = {}
    for row in rows:
        scenes.setdefault(row.scene, []).append(row)
    columns = [
        field.name for field in fields(ViewScoreRow) if field.type is float and field.name != "position"
    ]
    means = {
        column: _average_known(
            [_average_known([getattr(row, column) for row in of]) for of in scenes.values()]
        )
        for column in columns
    }
    return ViewScoreRow(scene=MEAN, position=float("nan"), method=method, **means)


def _average_known(values: Iterable[float]) -> float:
    known: Float[np.ndarray, " n"] = np.array([value for value in values if not np.isnan(value)])
    return float(known.mean()) if known.size else float("nan")
