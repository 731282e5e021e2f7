"""Matching options that all interfaces share."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereoweave.arguments import check_flag, check_number, describe
from stereoweave.errors import Remedy, StereoweaveError


@dataclass(frozen=True, kw_only=True)
class MatchOptions:
    """Matching options, validated on construction.

    Attributes:
        range_px: Least and greatest disparity of the left view in px; disparities outside the range are
            clipped and get confidence 0. Default: the network's range, extended if the pair exceeds it.
        refined: Match once more at full resolution with the network's disparity as prior, which is slower but
            recovers thin structures and sharper edges. `base` and `best` always do.
        raw: Return the network's disparity without any refinement and occlusion filling.

    Raises:
        StereoweaveError: `range_px` is not two finite numbers in ascending order, or both `refined` and `raw`
            are set.
    """

    range_px: tuple[float, float] | None = None
    refined: bool = False
    raw: bool = False

    def __post_init__(self) -> None:
        check_flag("refined", self.refined)
        check_flag("raw", self.raw)
        if self.refined and self.raw:
            raise StereoweaveError(
                "cannot be combined with refined, because raw output is not post-processed",
                setting="raw",
                remedy=Remedy("leave one of them out", ("raw", "refined")),
            )
        if self.range_px is not None:
            object.__setattr__(self, "range_px", _parse_range(self.range_px))


DEFAULT_OPTIONS = MatchOptions()


def _parse_range(range_px: tuple[float, float]) -> tuple[float, float]:
    is_row = isinstance(range_px, Sequence) or (isinstance(range_px, np.ndarray) and range_px.ndim == 1)
    if not is_row or len(range_px) != 2:
        raise _make_range_error(describe(range_px))
    for value in range_px:
        check_number("range_px", value)
    low_px, high_px = map(float, range_px)
    if not (math.isfinite(low_px) and math.isfinite(high_px) and low_px < high_px):
        raise _make_range_error(f"{low_px:g} and {high_px:g}")
    return low_px, high_px


def _make_range_error(got: str) -> StereoweaveError:
    return StereoweaveError(
        f"expected the least and the greatest disparity in px, such as -20 and 150, got {got}; "
        "omit it for automatic detection",
        setting="range_px",
    )
