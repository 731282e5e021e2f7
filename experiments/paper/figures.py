"""Figures of "Fast Depth Estimation for View Synthesis", drawn from our own runs.

The extension of a path selects the format. Use .jpg for figures with photographs, which would be ten times
larger as PNG.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Real, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullLocator

from stereoweave.bench.projection import project_right
from stereoweave.io.colormap import colour_disparity, find_colour_range_px
from stereoweave.io.files import replacing
from stereoweave.stereo import DepthCurve, Sample

Estimated = tuple[Sample, Mapping[str, Float[np.ndarray, "_ _"]]]
"""A sample, and disparities of its left view in px [H, W], by column title. Samples may differ in size."""

# Okabe and Ito's colours, which colour-blind readers can distinguish.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_HISTOGRAM_HEIGHT = 0.5
_PICTURE_WIDTH_IN = 2.2
_TITLE_HEIGHT_IN = 0.3


def draw_exponent_curves(
    path: str | Path, exponents: Sequence[float], histogram: Real[np.ndarray, " n"] | None = None
) -> None:
    """Write the left plot of Fig. 2: the code against normalised depth, one curve per exponent.

    Args:
        path: Picture to write.
        exponents: Exponents, each at least 1.
        histogram: Counts [N] of the training truth in equal bins over 0..1, as for `fit_exponent`; drawn
            behind the curves at half their height.
    """
    figure, axes = _plot()
    if histogram is not None:
        share = _HISTOGRAM_HEIGHT * histogram / histogram.max()
        axes.stairs(share, np.linspace(0, 1, len(share) + 1), fill=True, color="0.88", label="training truth")
    normalised = np.linspace(0, 1, 201)
    for exponent, colour in zip(exponents, _colours(len(exponents)), strict=True):
        code = DepthCurve(exponent=exponent, max_disparity_px=1.0).encode(normalised)
        axes.plot(normalised, code, color=colour, linewidth=2, label=f"p = {exponent:g}")
    axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="normalised depth: 0 is far, 1 is near", ylabel="code")
    axes.legend(loc="upper left", frameon=False)
    _save(figure, path)


def draw_validation(path: str | Path, curves: Mapping[str, Sequence[Sequence[tuple[int, float]]]]) -> None:
    """Write the right plot of Fig. 2: held-out error against steps. Thin lines show seeds, bold lines means.

    Args:
        path: Picture to write.
        curves: For each setting, one list of (step, squared error of the linear code) per seed. Means are
            drawn at the steps that all seeds have.
    """
    figure, axes = _plot()
    for (setting, seeds), colour in zip(curves.items(), _colours(len(curves)), strict=True):
        for seed in seeds:
            axes.plot(*zip(*seed, strict=True), color=colour, linewidth=0.8, alpha=0.4)
        axes.plot(*_mean_curve(seeds), color=colour, linewidth=2.5, label=setting)
    axes.set(yscale="log", xlabel="training step", ylabel="validation: squared error of the linear code")
    # Matplotlib would label whole decades only, and a loss may cross none.
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
    axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.grid(color="0.92")
    axes.legend(loc="upper right", frameon=False)
    _save(figure, path)


def draw_iterations(path: str | Path, rows: Sequence[Estimated]) -> None:
    """Write Fig. 3: left image, estimates after more and more steps, and ground truth (black if unknown).

    The colours of a row span the range of its ground truth: blue is far, red is near.
    """
    pictures = []
    for sample, estimates_px in rows:
        known = np.isfinite(sample.disparity_px)
        range_px = find_colour_range_px(sample.disparity_px[known][None])
        truth = colour_disparity(np.where(known, sample.disparity_px, range_px[0]), range_px)
        truth[~known] = 0
        coloured = {name: colour_disparity(found_px, range_px) for name, found_px in estimates_px.items()}
        pictures.append({"left image": sample.left, **coloured, "truth": truth})
    _draw_grid(path, pictures)


def draw_views(path: str | Path, rows: Sequence[Estimated]) -> None:
    """Write Fig. 5: left and right image, and the right view from ground truth and from each estimate.

    Pixels without a source are black.
    """
    pictures = []
    for sample, estimates_px in rows:
        disparities_px = {"ground truth": sample.disparity_px, **estimates_px}
        views = {
            name: project_right(sample.left, found_px).image for name, found_px in disparities_px.items()
        }
        pictures.append({"left image": sample.left, "right image": sample.right, **views})
    _draw_grid(path, pictures)


def _mean_curve(seeds: Sequence[Sequence[tuple[int, float]]]) -> tuple[list[int], list[float]]:
    """Return the steps that all seeds have, and the mean losses at them."""
    losses = [dict(seed) for seed in seeds]
    steps = sorted(set.intersection(*(set(loss) for loss in losses)))
    return steps, [float(np.mean([loss[step] for loss in losses])) for step in steps]


def _draw_grid(path: str | Path, rows: Sequence[Mapping[str, UInt8[np.ndarray, "_ _ 3"]]]) -> None:
    """Write pictures in rows; the first row's names are the column titles."""
    heights_in = [
        max(_PICTURE_WIDTH_IN * picture.shape[0] / picture.shape[1] for picture in row.values())
        for row in rows
    ]
    size_in = (_PICTURE_WIDTH_IN * len(rows[0]), sum(heights_in) + _TITLE_HEIGHT_IN)
    figure = Figure(
        figsize=size_in, layout=ConstrainedLayoutEngine(w_pad=0.02, h_pad=0.02, wspace=0, hspace=0)
    )
    grid = figure.subplots(len(rows), len(rows[0]), squeeze=False, height_ratios=heights_in)
    for line, row in zip(grid, rows, strict=True):
        for axes, picture in zip(line, row.values(), strict=True):
            axes.imshow(picture, interpolation="antialiased")
            axes.set_axis_off()
    for axes, name in zip(grid[0], rows[0], strict=True):
        axes.set_title(name, fontsize=10)
    _save(figure, path)


def _plot() -> tuple[Figure, Axes]:
    figure = Figure(figsize=(5.5, 4), layout="constrained")
    axes = figure.subplots()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _colours(count: int) -> list[str]:
    return [_COLOURS[index % len(_COLOURS)] for index in range(count)]


def _save(figure: Figure, path: str | Path) -> None:
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=130)
