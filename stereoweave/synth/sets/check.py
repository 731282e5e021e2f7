"""Verification of a set's checksums, and of its disparities against the images and against each other."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from rich.console import Console

from stereoweave.data.paper_layout import check_frame, list_paper
from stereoweave.data.shards import Shards
from stereoweave.errors import FormatError
from stereoweave.stereo import Sample
from stereoweave.synth.sets.make import read_set
from stereoweave.synth.sets.workers import count_step, run_in_workers

_DISPARITY_EDGES_PX = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
_DEPTH_EDGES_M = (0.0, 1.0, 2.0, 3.0, 5.0, 7.5, 10.0, 15.0, 25.0, 50.0, 100.0)
_WIDEST_BAR = 40
_PAIRS_A_TASK = 20
# Rounding of the stored disparities contributes at most 0.002 px.
_AGREE_PX = 0.05
# Measured on all scenes: correct pairs agree at no less than 98 % of the pixels at 64x48, 99.1 % at 160x120
# and 99.9 % at 640x480. If one of the two maps is off by 0.1 px, they agree at 29 % or less.
_LEAST_AGREEING = 0.95
# Ratio of the image difference at the disparity to the difference 1 px beside it. At these sizes it is at
# most 0.90, 0.76 and 0.66 for correct pairs, at least 1.1 if the disparity is off by 1 px, and at least 0.99
# if the sides are swapped.
_LARGEST_RATIO = 0.97
# Means over fewer pixels are too noisy.
_FEWEST_PIXELS = 200
# Farther surfaces, above all the sky, look the same in both images even if the sides are swapped.
_NEAR_PX = 1.0
_JUMP_PX = 0.5


@dataclass(frozen=True, kw_only=True)
class Findings:
    """Statistics and problems of checked pairs; instances can be summed.

    Attributes:
        pairs: Number of pairs.
        disparity: Histogram [10] of the left views' known disparities.
        depth: Histogram [11] of the depths at the same pixels; the last bin includes the sky.
        unknown: Number of pixels without ground truth.
        occluded: Number of pixels that only the left camera sees.
        grey_levels: Sums [3], over the compared pairs, of the mean grey-level difference between the left
            image and the right image warped by the disparity minus 1 px, the disparity, and the disparity
            plus 1 px.
        compared: Number of pairs whose images were compared; the others have too few near surfaces.
        agreeing: Fraction of the pixels at which the two disparities agree, summed over the matched pairs.
        matched: Number of pairs whose two disparities could be compared.
        problems: One line per problem.
    """

    pairs: int
    disparity: Int[np.ndarray, "10"]
    depth: Int[np.ndarray, "11"]
    unknown: int
    occluded: int
    grey_levels: Float[np.ndarray, "3"]
    compared: int
    agreeing: float
    matched: int
    problems: tuple[str, ...]

    def __add__(self, other: "Findings") -> "Findings":
        return Findings(**{name: value + getattr(other, name) for name, value in vars(self).items()})


class _Pairs(NamedTuple):
    """Name and file of each pair, and a function that reads a pair.

    In the paper's layout, each frame counts as one file.
    """

    names: list[str]
    files: list[str]
    read: Callable[[int], Sample]

    def runs(self) -> list[range]:
        """Split the pairs into runs that end at file boundaries."""
        starts = [0, *(i for i in range(1, len(self.files)) if self.files[i] != self.files[i - 1])]
        if len(starts) == len(self.files):
            starts = starts[::_PAIRS_A_TASK]
        return [range(start, end) for start, end in pairwise([*starts, len(self.files)])]


def check_set(folder: Path, jobs: int = 1, console: Console | None = None) -> Findings:
    """Check all pairs of a set; if the set is intact, the findings contain no problems.

    Raises:
        FormatError: The folder contains no set, or its sequence of shards has a gap.
    """
    facts = read_set(folder)
    pairs = _open_pairs(folder, facts["layout"], facts["scene"])
    count = len(pairs.names)
    look = partial(_check_run, folder, facts["layout"], facts["scene"])
    found = _no_findings()
    for part in run_in_workers(look, pairs.runs(), jobs, console or Console(), "checking pairs", count):
        found += part
    if count < facts["pairs"]:
        lacking = f"{folder}: expected the {facts['pairs']} pairs requested, found {count}"
        found += _no_findings(f"{lacking}; rerun the same `stereoweave synth make` command to resume")
    return found


def report_lines(found: Findings) -> Iterator[str]:
    """Yield the report line by line: statistics, histograms, problems, and the number of problems."""
    if found.pairs:
        yield from _statistics(found)
    yield from found.problems
    count = len(found.problems)
    yield f"{count} problem{'s' * (count > 1)}" if count else "no problems"


def find_problem(sample: Sample) -> str | None:
    """Return the first inconsistency between a pair's disparities and images, or None if they agree."""
    if not np.isfinite(sample.disparity_px).any():
        return "expected known disparities, found none"
    before, at, after = _measure_differences(sample)
    if at > _LARGEST_RATIO * min(before, after):
        return (
            "expected the images to differ least at the disparity, found differences of "
            f"{at:.2f} grey levels at the disparity, {before:.2f} at 1 px less and {after:.2f} at 1 px more"
        )
    agreeing = _measure_agreement(sample)
    if agreeing < _LEAST_AGREEING:
        return (
            f"expected the two disparities to agree at {_LEAST_AGREEING:.0%} or more of the pixels that both "
            f"cameras see, found {agreeing:.1%}"
        )
    return None


