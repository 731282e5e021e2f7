"""Rows of the pairs benchmark, their means over scenes, and CSV files of rows."""

import os
import platform
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from stereoweave.bench.error_classes import ClassErrors
from stereoweave.bench.metrics import Sparsification
from stereoweave.bench.opencv_matchers import SGBM
from stereoweave.io.text import write_table

MEAN = "mean"


@dataclass(frozen=True, kw_only=True)
class MatcherRow:
    """Scores of one matcher on one scene, or averaged over all scenes (scene "mean").

    Errors cover every pixel of known truth, including occluded pixels. A mean is over the scenes that have a
    value; for example, a scene without depth edges has no edge errors.

    Attributes:
        edge_epe_px, edge_bad1_percent, flying_percent: Errors near depth edges (edge_metrics.py).
        ause_px, ause_bad1_percent: Area between the confidence's sparsification curve and the oracle's, for
            the absolute error and for bad pixels.
        calibration_error: Expected calibration error; NaN for the left-right check, which gives no
            probability. It is computed per scene, so that overconfidence in one scene does not cancel
            underconfidence in another.
        time_ms: Median time per call after a warm-up; in the mean row, the mean of these medians.
        time_relative: time_ms as a multiple of SGBM's time_ms on the same scene.
        memory_mb: Peak memory for the largest pair (system/memory.py); NaN if not measured, and in all rows
            except the mean row.
    """

    matcher: str
    scene: str
    epe_px: float
    bad1_percent: float
    bad2_percent: float
    d1_percent: float
    edge_epe_px: float
    edge_bad1_percent: float
    flying_percent: float
    ause_px: float
    ause_bad1_percent: float
    calibration_error: float
    time_ms: float
    time_relative: float
    memory_mb: float = float("nan")


@dataclass(frozen=True, kw_only=True)
class ClassRow:
    """Errors of one matcher in one class of pixels, on one scene or averaged over all scenes.

    Attributes:
        pixel_class: A name in `error_classes.CLASSES`, or `error_classes.ALL`.

    The other columns are those of `ClassErrors`. A mean is over the scenes that have a value; for
    example, a scene without plain pixels has no error within that class.
    """

    matcher: str
    scene: str
    pixel_class: str
    share_percent: float
    bad1_percent: float
    bad2_percent: float
    bad1_within_percent: float
    bad2_within_percent: float
    epe_px: float


class Curves(NamedTuple):
    """A matcher's sparsification curves, for the mean error in px and for bad-1 in percent."""

    epe_px: Sparsification
    bad1_percent: Sparsification


def average_rows(rows: list[MatcherRow], names: Iterable[str]) -> list[MatcherRow]:
    """Return a mean row over the scenes for each named matcher; time_relative is the ratio of mean times."""
    columns = [field.name for field in fields(MatcherRow) if field.type is float]
    means = {
        name: {
            column: float(_average_known([getattr(row, column) for row in rows if row.matcher == name]))
            for column in columns
        }
        for name in names
    }
    for mean in means.values():
        mean["time_relative"] = mean["time_ms"] / means[SGBM]["time_ms"]
    return [MatcherRow(matcher=name, scene=MEAN, **mean) for name, mean in means.items()]


def average_class_rows(rows: Sequence[ClassRow]) -> list[ClassRow]:
    """Return mean rows over the scenes, one per matcher and class, in the order of the first scene's rows."""
    by_class: defaultdict[tuple[str, str], list[ClassRow]] = defaultdict(list)
    for row in rows:
        by_class[row.matcher, row.pixel_class].append(row)
    columns = [field.name for field in fields(ClassErrors)]
    return [
        ClassRow(
            matcher=matcher,
            scene=MEAN,
            pixel_class=pixel_class,
            **{column: float(_average_known([getattr(row, column) for row in alike])) for column in columns},
        )
        for (matcher, pixel_class), alike in by_class.items()
    ]


def average_curves(curves: Sequence[Curves]) -> Curves:
    """Return the curves averaged over the scenes."""
    means = (
        Sparsification(*(_average_known(lines) for lines in zip(*of_scenes, strict=True)))
        for of_scenes in zip(*curves, strict=True)
    )
    return Curves(*means)


def write_csv(path: str | Path, rows: Sequence[Any], machine: dict[str, str] | None = None) -> None:
    """Write rows as CSV with a header. Each row also describes the machine.

    Args:
        path: The CSV file; its folder is created.
        rows: One or more instances of the same dataclass, whose fields are the columns.
        machine: Processor, number of cores and OpenCV version; {} for rows that name their machine. Default:
            those of this machine.
    """
    machine = describe_machine() if machine is None else machine
    columns = [field.name for field in fields(rows[0])] + list(machine)
    values = [{k: f"{v:.6g}" if isinstance(v, float) else v for k, v in asdict(row).items()} for row in rows]
    write_table(path, columns, (row | machine for row in values))


def describe_machine() -> dict[str, str]:
    """Return this machine's processor, number of cores and OpenCV version."""
    return {"cpu": _find_cpu_name(), "cores": str(os.cpu_count()), "opencv": cv2.__version__}


def _average_known(values: Sequence[Any]) -> Any:
    """Return the mean of the numbers, or of the arrays, that contain no NaN; NaN if there are none."""
    known = [value for value in values if not np.isnan(value).any()]
    return np.mean(known, axis=0) if known else values[0]


def _find_cpu_name() -> str:
    # Only Linux has this file; platform.processor() does not return the model on Linux.
    about = Path("/proc/cpuinfo")
    lines = about.read_text().splitlines() if about.exists() else []
    models = [line.split(": ", 1)[1] for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor()
