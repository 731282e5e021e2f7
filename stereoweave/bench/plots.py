"""Plots of `stereoweave bench pairs`: errors against time, and sparsification curves."""

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Annotation
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullLocator
from matplotlib.transforms import Bbox

from stereoweave.bench.metrics import DROPPED_PERCENT, Sparsification
from stereoweave.bench.tables import Curves, MatcherRow
from stereoweave.io.images import write_image

# Okabe and Ito's colours, which colour-blind readers can distinguish.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_TITLES = {"bad1_percent": "bad-1: off by over 1 px, % of pixels", "epe_px": "EPE: mean error, px"}
_MARKER_PX = 8
_Place = tuple[tuple[float, float], Literal["left", "center", "right"], Literal["top", "center", "bottom"]]
# Places of a label beside its point, best first, each with an offset in points and an alignment.
_PLACES: tuple[_Place, ...] = (
    ((0, 6), "center", "bottom"),
    ((0, -6), "center", "top"),
    ((7, 0), "left", "center"),
    ((-7, 0), "right", "center"),
    ((-5, -5), "right", "top"),
    ((5, -5), "left", "top"),
    ((5, 5), "left", "bottom"),
    ((-5, 5), "right", "bottom"),
)


def is_checked(row: MatcherRow) -> bool:
    """Return whether a matcher's confidence is the left-right check, which has no calibration error."""
    return math.isnan(row.calibration_error)


def draw_error_over_time(path: str | Path, rows: Sequence[MatcherRow]) -> None:
    """Write plots of bad-1 and EPE against the time per pair, side by side; the lower left is best.

    Args:
        path: Picture to write; its extension selects the format.
        rows: The mean row of each matcher. Rows whose error is NaN are left out.
    """
    rows = [row for row in rows if not math.isnan(row.epe_px)]
    figure, panels = _make_panels()
    for column, axes in panels.items():
        for row in rows:
            axes.plot(row.time_ms, getattr(row, column), **_choose_marker(row))
        highest = max((getattr(row, column) for row in rows), default=1)
        axes.set(xscale="log", xlabel="time per pair, ms", ylabel=_TITLES[column], ylim=(0, 1.15 * highest))
        axes.margins(x=0.15)
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
        axes.xaxis.set_minor_locator(NullLocator())
    # Placing the labels needs the final positions of the points.
    figure.draw_without_rendering()
    for column, axes in panels.items():
        _label(axes, {_short_name(row.matcher): (row.time_ms, getattr(row, column)) for row in rows})
    _save(figure, path)


def draw_sparsification(path: str | Path, curves: Mapping[str, Curves], checked: Collection[str]) -> None:
    """Write plots of bad-1 and EPE against the share of pixels dropped by confidence, with dashed oracles.

    Args:
        path: Picture to write; its extension selects the format.
        curves: Curves of `score_pairs`, by matcher.
        checked: Names of the matchers whose confidence is the left-right check.
    """
    figure, panels = _make_panels()
    for column, axes in panels.items():
        for index, (name, of_matcher) in enumerate(curves.items()):
            curve: Sparsification = getattr(of_matcher, column)
            colour = _COLOURS[index % len(_COLOURS)]
            label = f"{name}, by its left-right check" if name in checked else _short_name(name)
            axes.plot(DROPPED_PERCENT, curve.kept, color=colour, linewidth=2, label=label)
            axes.plot(DROPPED_PERCENT, curve.oracle, color=colour, linewidth=1, linestyle="--")
        axes.set(xlabel="dropped, % of pixels", ylabel=_TITLES[column], xlim=(0, 95), ylim=(0, None))
    axes.plot([], [], color="0.4", linewidth=1, linestyle="--", label="by the true error: the oracle")
    axes.legend(loc="upper right", frameon=False)
    _save(figure, path)


def _make_panels() -> tuple[Figure, dict[str, Axes]]:
    figure = Figure(figsize=(9, 4), layout="constrained")
    panels = dict(zip(_TITLES, figure.subplots(1, 2), strict=True))
    for axes in panels.values():
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(color="0.92")
        axes.set_axisbelow(True)
    return figure, panels


def _choose_marker(row: MatcherRow) -> dict[str, Any]:
    if is_checked(row):
        return {"marker": "s", "color": "0.45", "linestyle": ""}
    return {"marker": "o", "color": _COLOURS[0], "linestyle": ""}


def _short_name(matcher: str) -> str:
    return Path(matcher).name


def _label(axes: Axes, points: Mapping[str, tuple[float, float]]) -> None:
    """Write each name beside its point, in the first free place, or in the best place if none is free."""
    corners = [axes.transData.transform(point) for point in points.values()]
    taken = [Bbox([corner - _MARKER_PX / 2, corner + _MARKER_PX / 2]) for corner in corners]
    for name, point in points.items():
        labels = [_draw_label(axes, name, point, place) for place in _PLACES]
        boxes = [label.get_window_extent() for label in labels]
        free = (index for index, box in enumerate(boxes) if not any(map(box.overlaps, taken)))
        chosen = next(free, 0)
        taken.append(boxes[chosen])
        for label in labels[:chosen] + labels[chosen + 1 :]:
            label.remove()


def _draw_label(axes: Axes, name: str, point: tuple[float, float], place: _Place) -> Annotation:
    offset, horizontal, vertical = place
    return axes.annotate(
        name, point, offset, textcoords="offset points", ha=horizontal, va=vertical, fontsize=9
    )


def _save(figure: Figure, path: str | Path) -> None:
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(130)
    canvas.draw()  # type: ignore[no-untyped-call]
    write_image(path, np.asarray(canvas.buffer_rgba())[..., :3].copy())  # type: ignore[no-untyped-call]