def _check_run(folder: Path, layout: str, scene: str, run: range) -> Findings:
    pairs = _open_pairs(folder, layout, scene)
    found, damaged = _no_findings(), dict[str, str]()
    for index in run:
        try:
            sample = pairs.read(index)
            wrong = find_problem(sample)
            found += _measure(sample, f"{folder}: {pairs.names[index]}: {wrong}" if wrong else None)
        except FormatError as error:
            # A damaged shard must be deleted as a whole, so one line per shard suffices.
            damaged.setdefault(pairs.files[index], str(error))
        count_step()
    return found + _no_findings(*damaged.values())


@cache
def _open_pairs(folder: Path, layout: str, scene: str) -> _Pairs:
    if layout == "shards":
        shards = Shards(folder, scene)

        def unpack(index: int) -> Sample:
            shards.views(index)
            return shards[index]

        files = [shard.path.name for shard in shards.shards for _ in range(shard.first, shard.last + 1)]
        return _Pairs([shards.name(index) for index in range(shards.count)], files, unpack)
    frames = list_paper(folder)

    def read(index: int) -> Sample:
        check_frame(folder, frames[index].name)
        return frames[index].read()

    names = [frame.name for frame in frames]
    return _Pairs(names, names, read)


def _no_findings(*problems: str) -> Findings:
    return Findings(
        pairs=0,
        disparity=np.zeros(len(_DISPARITY_EDGES_PX), int),
        depth=np.zeros(len(_DEPTH_EDGES_M), int),
        unknown=0,
        occluded=0,
        grey_levels=np.zeros(3),
        compared=0,
        agreeing=0.0,
        matched=0,
        problems=problems,
    )


def _measure(sample: Sample, problem: str | None) -> Findings:
    known_px = sample.disparity_px[np.isfinite(sample.disparity_px)]
    assert sample.camera is not None
    grey_levels, agreeing = _measure_differences(sample), _measure_agreement(sample)
    return Findings(
        pairs=1,
        disparity=_count(known_px, _DISPARITY_EDGES_PX),
        depth=_count(sample.camera.depth_m(known_px[None]), _DEPTH_EDGES_M),
        unknown=sample.disparity_px.size - known_px.size,
        occluded=int(sample.occluded.sum()),
        grey_levels=np.nan_to_num(grey_levels),
        compared=int(np.isfinite(grey_levels).all()),
        agreeing=float(np.nan_to_num(agreeing)),
        matched=int(np.isfinite(agreeing)),
        problems=(problem,) if problem else (),
    )


