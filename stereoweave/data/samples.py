"""Samples from what the files of a dataset hold: sizes compared, what is unknown or hidden marked."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Shaped

from stereoweave.errors import FormatError
from stereoweave.stereo import Sample, StereoPair

# As in the project's own collages: rounding, and surfaces that all but touch.
_TOLERANCE_PX = 0.5


def require_size(
    values: Shaped[np.ndarray, "h w *channels"], path: Path, pair: StereoPair
) -> Shaped[np.ndarray, "h w *channels"]:
    """The values themselves; FormatError, naming `path`, where they are not of the size of the pair."""
    (height_px, width_px), expected = values.shape[:2], pair.left.shape[:2]
    if (height_px, width_px) != expected:
        raise FormatError(
            f"{path}: expected {expected[1]}x{expected[0]} pixels, like the pictures it belongs to, "
            f"found {width_px}x{height_px}"
        )
    return values


def make_sample(
    pair: StereoPair,
    disparity_px: Float[np.ndarray, "h w"],
    right_disparity_px: Float[np.ndarray, "h w"] | None = None,
    occluded: Bool[np.ndarray, "h w"] | None = None,
) -> Sample:
    """The sample of a pair and its ground truth.

    Args:
        pair: With its camera where that is known.
        disparity_px: Of the left view; NaN and infinity are unknown.
        right_disparity_px: Of the right view; None where the dataset has none: all of it becomes unknown.
        occluded: The dataset's own mask of the left view; None to find it from the two disparities.
    """
    left_px = _mark_unknown(disparity_px)
    right_px = (
        np.full_like(left_px, np.nan) if right_disparity_px is None else _mark_unknown(right_disparity_px)
    )
    return Sample(
        left=pair.left,
        right=pair.right,
        disparity_px=left_px,
        right_disparity_px=right_px,
        occluded=find_hidden(left_px, right_px) if occluded is None else occluded,
        right_occluded=np.ascontiguousarray(find_hidden(right_px[:, ::-1], left_px[:, ::-1])[:, ::-1]),
        camera=pair.camera,
    )


def find_hidden(
    disparity_px: Float[np.ndarray, "h w"], other_px: Float[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Pixels that this view alone sees: whose match is beside the other picture, or behind what it sees.

    False where a disparity that decides it is unknown. The other view lies to the right of this one; for a
    right view, both maps are handed in mirrored.
    """
    width_px = disparity_px.shape[1]
    match = np.arange(width_px) - disparity_px
    outside = (match < 0) | (match > width_px - 1)
    match = np.where(np.isfinite(match) & ~outside, match, 0)
    before = match.astype(np.intp)
    share = (match - before).astype(np.float32)
    after = before + (share > 0)
    before_px, after_px = (np.take_along_axis(other_px, columns, axis=1) for columns in (before, after))
    # At a jump the nearer one of the two columns beside the match decides; on a slope that one may be nearer
    # than the surface itself, but what lies between the two is not. Comparisons with NaN are False.
    column_px = np.where(share < 0.5, before_px, after_px)
    between_px = (1 - share) * before_px + share * after_px
    return outside | (np.minimum(column_px, between_px) > disparity_px + _TOLERANCE_PX)


def _mark_unknown(disparity_px: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    return np.where(np.isfinite(disparity_px), disparity_px, np.nan).astype(np.float32)
