"""Matchers side by side on real pairs, in one run: accuracy, time, and time relative to OpenCV's SGBM."""

import csv
import os
import platform
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from stereoweave.data.readers import Scene
from stereoweave.errors import StereoweaveError
from stereoweave.io import replacing
from stereoweave.metrics import bad_percent, d1_percent, epe_px
from stereoweave.stereo import StereoPair

Match = Callable[[StereoPair], Float[np.ndarray, "h w"]]

SGBM, MEAN = "sgbm", "mean"
SGBM_DISPARITIES = 192
TURNS = 5


@dataclass(frozen=True, kw_only=True)
class Row:
    """How one matcher did on one scene, or on the mean of all (scene "mean").

    Errors are over every pixel whose truth is known, occluded ones included.

    Attributes:
        time_ms: Median of the warm calls; in the mean row, the mean of these over the scenes.
        time_relative: time_ms as a multiple of SGBM's in the same row.
    """

    matcher: str
    scene: str
    epe_px: float
    bad1_percent: float
    bad2_percent: float
    d1_percent: float
    time_ms: float
    time_relative: float


def score_pairs(matchers: Mapping[str, Match], scenes: Iterable[Scene]) -> list[Row]:
    """A row per scene and matcher, then a mean row per matcher; OpenCV's SGBM joins them as "sgbm".

    Raises:
        StereoweaveError: A matcher is called "sgbm" or "mean", or is a file of that name.
    """
    for name in matchers:
        if Path(name).stem in (SGBM, MEAN):
            raise StereoweaveError(f"{name}: expected a name that the table does not use itself; rename it")
    everyone = {SGBM: opencv_sgbm(), **matchers}
    rows = [row for scene in scenes for row in _score_scene(everyone, scene)]
    return rows + _mean_rows(rows, everyone)


def opencv_sgbm() -> Match:
    """OpenCV's semi-global matcher over 192 disparities; values <= 0 are its holes, for `fill_rows`.

    Source of the settings: OpenCV's sample stereo_match.cpp at a block size of 5 (P1 = 8*3*5*5,
    P2 = 32*3*5*5), with the speckle range of 2 that StereoSGBM's documentation recommends; the sample has 32.
    """
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=SGBM_DISPARITIES,
        blockSize=5,
        P1=600,
        P2=2400,
        disp12MaxDiff=1,
        preFilterCap=63,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM,
    )

    def match(pair: StereoPair) -> Float32[np.ndarray, "h w"]:
        # SGBM gives no answer in the first 192 columns: a border gives them that room.
        left, right = (
            cv2.copyMakeBorder(image, 0, 0, SGBM_DISPARITIES, 0, cv2.BORDER_REPLICATE)
            for image in (pair.left, pair.right)
        )
        return matcher.compute(left, right)[:, SGBM_DISPARITIES:].astype(np.float32) / 16

    return match


def fill_rows(disparity_px: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """The map with each hole (<= 0) filled from the farther of its known neighbours along the row.

    A row without any takes the one above; above the first row that has some, holes stay.
    """
    known = disparity_px > 0
    occupied = known.max(axis=1)
    farther_px = np.minimum(
        _last_known(disparity_px, known), _last_known(disparity_px[:, ::-1], known[:, ::-1])[:, ::-1]
    )
    filled_px = np.where(known | ~occupied[:, None], disparity_px, farther_px)
    return filled_px[np.maximum.accumulate(np.where(occupied, np.arange(len(known)), 0))]


def write_csv(path: str | Path, rows: Sequence[Any]) -> None:
    """Writes the rows with a header, each beside the processor and the OpenCV that it was measured with.

    Args:
        path: Where to; the folder is made.
        rows: One or more instances of one dataclass, whose fields are the columns.
    """
    machine = {"cpu": _cpu_name(), "cores": os.cpu_count(), "opencv": cv2.__version__}
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(rows[0])] + list(machine))
        writer.writeheader()
        for row in rows:
            values = {k: f"{v:.6g}" if isinstance(v, float) else v for k, v in asdict(row).items()}
            writer.writerow(values | machine)


def _score_scene(matchers: Mapping[str, Match], scene: Scene) -> list[Row]:
    # These first calls warm the matchers up for the timing.
    disparities_px = {name: match(scene.pair) for name, match in matchers.items()}
    # Untimed: others fill SGBM's holes in other ways, at other costs.
    disparities_px[SGBM] = fill_rows(disparities_px[SGBM])
    # In turns, so that a machine that slows down slows all alike.
    turns_ms = [{name: _time_ms(match, scene.pair) for name, match in matchers.items()} for _ in range(TURNS)]
    times_ms = {name: float(np.median([turn_ms[name] for turn_ms in turns_ms])) for name in matchers}
    return [
        Row(
            matcher=name,
            scene=scene.name,
            epe_px=epe_px(disparity_px, scene.truth_px),
            bad1_percent=bad_percent(disparity_px, scene.truth_px, 1),
            bad2_percent=bad_percent(disparity_px, scene.truth_px, 2),
            d1_percent=d1_percent(disparity_px, scene.truth_px),
            time_ms=times_ms[name],
            time_relative=times_ms[name] / times_ms[SGBM],
        )
        for name, disparity_px in disparities_px.items()
    ]


def _time_ms(match: Match, pair: StereoPair) -> float:
    start_s = time.perf_counter()
    match(pair)
    return 1000 * (time.perf_counter() - start_s)


def _mean_rows(rows: list[Row], names: Iterable[str]) -> list[Row]:
    columns = [field.name for field in fields(Row) if field.type is float]
    means = {
        name: {
            column: float(np.mean([getattr(row, column) for row in rows if row.matcher == name]))
            for column in columns
        }
        for name in names
    }
    for mean in means.values():
        mean["time_relative"] = mean["time_ms"] / means[SGBM]["time_ms"]
    return [Row(matcher=name, scene=MEAN, **mean) for name, mean in means.items()]


def _last_known(
    values: Float32[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """At each pixel the nearest known value at or before it in the row; infinity where there is none."""
    columns = np.maximum.accumulate(np.where(known, np.arange(values.shape[1]), -1), axis=1)
    last = np.take_along_axis(values, np.maximum(columns, 0), axis=1)
    return np.where(columns >= 0, last, np.float32(np.inf))


def _cpu_name() -> str:
    # Linux alone has this file, and there platform.processor() does not know the model.
    about = Path("/proc/cpuinfo")
    lines = about.read_text().splitlines() if about.exists() else []
    models = [line.split(": ", 1)[1] for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor()
