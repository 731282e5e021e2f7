"""Whether a set on disk is whole and true: checksums; disparities against the pictures and each other."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from rich.console import Console

from stereoweave.data.paper_layout import check_frame, paper
from stereoweave.data.shards import Shards
from stereoweave.errors import FormatError
from stereoweave.stereo import Sample
from stereoweave.synth.making import read_set
from stereoweave.synth.workers import in_workers, step_done

_DISPARITY_EDGES_PX = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
_DEPTH_EDGES_M = (0.0, 1.0, 2.0, 3.0, 5.0, 7.5, 10.0, 15.0, 25.0, 50.0, 100.0)
_WIDEST_BAR = 40
_PAIRS_A_TASK = 20
# Rounding on disk is at most 0.002 px of it.
_AGREE_PX = 0.05
# Of rendered pairs 99.4 to 99.99 % agree: curved surfaces differ a little between two columns. A wrong sign,
# scale or shift leaves next to nothing.
_LEAST_AGREEING = 0.98
# Rendered pairs differ by 0.3 to 0.5 of what they differ by a pixel beside the disparity.
_LARGEST_RATIO = 0.85
# What is farther, the sky above all, looks alike in both pictures even where these have changed sides.
_NEAR_PX = 1.0
_JUMP_PX = 0.5
_NEIGHBOURS, _BESIDE_JUMPS = np.ones((3, 3), np.uint8), np.ones((5, 5), np.uint8)


@dataclass(frozen=True, kw_only=True)
class Findings:
    """What was found in pairs; those of several add up.

    Attributes:
        pairs: how many were looked at.
        disparity: how many known pixels of left views lie in each of the 10 bars of the histogram.
        depth: the same in its 11 bars of depth; the last one has the sky in it.
        unknown: pixels without truth.
        occluded: pixels that the left camera alone sees.
        grey_levels: [3], sums over the pairs of the mean difference of the left picture and the right one,
            fetched by the disparity - 1 px, by it, and by it + 1 px.
        agreeing: sum over the pairs of the share of pixels at which both disparities agree; NaN with one of
            them alone.
        problems: a line each.
    """

    pairs: int
    disparity: Int[np.ndarray, "10"]
    depth: Int[np.ndarray, "11"]
    unknown: int
    occluded: int
    grey_levels: Float[np.ndarray, "3"]
    agreeing: float
    problems: tuple[str, ...]

    def __add__(self, other: "Findings") -> "Findings":
        return Findings(**{name: value + getattr(other, name) for name, value in vars(self).items()})


class _Pairs(NamedTuple):
    names: list[str]
    read: Callable[[int], Sample]


def check(folder: Path, jobs: int = 1, console: Console | None = None) -> Findings:
    """What all pairs of a set come to; `problems` is empty where the set is in order.

    Raises:
        FormatError: There is no set in the folder, or files are missing between others.
    """
    facts = read_set(folder)
    count = len(_opened(folder, facts["layout"]).names)
    tasks = [range(start, min(start + _PAIRS_A_TASK, count)) for start in range(0, count, _PAIRS_A_TASK)]
    look = partial(_look, folder, facts["layout"])
    found = _nothing()
    for part in in_workers(look, tasks, jobs, console or Console(), "checking pairs", count):
        found += part
    if count < facts["pairs"]:
        lacking = f"{folder}: expected {facts['pairs']} pairs, as were asked for, found {count}"
        found += _nothing(f"{lacking}; the same stereoweave synth make goes on")
    return found


def lines(found: Findings) -> Iterator[str]:
    """The statistics of a set as text, with histograms of disparity and depth; problems come last."""
    if found.pairs:
        yield from _statistics(found)
    yield from found.problems


def problem(sample: Sample) -> str | None:
    """What is wrong between the disparities and pictures of a pair, or None."""
    before, at, after = _grey_levels(sample)
    if not at < _LARGEST_RATIO * min(before, after):
        return (
            "expected the left picture to fit the right one best at the disparity, found them to differ by "
            f"{at:.2f} grey levels there, {before:.2f} at 1 px less and {after:.2f} at 1 px more"
        )
    agreeing = _agreeing(sample)
    if agreeing < _LEAST_AGREEING:
        return (
            f"expected both disparities to agree at {_LEAST_AGREEING:.0%} of the pixels that both see, "
            f"found {agreeing:.1%}"
        )
    return None


def _look(folder: Path, layout: str, run: range) -> Findings:
    pairs = _opened(folder, layout)
    found = _nothing()
    for index in run:
        try:
            sample = pairs.read(index)
            wrong = problem(sample)
            found += _found(sample, f"{folder}: {pairs.names[index]}: {wrong}" if wrong else None)
        except FormatError as error:
            found += _nothing(str(error))
        step_done()
    return found


@cache
def _opened(folder: Path, layout: str) -> _Pairs:
    if layout == "shards":
        shards = Shards(folder)

        def unpacked(index: int) -> Sample:
            shards.views(index)
            return shards[index]

        return _Pairs([shards.name(index) for index in range(shards.count)], unpacked)
    frames = paper(folder)

    def read(index: int) -> Sample:
        check_frame(folder, frames[index].name)
        return frames[index].read()

    return _Pairs([frame.name for frame in frames], read)


def _nothing(*problems: str) -> Findings:
    return Findings(
        pairs=0,
        disparity=np.zeros(len(_DISPARITY_EDGES_PX), int),
        depth=np.zeros(len(_DEPTH_EDGES_M), int),
        unknown=0,
        occluded=0,
        grey_levels=np.zeros(3),
        agreeing=0.0,
        problems=problems,
    )


def _found(sample: Sample, problem: str | None) -> Findings:
    known_px = sample.disparity_px[np.isfinite(sample.disparity_px)]
    assert sample.camera is not None
    return Findings(
        pairs=1,
        disparity=_counts(known_px, _DISPARITY_EDGES_PX),
        depth=_counts(sample.camera.depth_m(known_px[None]), _DEPTH_EDGES_M),
        unknown=sample.disparity_px.size - known_px.size,
        occluded=int(sample.occluded.sum()),
        grey_levels=_grey_levels(sample),
        agreeing=_agreeing(sample),
        problems=(problem,) if problem else (),
    )


def _grey_levels(sample: Sample) -> Float[np.ndarray, "3"]:
    """Mean difference of both pictures at near things that both see, by the disparity - 1, + 0 and + 1 px."""
    left, right = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (sample.left, sample.right))
    columns, rows = _places(sample)
    last = columns.shape[1] - 1
    # False where the disparity is unknown.
    seen = ~sample.occluded & (columns >= 1) & (columns <= last - 1) & (sample.disparity_px >= _NEAR_PX)
    differences = (
        cv2.remap(right, columns - shift_px, rows, cv2.INTER_LINEAR).astype(np.float32) - left
        for shift_px in (-1, 0, 1)
    )
    return np.array([np.abs(difference[seen]).mean() if seen.any() else np.nan for difference in differences])


def _agreeing(sample: Sample) -> float:
    """The share of what both views see, edges left out, at which their disparities agree; NaN of nothing."""
    columns, rows = _places(sample)
    there_px = cv2.remap(sample.right_disparity_px, columns, rows, cv2.INTER_LINEAR, borderValue=np.nan)
    smooth_there = cv2.remap(
        _smooth(sample.right_disparity_px).astype(np.float32), columns, rows, cv2.INTER_LINEAR
    )
    seen = ~sample.occluded & _smooth(sample.disparity_px) & (smooth_there == 1) & np.isfinite(there_px)
    return float((np.abs(there_px - sample.disparity_px)[seen] <= _AGREE_PX).mean()) if seen.any() else np.nan


def _places(sample: Sample) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Column and row, in the right picture, of what each pixel of the left one shows."""
    height, width = sample.disparity_px.shape
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    return columns - sample.disparity_px, rows


