"""Matching of prepared pairs, shared by commands, batches, the page and the service."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32

from stereoweave.cameras.alignment import RECTIFY, Alignment
from stereoweave.cameras.diagnosis import find_problems
from stereoweave.errors import NameOf, Note, Remedy, keyword
from stereoweave.matching.estimate import match_many
from stereoweave.matching.matcher import Matcher
from stereoweave.matching.options import MatchOptions
from stereoweave.matching.providers import CPU
from stereoweave.outputs.point_cloud import Mesh, PointCloud, make_mesh, make_point_cloud, require_camera
from stereoweave.outputs.report import Summary, summarize
from stereoweave.pictures.prepare import Prepared
from stereoweave.stereo import Estimate, StereoPair
from stereoweave.system.steps import step


@dataclass(frozen=True, kw_only=True)
class Result:
    """A matched pair with its estimate and summary.

    Attributes:
        pair: The pair, with its camera if known.
        estimate: The pair's estimate.
        summary: Summary of the pair and its estimate.
        notes: Notes on what was detected or changed while the pictures were read.
        threads: Number of threads for rendering; default: all cores.
        alignment: The alignment of the pair, if it has been measured.
        remedy: What to do if rows are apart.
        date: When the pair was matched.
        command: The command that asked for the result, as typed; "" if there was none.
        name_of: The front end's names for settings, for the notes in the report.
    """

    pair: StereoPair
    estimate: Estimate
    summary: Summary
    notes: tuple[Note, ...] = ()
    threads: int | None = None
    alignment: Alignment | None = None
    remedy: Remedy = RECTIFY
    date: datetime | None = None
    command: str = ""
    name_of: NameOf = keyword

    @property
    def seen(self) -> Bool[np.ndarray, "h w"]:
        """Mask of the pixels that the left image covers."""
        seen = self.pair.left_seen
        return np.ones(self.estimate.disparity_px.shape, bool) if seen is None else seen

    def disparity_px(self, unknown: float = np.nan) -> Float32[np.ndarray, "h w"]:
        """Return the left image's disparity in px, with `unknown` outside the image's content."""
        return np.where(self.seen, self.estimate.disparity_px, np.float32(unknown)).astype(np.float32)

    def depth_m(self, unknown: float = np.nan) -> Float[np.ndarray, "h w"]:
        """Return the left image's depth in metres, with `unknown` outside the image's content."""
        depth_m = require_camera(self.pair).depth_m(self.estimate.disparity_px)
        return np.where(self.seen, depth_m, np.float32(unknown))

    @step("checking the pair")
    def warnings(self) -> list[Note]:
        """Return notes on likely defects of the pair.

        The first call takes about half as long as matching, unless the alignment is known.
        """
        return list(self._problems)

    @cached_property
    def _problems(self) -> tuple[Note, ...]:
        return tuple(find_problems(self.pair, self.estimate, self.alignment, self.remedy))

    @cached_property
    def point_cloud(self) -> PointCloud:
        return make_point_cloud(self.pair, self.estimate)

    @cached_property
    def mesh(self) -> Mesh:
        return make_mesh(self.pair, self.estimate)


def run(prepared: Prepared, matcher: Matcher, options: MatchOptions) -> Result:
    """Match and summarise a prepared pair. Raises the same errors as `match`."""
    (result,) = run_many([prepared], matcher, options)
    return result


def run_many(prepared: Sequence[Prepared], matcher: Matcher, options: MatchOptions) -> list[Result]:
    """Match prepared pairs together and summarise each of them with an equal share of the matching time."""
    start_s = time.perf_counter()
    estimates = match_many(matcher, [each.pair for each in prepared], options)
    total_ms = 1000 * (time.perf_counter() - start_s)
    date = datetime.now(UTC)
    model = matcher.model if matcher.provider == CPU else f"{matcher.model} on {matcher.provider}"
    return [
        Result(
            pair=each.pair,
            estimate=estimate,
            summary=summarize(
                each.pair,
                estimate,
                pictures=tuple(picture.name for picture in each.pictures),
                model=model,
                estimate_ms=total_ms / len(prepared),
            ),
            notes=(*each.notes, *estimate.notes),
            threads=matcher.threads,
            alignment=each.alignment,
            remedy=each.remedy,
            date=date,
        )
        for each, estimate in zip(prepared, estimates, strict=True)
    ]
