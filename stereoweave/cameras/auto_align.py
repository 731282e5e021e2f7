"""Automatic alignment of a pair of unknown cameras: swaps its sides and rectifies it where needed."""

from dataclasses import dataclass, replace
from functools import partial

from stereoweave.cameras.alignment import Alignment, check_pair
from stereoweave.cameras.camera_fit import Warps
from stereoweave.cameras.disparity_sign import estimate_depth_order
from stereoweave.cameras.rectify_uncalibrated import fit_warps
from stereoweave.errors import Note, Remedy, StereoweaveError
from stereoweave.stereo import StereoPair

SWAPPED_BACK = Note("left and right were swapped, and have been swapped back")
_NO_BETTER = Note("the pair was not rectified, because its rows would not come closer")
KEEP = Remedy("the pictures can also be kept as they are", ("no_rectify",))
# The disparities of a pair out of line may have any sign. Left and right are swapped if the vote on the depth
# order is below this.
_SWAPPED_VOTE = -0.07


@dataclass(frozen=True, kw_only=True)
class Aligned:
    """A pair that is ready for matching.

    Attributes:
        pair: The pair, unchanged if it was sound or could not be aligned.
        alignment: The alignment of `pair`.
        notes: Notes on the changes, or on why the pair could not be aligned.
        swapped: Whether the sides were swapped.
        warps: The warps that rectified the pair, after the swap; None if it was not warped.
    """

    pair: StereoPair
    alignment: Alignment
    notes: tuple[Note, ...] = ()
    swapped: bool = False
    warps: Warps | None = None


def align(pair: StereoPair, *, always: bool = False, parallel: bool = False) -> Aligned:
    """Rectify a pair if its rows are apart, and swap its sides if they are swapped.

    A sound pair, or one with too few matches, is returned as it is. A pair whose rows would not come closer
    is not warped. A pair with a camera keeps metric depth where possible (see `rectify_by_features`).

    Args:
        pair: The pair.
        always: Rectify sound pairs too, and raise the errors of `rectify_by_features`.
        parallel: The maker of the pair's camera states that its axes are parallel (see `fit_warps`).
    """
    rectify = partial(_rectify if always else align_rows, parallel=parallel)
    aligned = rectify(pair)
    # Of a rectified pair, the signs of the disparities must agree with the depth order.
    suspicious = aligned.warps is not None or "swapped" in aligned.alignment.defects
    if not suspicious or _find_depth_order(aligned) >= _SWAPPED_VOTE:
        return aligned
    other = rectify(swap(pair))
    return replace(other, swapped=True, notes=(SWAPPED_BACK, *other.notes))


def align_rows(pair: StereoPair, *, parallel: bool = False, keep_screen: bool = False) -> Aligned:
    """Rectify a pair if its rows are apart, as `align` does, without swapping its sides.

    For `keep_screen`, see `fit_warps`.
    """
    before = check_pair(pair.left, pair.right)
    as_it_is = Aligned(pair=pair, alignment=before)
    if not before.is_known or before.is_rectified:
        return as_it_is
    try:
        rectified = _rectify(pair, parallel=parallel, keep_screen=keep_screen)
    except StereoweaveError as error:
        note = Note(f"the pair could not be rectified: {error.message}", error.remedy)
        return replace(as_it_is, notes=(note,))
    if not (rectified.alignment.vertical_error_95_px < before.vertical_error_95_px):
        return replace(as_it_is, notes=(_NO_BETTER,))
    return replace(rectified, notes=tuple(replace(note, remedy=KEEP) for note in rectified.notes))


def _rectify(pair: StereoPair, *, parallel: bool, keep_screen: bool = False) -> Aligned:
    fit = fit_warps(pair, parallel=parallel, keep_screen=keep_screen)
    rectified = fit.apply(pair)
    alignment = check_pair(rectified.left, rectified.right)
    return Aligned(pair=rectified, alignment=alignment, notes=(fit.note,), warps=fit.warps)


def swap(pair: StereoPair) -> StereoPair:
    """Return the pair with its sides swapped."""
    return replace(
        pair, left=pair.right, right=pair.left, left_seen=pair.right_seen, right_seen=pair.left_seen
    )


def _find_depth_order(aligned: Aligned) -> float:
    return estimate_depth_order(aligned.pair.left, aligned.pair.right, aligned.alignment.range_px)
