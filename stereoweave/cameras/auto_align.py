"""Automatic alignment of a pair of unknown cameras: swaps its sides and rectifies it where needed."""

from dataclasses import dataclass, replace

import numpy as np

from stereoweave.cameras.alignment import Alignment, check_pair
from stereoweave.cameras.disparity_sign import estimate_depth_order
from stereoweave.cameras.rectify_uncalibrated import Fit, apply_warps, fit_warps
from stereoweave.errors import Note, Remedy, StereoweaveError
from stereoweave.stereo import StereoPair

_SWAPPED = Note("left and right were swapped, and have been swapped back")
_KEEP = Remedy("keep the pictures as they are", ("no_rectify",))
# The disparities of a pair out of line may have any sign. Left and right are swapped if the vote on the depth
# order is below this.
_SWAPPED_VOTE = -0.07
_OUTER_PERCENT = 1.0


@dataclass(frozen=True, kw_only=True)
class Aligned:
    """A pair that is ready for matching.

    Attributes:
        pair: The pair, unchanged if it was sound or could not be aligned.
        alignment: The alignment of `pair`.
        notes: Notes on the changes, or on why the pair could not be aligned.
    """

    pair: StereoPair
    alignment: Alignment
    notes: tuple[Note, ...] = ()


def align(pair: StereoPair) -> Aligned:
    """Rectify a pair if its rows are apart, and swap its sides if they are swapped.

    A sound pair, or one with too few matches, is returned as it is. A pair whose rows would not come closer
    is not warped.
    """
    before = check_pair(pair.left, pair.right)
    if not before.is_known:
        return Aligned(pair=pair, alignment=before)
    if before.is_rectified:
        return _swap_if_needed(pair, before)
    try:
        rectified, notes = _rectify(pair)
    except StereoweaveError as error:
        note = Note(f"the pair could not be rectified: {error.message}", error.remedy)
        return Aligned(pair=pair, alignment=before, notes=(note,))
    after = check_pair(rectified.left, rectified.right)
    if not (after.vertical_error_95_px < before.vertical_error_95_px):
        return Aligned(pair=pair, alignment=before)
    return Aligned(pair=rectified, alignment=after, notes=notes)


def _swap_if_needed(pair: StereoPair, alignment: Alignment) -> Aligned:
    if "swapped" not in alignment.defects:
        return Aligned(pair=pair, alignment=alignment)
    swapped = _swap(pair)
    return Aligned(pair=swapped, alignment=check_pair(swapped.left, swapped.right), notes=(_SWAPPED,))


def _swap(pair: StereoPair) -> StereoPair:
    return replace(
        pair, left=pair.right, right=pair.left, left_seen=pair.right_seen, right_seen=pair.left_seen
    )


def _rectify(pair: StereoPair) -> tuple[StereoPair, tuple[Note, ...]]:
    """Rectify the pair, after swapping its sides if the depth order requires it."""
    fit = fit_warps(pair)
    rectified = apply_warps(pair, fit.warps)
    if _find_depth_order(rectified, fit) >= _SWAPPED_VOTE:
        return rectified, (_describe(fit),)
    swapped = _swap(pair)
    fit = fit_warps(swapped)
    return apply_warps(swapped, fit.warps), (_SWAPPED, _describe(fit))


def _describe(fit: Fit) -> Note:
    return replace(fit.note, remedy=_KEEP)


def _find_depth_order(rectified: StereoPair, fit: Fit) -> float:
    disparity_px = fit.warps.transform(fit.matches).disparity_px
    least_px, greatest_px = np.percentile(disparity_px, [_OUTER_PERCENT, 100 - _OUTER_PERCENT])
    return estimate_depth_order(rectified.left, rectified.right, (float(least_px), float(greatest_px)))
