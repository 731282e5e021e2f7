"""New views side by side with pictures that a camera has taken there, by method and by kind of pixel.

The methods are shown the two photographs alone. Where both true disparities are known, pixels are told apart
by what the new view truly shows (data/view_truth.py), at the nominal place of a picture taken beside it:

    smooth    of known disparity there, farther than three pixels from a depth edge
    edge      the three on either side of one (edges.py)
    one       of these two, seen by one of the photographs
    neither   seen by none, and of no known disparity
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
from stereoweave.bench.pairs import MEAN, TURNS, SceneLister, merge_machines, score_all
from stereoweave.bench.view_scenes import ReferenceView, ViewScene
from stereoweave.bench.view_truth import fill_unknown, find_view_truth
from stereoweave.data.samples import find_hidden
from stereoweave.matching.opencv import OPENCV_MATCHERS, SGBM, fill_rows, left_right_confidence
from stereoweave.rendering.renderer import Renderer
from stereoweave.stereo import Estimate, Sample, StereoPair
from stereoweave.system.ray_engine import Engine

Estimator = Callable[[StereoPair], Estimate]
"""A pair to the estimate that views are rendered from, such as what `benchmark.network` gives."""

Viewer = Callable[[float], UInt8[np.ndarray, "h w 3"]]
"""A position to one method's view of one scene."""

_BEHIND_ALL_PX = -1e9
NEAREST, CROSS_FADE, GROUND_TRUTH = "nearest photograph", "cross-fade", "ground truth"


@dataclass(frozen=True, kw_only=True)
class ViewScoreRow:
    """How one method's view of a scene from a position compares with the picture taken there.

    In the mean row of a method (scene "mean", no position) each number is the mean over the scenes that have
    it, of the mean over a scene's positions that have it.

    Attributes:
        psnr_db, ssim, mae: Over all pixels; errors are in grey levels of 0..255.
        smooth_psnr_db: Over the pixels of a kind (see above), from their mean squared error; NaN where there
            is none, or the truth is not known. The others likewise.
        time_ms: Median for a view once the pair is matched.
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
    """A row per scene, position and method, then a mean row per method; and what they were measured with."""

    rows: list[ViewScoreRow]
    machine: dict[str, str]


def score_view_scenes(
    networks: Mapping[str, Callable[[], Estimator]],
    scenes: SceneLister[ViewScene],
    threads: int | None = None,
    engine: Engine | None = None,
) -> ViewScores:
    """How the views of several methods compare with the pictures taken there.

    Four methods are in every table. "nearest photograph" and "cross-fade", the two photographs' weighted
    mean, need no disparity. "sgbm" is OpenCV's matcher, and "ground truth" the true disparity of both views:
    the ceiling, where it is known. These two are filled along rows, and rendered as the networks' are.

    Args:
        networks: What makes each further method, by its name.
        scenes: Lists at least one.
        threads: For rendering; all cores if left out.
        engine: As for `benchmark.score_pairs`, which says what is raised, too.
    """
    found = score_all(networks, scenes, partial(_score_scene, threads), engine)
    rows = [row for scene in found for row in scene.result]
    methods = dict.fromkeys(row.method for row in rows)
    means = [_average_rows(method, [row for row in rows if row.method == method]) for method in methods]
    return ViewScores(rows + means, merge_machines(found))


def shift_image(
    image: UInt8[np.ndarray, "h w 3"], offset_px: tuple[float, float]
) -> UInt8[np.ndarray, "h w 3"]:
    """The image with its content moved right and down by offset_px; as it is where that is zero."""
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
        # These first calls warm the renderer up for the timing.
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
    """What OpenCV's users have of it: both views, each filled along rows, and the left-right check."""
    match = OPENCV_MATCHERS[SGBM]()
    left_px, mirrored_px = match(pair), match(pair.mirror())
    filled_px, right_filled_px = fill_rows(left_px), fill_rows(mirrored_px)[:, ::-1]
    return Estimate(
        disparity_px=filled_px,
        right_disparity_px=right_filled_px,
        # As the matcher does for a network without a confidence of its own.
        confidence=np.exp(left_right_confidence(left_px, mirrored_px[:, ::-1])),
        occluded=find_hidden(filled_px, right_filled_px),
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
    """The pixels of each kind, which begins the names of its columns; none where the truth is not known."""
    if not _has_truth(sample):
        return dict.fromkeys(("smooth", "edge", "one", "neither"), np.zeros(sample.left.shape[:2], bool))
    truth = find_view_truth(sample, position)
    known = np.isfinite(truth.disparity_px)
    # What neither shows is behind what is beside it.
    near = near_edge(np.where(truth.none_sees, _BEHIND_ALL_PX, truth.disparity_px))
    return {"smooth": known & ~near, "edge": known & near, "one": truth.one_sees, "neither": truth.none_sees}


def _measure_errors(
    image: UInt8[np.ndarray, "h w 3"], true: ReferenceView, kinds: Mapping[str, Bool[np.ndarray, "h w"]]
) -> dict[str, float]:
    """The columns that compare the two pictures."""
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
    # In turns, so that a machine that slows down slows all alike.
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
