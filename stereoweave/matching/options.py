"""Matching options that all interfaces share."""

import math
from dataclasses import dataclass

from stereoweave.arguments import as_two_numbers, check_flag
from stereoweave.errors import Remedy, StereoweaveError

OMIT_RANGE = Remedy("omit it for automatic detection")


@dataclass(frozen=True, kw_only=True)
class MatchOptions:
    """Matching options, validated on construction.

    Attributes:
        range_px: Least and greatest disparity of the left view in px; disparities outside the range are
            clipped, and get confidence 0 if they are outside by more than 1 px. Default: the network's range,
            extended if the pair exceeds it.
        refined: Match once more at full resolution wherever the confidence is below 0.85, instead of 0.45.
            This is slower, but recovers more thin structures and sharper edges. `base` and `best` always do.
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
    expected = "the least and the greatest disparity in px, such as -20 and 150"
    low_px, high_px = as_two_numbers("range_px", range_px, expected, OMIT_RANGE)
    if not (math.isfinite(low_px) and math.isfinite(high_px) and low_px < high_px):
        raise StereoweaveError(
            f"expected {expected}, got {low_px:g} and {high_px:g}", setting="range_px", remedy=OMIT_RANGE
        )
    return low_px, high_px
