"""Errors of estimates that are searched to several extents."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stereoweave.bench.metrics import bad_percent, d1_percent, epe_px
from stereoweave.data.readers import Scene, read_scenes
from stereoweave.matching.estimate import match
from stereoweave.matching.matcher import Matcher
from stereoweave.matching.occlusion_fill import fill_occluded
from stereoweave.matching.options import MatchOptions
from stereoweave.matching.refine import NARROW, WIDE, Extent, find_searched, refine
from stereoweave.matching.streaks import smooth_streaks
from stereoweave.matching.subpixel import to_subpixel
from stereoweave.stereo import Estimate

NOWHERE = Extent(confidence=0, reach_px=0, both_views=False, in_colour=False)
EXTENTS = (
    NOWHERE,
    Extent(confidence=0.3, reach_px=1, both_views=True, in_colour=True),
    Extent(confidence=0.3, reach_px=1, both_views=False, in_colour=False),
    Extent(confidence=0.4, reach_px=1, both_views=False, in_colour=False),
    Extent(confidence=0.3, reach_px=2, both_views=False, in_colour=False),
    Extent(confidence=0.3, reach_px=2, both_views=True, in_colour=True),
    Extent(confidence=0.4, reach_px=2, both_views=True, in_colour=True),
    Extent(confidence=0.4, reach_px=2, both_views=False, in_colour=True),
    Extent(confidence=0.5, reach_px=2, both_views=False, in_colour=True),
    Extent(confidence=0.4, reach_px=2, both_views=False, in_colour=False),
    NARROW,
    WIDE,
)


@dataclass(frozen=True, kw_only=True)
class ExtentRow:
    """Mean scores over the pairs of a folder whose disparity is known.

    Attributes:
        folder: Name of the folder.
        pairs: Number of pairs.
        confidence, reach_px, both_views, in_colour: The extent (`Extent`).
        searched_percent: Share of the left pixels that are searched.
        epe_px, bad1_percent, bad2_percent, d1_percent: Errors of the left view.
    """

    folder: str
    pairs: int
    confidence: float
    reach_px: int
    both_views: bool
    in_colour: bool
    searched_percent: float
    epe_px: float
    bad1_percent: float
    bad2_percent: float
    d1_percent: float


def score_extents(folder: Path, model: str) -> list[ExtentRow]:
    """Return a row for each of EXTENTS, over the pairs of a folder.

    The pairs need no content masks. After the search, estimates are finished as by `Matcher.finish`, but no
    edges are settled by vote. A pair that the network sees at another size is searched at its own size.
    """
    estimated = list(_estimate_scenes(folder, Matcher(model)))
    return [_average(folder.name, estimated, extent) for extent in EXTENTS]


def _estimate_scenes(folder: Path, matcher: Matcher) -> Iterator[tuple[Scene, Estimate]]:
    """Yield the pairs, with the network's own estimate."""
    for scene in read_scenes(folder):
        yield scene, match(matcher, scene.pair, MatchOptions(raw=True))


def _average(folder: str, estimated: list[tuple[Scene, Estimate]], extent: Extent) -> ExtentRow:
    means = np.mean([_score(scene, raw, extent) for scene, raw in estimated], axis=0).tolist()
    searched_percent, mean_epe_px, bad1_percent, bad2_percent, mean_d1_percent = means
    return ExtentRow(
        folder=folder,
        pairs=len(estimated),
        **extent._asdict(),
        searched_percent=searched_percent,
        epe_px=mean_epe_px,
        bad1_percent=bad1_percent,
        bad2_percent=bad2_percent,
        d1_percent=mean_d1_percent,
    )


def _score(scene: Scene, raw: Estimate, extent: Extent) -> tuple[float, ...]:
    left, right = scene.pair.left, scene.pair.right
    found = raw if extent == NOWHERE else refine(left, right, raw, extent=extent)
    found_px = smooth_streaks(fill_occluded(to_subpixel(left, right, found))).disparity_px
    bad1, bad2 = (bad_percent(found_px, scene.truth_px, limit_px) for limit_px in (1, 2))
    searched_percent = 100 * float(find_searched(raw.disparity_px, raw.confidence, -1, extent).mean())
    return (
        searched_percent,
        epe_px(found_px, scene.truth_px),
        bad1,
        bad2,
        d1_percent(found_px, scene.truth_px),
    )
