"""Conversion of a dataset's arrays to samples, with unknown and occluded pixels marked."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Shaped

from stereoweave.errors import FormatError
from stereoweave.stereo import Sample, StereoPair

# Allows for rounding and for nearly touching surfaces; the training's collages use the same tolerance.
_TOLERANCE_PX = 0.5


def require_size(
    values: Shaped[np.ndarray, "h w *channels"], path: Path, pair: StereoPair
) -> Shaped[np.ndarray, "h w *channels"]:
    """Return the values; raise a FormatError that names `path` if their size differs from the pair's size."""
    (height_px, width_px), expected = values.shape[:2], pair.left.shape[:2]
    if (height_px, width_px) != expected:
        raise FormatError(
            f"{path}: expected {expected[1]}x{expected[0]} pixels, the size of the pair's pictures, "
            f"found {width_px}x{height_px}"
        )
    return values


def make_sample(
    pair: StereoPair,
    disparity_px: Float[np.ndarray, "h w"],
    right_disparity_px: Float[np.ndarray, "h w"] | None = None,
    occluded: Bool[np.ndarray, "h w"] | None = None,
) -> Sample:
    """Make a sample from a pair and its ground truth.

    Args:
        pair: The pair, with its camera if known.
        disparity_px: Disparity of the left view; NaN and infinity mean unknown.
        right_disparity_px: Disparity of the right view; None if it is unknown everywhere.
        occluded: The dataset's mask for the left view; by default, it is computed from the disparities.
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
        occluded=find_occluded(left_px, right_px) if occluded is None else occluded,
        right_occluded=np.ascontiguousarray(find_occluded(right_px[:, ::-1], left_px[:, ::-1])[:, ::-1]),
        camera=pair.camera,
    )


def find_occluded(
    disparity_px: Float[np.ndarray, "h w"], other_px: Float[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return the mask of pixels whose match is outside the other image or behind the surface visible there.

    A pixel is not marked if a disparity needed for the comparison is unknown. The other view must be to
    the right of this view; for a right view, mirror both maps.
    """
    width_px = disparity_px.shape[1]
    match = np.arange(width_px) - disparity_px
    outside = (match < 0) | (match > width_px - 1)
    match = np.where(np.isfinite(match) & ~outside, match, 0)
    before = match.astype(np.intp)
    share = (match - before).astype(np.float32)
    after = before + (share > 0)
    before_px, after_px = (np.take_along_axis(other_px, columns, axis=1) for columns in (before, after))
    # At a disparity jump, the closer of the two columns beside the match decides. On a slope, the disparity
    # at that column may exceed the surface's own, so the interpolated disparity must be greater, too.
    # Comparisons with NaN are False.
    column_px = np.where(share < 0.5, before_px, after_px)
    between_px = (1 - share) * before_px + share * after_px
    return outside | (np.minimum(column_px, between_px) > disparity_px + _TOLERANCE_PX)


def _mark_unknown(disparity_px: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    return np.where(np.isfinite(disparity_px), disparity_px, np.nan).astype(np.float32)
