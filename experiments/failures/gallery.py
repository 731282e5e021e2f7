"""The pairs that a network gets most wrong, as rows of a picture and of a table."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from stereoweave.bench.error_classes import CLASSES, class_errors, classify
from stereoweave.bench.metrics import bad_percent, epe_px
from stereoweave.data.readers import Scene
from stereoweave.io.colormap import colour_disparity, find_colour_range_px
from stereoweave.stereo import Estimate

# Width of each of a row's four pictures.
_WIDTH_PX = 256
# An error of this size is white in the picture of the errors.
_WHITE_PX = 8.0
_GAP_PX = 4


@dataclass(frozen=True, kw_only=True)
class Failure:
    """Errors of one pair.

    Attributes:
        scene: Name of the pair.
        epe_px, bad2_percent: Mean error, and share of the known pixels that are off by more than 2 px.
        worst_class: Class of pixels (bench/error_classes.py) with the largest part of bad2_percent.
        worst_class_bad2_percent: Its part of bad2_percent.
    """

    scene: str
    epe_px: float
    bad2_percent: float
    worst_class: str
    worst_class_bad2_percent: float


def find_failures(
    matched: Iterable[tuple[Scene, Estimate]], count: int
) -> list[tuple[Failure, Scene, Estimate]]:
    """Return the pairs with the highest bad-2, at most one of each set, the worst first.

    The set of a pair is its name up to the last slash. Pairs without known disparity are left out.
    """
    worst: dict[str, tuple[Failure, Scene, Estimate]] = {}
    for scene, estimate in matched:
        if not np.isfinite(scene.truth_px).any():
            continue
        failure = _measure(scene, estimate)
        set_name = scene.name.rpartition("/")[0]
        if set_name not in worst or failure.bad2_percent > worst[set_name][0].bad2_percent:
            worst[set_name] = failure, scene, estimate
    return sorted(worst.values(), key=lambda found: -found[0].bad2_percent)[:count]


def draw_failures(found: Iterable[tuple[Scene, Estimate]]) -> UInt8[np.ndarray, "h w 3"]:
    """Draw a row for each pair: left picture, true disparity, estimate, and errors up to 8 px in grey.

    Disparities of a row share their colours. Unknown truth is black.
    """
    return np.concatenate([np.concatenate(list(_draw_row(*one)), axis=1) for one in found])


def _measure(scene: Scene, estimate: Estimate) -> Failure:
    classes = class_errors(
        estimate.disparity_px,
        scene.truth_px,
        classify(scene.pair.left, scene.truth_px, occluded=scene.occluded),
    )
    worst = max(CLASSES, key=lambda name: classes[name].bad2_percent)
    return Failure(
        scene=scene.name,
        epe_px=epe_px(estimate.disparity_px, scene.truth_px),
        bad2_percent=bad_percent(estimate.disparity_px, scene.truth_px, 2),
        worst_class=worst,
        worst_class_bad2_percent=classes[worst].bad2_percent,
    )


def _draw_row(scene: Scene, estimate: Estimate) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    known = np.isfinite(scene.truth_px)
    range_px = find_colour_range_px(scene.truth_px[known][None])
    yield _frame(scene.pair.left)
    yield _frame(colour_disparity(np.where(known, scene.truth_px, 0), range_px) * known[..., None])
    yield _frame(colour_disparity(estimate.disparity_px, range_px))
    yield _frame(_draw_error(np.abs(estimate.disparity_px - scene.truth_px)))


def _draw_error(error_px: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    grey = 255 * np.clip(np.nan_to_num(error_px) / _WHITE_PX, 0, 1)
    return np.repeat(np.rint(grey).astype(np.uint8)[..., None], 3, axis=2)


def _frame(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Scale an image to the width of a cell, and add a white gap below and to the right."""
    height = round(image.shape[0] * _WIDTH_PX / image.shape[1])
    cell = cv2.resize(image, (_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    return np.pad(cell, ((0, _GAP_PX), (0, _GAP_PX), (0, 0)), constant_values=255)