def _measure_differences(sample: Sample) -> Float[np.ndarray, "3"]:
    """Return the mean image differences at 1 px less than the disparity, at the disparity, and at 1 px more.

    Only near surfaces seen by both cameras count. The result is NaN if they cover too few pixels.
    """
    left, right = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (sample.left, sample.right))
    columns = _find_matches(sample)
    rows = np.broadcast_to(np.arange(len(columns), dtype=np.float32)[:, None], columns.shape).copy()
    last = columns.shape[1] - 1
    # Comparisons with NaN are false, so this also excludes unknown disparities.
    seen = ~sample.occluded & (columns >= 1) & (columns <= last - 1) & (sample.disparity_px >= _NEAR_PX)
    if seen.sum() < _FEWEST_PIXELS:
        return np.full(3, np.nan)
    differences = (
        cv2.remap(right, columns - shift_px, rows, cv2.INTER_LINEAR).astype(np.float32) - left
        for shift_px in (-1, 0, 1)
    )
    return np.array([np.abs(difference[seen]).mean() for difference in differences])


def _measure_agreement(sample: Sample) -> float:
    """Return the fraction of pixels, among those seen by both cameras, at which the two disparities agree.

    Pixels at disparity jumps are excluded; the result is NaN if too few pixels remain. A left disparity
    agrees if it lies between the right view's disparities at the two columns next to its match. This
    tolerates a crease between these columns, where any interpolation would be wrong.
    """
    columns = _find_matches(sample)
    inside = (columns >= 0) & (columns <= columns.shape[1] - 1)
    columns = np.where(inside, columns, 0)
    beside = [
        np.take_along_axis(sample.right_disparity_px, rounded(columns).astype(np.intp), axis=1)
        for rounded in (np.floor, np.ceil)
    ]
    low_px, high_px = np.minimum(*beside), np.maximum(*beside)
    # A wire narrower than a pixel may appear in one view and fall between two columns of the other.
    level = _find_level(sample.disparity_px) & (high_px - low_px <= _JUMP_PX)
    seen = inside & level & ~sample.occluded
    if seen.sum() < _FEWEST_PIXELS:
        return np.nan
    outside_px = np.maximum(low_px - sample.disparity_px, sample.disparity_px - high_px)
    return float((outside_px[seen] <= _AGREE_PX).mean())


def _find_matches(sample: Sample) -> Float[np.ndarray, "h w"]:
    """Return the column of the right image that each left pixel matches."""
    return np.arange(sample.disparity_px.shape[1], dtype=np.float32) - sample.disparity_px


def _find_level(disparity_px: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the mask of pixels without a disparity jump or an unknown disparity in an adjacent column."""
    padded_px = np.pad(disparity_px, ((0, 0), (1, 1)), mode="edge")
    level = np.abs(np.diff(padded_px, axis=1)) <= _JUMP_PX
    return level[:, 1:] & level[:, :-1]


def _count(values: Float[np.ndarray, "*n"], edges: tuple[float, ...]) -> Int[np.ndarray, " m"]:
    places = np.searchsorted(edges, values.ravel(), side="right") - 1
    return np.bincount(places, minlength=len(edges))


def _statistics(found: Findings) -> Iterator[str]:
    pixels = found.disparity.sum() + found.unknown
    yield f"{found.pairs} pair{'s' * (found.pairs > 1)}"
    yield f"occluded {found.occluded / pixels:.1%}, unknown {found.unknown / pixels:.1%} of left-view pixels"
    if found.compared:
        before, at, after = found.grey_levels / found.compared
        yield (
            f"images differ by {at:.2f} grey levels at the disparity, "
            f"{before:.2f} at 1 px less and {after:.2f} at 1 px more"
        )
    if found.matched:
        share = found.agreeing / found.matched
        yield f"disparities agree within {_AGREE_PX} px at {share:.3%} of shared pixels, excluding edges"
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