def _smooth(disparity_px: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels more than 2 px away from a jump of the disparity, and from one to what is unknown."""
    known_px = np.nan_to_num(disparity_px)
    jumps = cv2.dilate(known_px, _NEIGHBOURS) - cv2.erode(known_px, _NEIGHBOURS) > 2 * _JUMP_PX
    return cv2.dilate(jumps.astype(np.uint8), _BESIDE_JUMPS) == 0


def _counts(values: Float[np.ndarray, "*n"], edges: tuple[float, ...]) -> Int[np.ndarray, " m"]:
    places = np.searchsorted(edges, values.ravel(), side="right") - 1
    return np.bincount(places, minlength=len(edges))


def _statistics(found: Findings) -> Iterator[str]:
    pixels = found.disparity.sum() + found.unknown
    before, at, after = found.grey_levels / found.pairs
    yield f"{found.pairs} pairs"
    yield f"occluded {found.occluded / pixels:.1%}, unknown {found.unknown / pixels:.1%} of the left views"
    yield (
        f"left pictures differ from right ones by {at:.2f} grey levels at the disparity, "
        f"{before:.2f} at 1 px less, {after:.2f} at 1 px more"
    )
    if np.isfinite(found.agreeing):
        share = found.agreeing / found.pairs
        yield f"both disparities agree to {_AGREE_PX} px at {share:.3%} of what both see, edges left out"
    yield from _histogram("disparity", "px", _DISPARITY_EDGES_PX, found.disparity)
    yield from _histogram("depth", "m", _DEPTH_EDGES_M, found.depth)


def _histogram(
    name: str, unit: str, edges: tuple[float, ...], counts: Int[np.ndarray, " m"]
) -> Iterator[str]:
    yield f"{name}, {unit}"
    shares = counts / max(counts.sum(), 1)
    for low, high, share in zip(edges, (*edges[1:], None), shares, strict=True):
        label = f"{low:g} to {high:g}" if high else f"{low:g} and more"
        bar = "█" * round(_WIDEST_BAR * share / max(shares.max(), 1e-9))
        yield f"{label:>13} {share:6.1%} {bar}".rstrip()
