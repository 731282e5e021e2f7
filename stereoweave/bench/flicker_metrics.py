"""Flicker and jumps of a video: the difference between frames after compensation for the true motion."""

from itertools import product

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped

from stereoweave.errors import StereoweaveError

# Between frames, interpolation and slant change a point's true disparity by less than this.
_SAME_SURFACE_PX = 1.0
JUMP_PX = 2.0
"""A point jumps if its disparity changes by this much more or less than its true disparity does."""
_THIN_PX = 7
_IN_FRONT_PX = 2.0


def flicker(
    before: Shaped[np.ndarray, "h w *channels"],
    after: Shaped[np.ndarray, "h w *channels"],
    motion_px: Float[np.ndarray, "h w 2"],
    visible: Bool[np.ndarray, "h w"],
    change: Float[np.ndarray, "h w"] | float = 0.0,
) -> float:
    """Return the mean error of the points' change from one frame to the next; NaN if there are no points.

    The error at x is |after(x + motion(x)) - before(x) - change(x)|, in the unit of the values, with `after`
    interpolated linearly. An error that stays constant is not flicker. For disparity, this is the temporal
    end-point error (TEPE) of Li et al. 2023, "Temporally Consistent Online Depth Estimation in Dynamic
    Scenes". For images, whose true change is 0, it is the warping error of Lai et al. 2018, "Learning Blind
    Video Temporal Consistency", but with the true motion and without squaring.

    Args:
        before: Disparity in px [H, W], or an image [H, W] or [H, W, C].
        after: The same for the next frame.
        motion_px: Motion of each point to the right and down, from `before` to `after`.
        visible: Mask of the points that count, such as those visible in both frames (`find_seen_again`).
        change: True change of each point's value.

    Raises:
        StereoweaveError: If the sizes differ, or a visible point leaves the image.
    """
    errors = _measure_change_errors(before, after, motion_px, visible, change)
    return float(errors.mean()) if errors.size else float("nan")


def jumps_share(
    before_px: Float[np.ndarray, "h w"],
    after_px: Float[np.ndarray, "h w"],
    motion_px: Float[np.ndarray, "h w 2"],
    visible: Bool[np.ndarray, "h w"],
    change_px: Float[np.ndarray, "h w"] | float = 0.0,
) -> float:
    """Return the share of the points whose error of change (see `flicker`) exceeds `JUMP_PX`.

    Flicker is small if many points tremble a little or if few jump far, but only jumps are seen. NaN if
    there are no points. Arguments and errors are those of `flicker`.
    """
    errors_px = _measure_change_errors(before_px, after_px, motion_px, visible, change_px)
    return float((errors_px > JUMP_PX).mean()) if errors_px.size else float("nan")


def find_thin(truth_px: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the mask of the pixels of thin things.

    These are pixels more than 2 px of disparity in front of what is left when everything is taken away into
    which no square of 7x7 pixels fits.
    """
    window = np.ones((_THIN_PX, _THIN_PX), np.uint8)
    thick_px = cv2.morphologyEx(truth_px.astype(np.float32), cv2.MORPH_OPEN, window)
    return truth_px - thick_px > _IN_FRONT_PX


def find_seen_again(
    before_px: Float[np.ndarray, "h w"],
    after_px: Float[np.ndarray, "h w"],
    motion_px: Float[np.ndarray, "h w 2"],
    change_px: Float[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    """Return the mask of the points that are visible in both frames.

    A point of the first frame is visible in the second if all four pixels around its target show
    the same surface.

    Args:
        before_px: True disparity of the first frame.
        after_px: True disparity of the second frame.
        motion_px: Motion of each point to the right and down, from the first frame to the second.
        change_px: True change of each point's disparity.
    """
    columns, rows, inside = _find_targets(motion_px)
    expected_px, seen = before_px + change_px, inside.copy()
    places = (np.where(inside, values, 0) for values in (rows, columns))
    around = [(np.floor(values), np.ceil(values)) for values in places]
    for row, column in product(*around):
        found_px = after_px[row.astype(np.intp), column.astype(np.intp)]
        seen &= np.abs(found_px - expected_px) <= _SAME_SURFACE_PX
    return seen


def _measure_change_errors(
    before: Shaped[np.ndarray, "h w *channels"],
    after: Shaped[np.ndarray, "h w *channels"],
    motion_px: Float[np.ndarray, "h w 2"],
    visible: Bool[np.ndarray, "h w"],
    change: Float[np.ndarray, "h w"] | float,
) -> Float[np.ndarray, "*channels n"]:
    """Return the absolute error of the change of each visible point; see `flicker`."""
    shapes = [list(values.shape[:2]) for values in (before, after, motion_px, visible)]
    if any(shape != shapes[0] for shape in shapes):
        raise StereoweaveError(
            f"flicker: expected two frames, their motion and a mask, all of the same size, found {shapes}"
        )
    columns, rows, inside = _find_targets(motion_px)
    if (visible & ~inside).any():
        raise StereoweaveError(
            f"visible: expected points that stay in the image, found {(visible & ~inside).sum()} "
            "that leave it; use find_seen_again"
        )
    found = cv2.remap(after.astype(np.float32), columns, rows, cv2.INTER_LINEAR)
    # An image's channels come last and share one change.
    return np.abs(
        found[visible].T.astype(np.float64)
        - before[visible].T
        - np.broadcast_to(change, visible.shape)[visible]
    )


def _find_targets(
    motion_px: Float[np.ndarray, "h w 2"],
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Return the columns and rows to which points move, and the mask of those inside the image."""
    height, width = motion_px.shape[:2]
    rows, columns = np.indices((height, width), np.float32)
    columns, rows = columns + motion_px[..., 0], rows + motion_px[..., 1]
    return columns, rows, (columns >= 0) & (columns <= width - 1) & (rows >= 0) & (rows <= height - 1)
