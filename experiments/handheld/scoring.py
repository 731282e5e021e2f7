"""Scores of rectification on simulated hand-held pairs."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from experiments.handheld.pairs import HandheldPair, make_handheld_pairs
from experiments.handheld.warps import warp_in_each_way
from stereoweave.cameras.auto_align import align, swap
from stereoweave.cameras.picture_warp import PictureWarp
from stereoweave.cameras.rectify_uncalibrated import fit_warps
from stereoweave.errors import StereoweaveError

_LOST_STEP_PX = 4
# One pair in this many is distorted further, and swapped.
_PAIR_STEP = 10


@dataclass(frozen=True, kw_only=True)
class HandheldRow:
    """Score of one pair.

    Attributes:
        pair: Name of the original, and number of the pair.
        width_px, height_px: Size of the pictures.
        vertical_error_before_px: Median vertical error at the true correspondences before rectification.
        vertical_error_px, vertical_error_95_px: Median and 95th percentile afterwards; NaN if refused.
        lost_percent: Percentage of the left picture that is outside the rectified one.
        fit_s: Time of the fit.
        refused: Why the pair was refused; empty if it was not.
    """

    pair: str
    width_px: int
    height_px: int
    vertical_error_before_px: float
    vertical_error_px: float = float("nan")
    vertical_error_95_px: float = float("nan")
    lost_percent: float = float("nan")
    fit_s: float = float("nan")
    refused: str = ""


def score_handheld_pairs(real: Path) -> list[HandheldRow]:
    """Rectify the simulated hand-held pairs, and measure their errors at the true correspondences."""
    return [score(made) for made in make_handheld_pairs(real)]


@dataclass(frozen=True, kw_only=True)
class WarpedRow(HandheldRow):
    """Score of one pair that is distorted further by `warp`, a name in `warp_in_each_way`."""

    warp: str = ""


@dataclass(frozen=True, kw_only=True)
class SwapRow:
    """Whether `align` swaps the sides of a sound pair, and of the same pair with its sides swapped."""

    pair: str
    swapped_falsely: bool
    swap_found: bool


def score_warped_pairs(real: Path) -> list[WarpedRow]:
    """Rectify some of the pairs, distorted as by wide lenses, rolling shutters and warped prints."""
    return [
        WarpedRow(**vars(score(warped)), warp=warp)
        for number, made in enumerate(make_handheld_pairs(real, _PAIR_STEP))
        for warp, warped in warp_in_each_way(made, number)
    ]


def score_swaps(real: Path) -> list[SwapRow]:
    """Align some of the pairs with their sides as they are, and swapped."""
    return [
        SwapRow(
            pair=made.name,
            swapped_falsely=align(made.pair).swapped,
            swap_found=align(swap(made.pair)).swapped,
        )
        for made in make_handheld_pairs(real, _PAIR_STEP)
    ]


def summarize_warped(rows: list[WarpedRow]) -> str:
    """Describe how many pairs end below 0.5 px with each distortion."""
    names = dict.fromkeys(row.warp for row in rows)
    return "\n".join(f"{name}: {summarize([row for row in rows if row.warp == name])}" for name in names)


def summarize_swaps(rows: list[SwapRow]) -> str:
    """Describe how many pairs are swapped falsely, and how many swaps are found."""
    return (
        f"{sum(row.swapped_falsely for row in rows)} of {len(rows)} sound pairs are swapped, and "
        f"{sum(row.swap_found for row in rows)} of {len(rows)} swapped ones"
    )


def score(made: HandheldPair) -> HandheldRow:
    """Rectify one pair, and measure its errors at the true correspondences."""
    height, width = made.pair.left.shape[:2]
    before_px = float(np.median(np.abs(made.left_px - made.right_px)[:, 1]))
    row = HandheldRow(pair=made.name, width_px=width, height_px=height, vertical_error_before_px=before_px)
    start_s = time.perf_counter()
    try:
        warps = fit_warps(made.pair).warps
    except StereoweaveError as error:
        return replace(row, refused=str(error))
    fit_s = time.perf_counter() - start_s
    off_px = np.abs(warps.left.transform(made.left_px) - warps.right.transform(made.right_px))[:, 1]
    return replace(
        row,
        vertical_error_px=float(np.median(off_px)),
        vertical_error_95_px=float(np.percentile(off_px, 95)),
        lost_percent=_measure_lost_percent(warps.left),
        fit_s=fit_s,
    )


def summarize(rows: Sequence[HandheldRow]) -> str:
    """Describe how many pairs end below 0.5 px, and how many of these keep 90 % of the left picture."""
    good = [row for row in rows if row.vertical_error_px < 0.5]
    kept = sum(row.lost_percent <= 10 for row in good)
    return f"{len(good)} of {len(rows)} pairs end under 0.5 px, and {kept} of these lose at most 10 %"


def _measure_lost_percent(warp: PictureWarp) -> float:
    width, height = warp.size_px
    rows, columns = np.mgrid[:height:_LOST_STEP_PX, :width:_LOST_STEP_PX]
    places_px: Float[np.ndarray, "n 2"] = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    moved_px = warp.transform(places_px)
    outside = (moved_px < 0) | (moved_px > np.array(warp.size_px) - 1)
    return 100 * float(outside.any(1).mean())
