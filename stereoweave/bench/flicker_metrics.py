"""How much a film flickers: what differs from frame to frame once the true motion is taken out."""

from itertools import product

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped

from stereoweave.errors import StereoweaveError

# What two frames' truth says of one point differs by interpolation and slant; two surfaces are further apart.
_SAME_SURFACE_PX = 1.0


def flicker(
    before: Shaped[np.ndarray, "h w *channels"],
    after: Shaped[np.ndarray, "h w *channels"],
    motion_px: Float[np.ndarray, "h w 2"],
    visible: Bool[np.ndarray, "h w"],
    change: Float[np.ndarray, "h w"] | float = 0.0,
) -> float:
    """Mean error of how a point's value changes from one frame to the next, in its unit; NaN without a point.

    For a point at x it is |after(x + motion(x)) - before(x) - change(x)|, with `after` interpolated linearly:
    an error that stays is no flicker. Of disparity it is the temporal end-point error (TEPE) of Li et al.
    2023, "Temporally Consistent Online Depth Estimation in Dynamic Scenes"; of pictures, whose true change is
    0, the warping error of Lai et al. 2018, "Learning Blind Video Temporal Consistency", by the true motion
    and not squared.

    Args:
        before: Disparity in px [H, W], or a picture [H, W] or [H, W, C].
        after: The same of the next frame.
        motion_px: To the right and down, from where a point is in `before` to where it is in `after`.
        visible: The points that count: such as both frames see (`find_seen_again`).
        change: The true change of each point's value.

    Raises:
        StereoweaveError: The sizes differ, or a point that counts leaves the picture.
    """
    shapes = [list(values.shape[:2]) for values in (before, after, motion_px, visible)]
    if any(shape != shapes[0] for shape in shapes):
        raise StereoweaveError(
            f"flicker: expected two frames, their motion and a mask of one size, got {shapes}"
        )
    columns, rows, inside = _target_places(motion_px)
    if (visible & ~inside).any():
        raise StereoweaveError(
            f"visible: expected points that stay in the picture, found {(visible & ~inside).sum()} "
            "that leave it; take seen_again"
        )
    found = cv2.remap(after.astype(np.float32), columns, rows, cv2.INTER_LINEAR)
    # The channels of a picture come last, and its change is one for all of them.
    error = np.abs(
        found[visible].T.astype(np.float64)
        - before[visible].T
        - np.broadcast_to(change, visible.shape)[visible]
    )
    return float(error.mean()) if error.size else float("nan")


def find_seen_again(
    before_px: Float[np.ndarray, "h w"],
    after_px: Float[np.ndarray, "h w"],
    motion_px: Float[np.ndarray, "h w 2"],
    change_px: Float[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    """Where a point of one frame is seen in the other: all four pixels at its place there show its surface.

    Args:
        before_px: The true disparity of the one frame.
        after_px: That of the other.
        motion_px: To the right and down, from a point's place in the one to that in the other.
        change_px: The true change of each point's disparity on the way.
    """
    columns, rows, inside = _target_places(motion_px)
    expected_px, seen = before_px + change_px, inside.copy()
    places = (np.where(inside, values, 0) for values in (rows, columns))
    around = [(np.floor(values), np.ceil(values)) for values in places]
    for row, column in product(*around):
        found_px = after_px[row.astype(np.intp), column.astype(np.intp)]
        seen &= np.abs(found_px - expected_px) <= _SAME_SURFACE_PX
    return seen


def _target_places(
    motion_px: Float[np.ndarray, "h w 2"],
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Columns and rows that points move to, and whether these are in the picture."""
    height, width = motion_px.shape[:2]
    rows, columns = np.indices((height, width), np.float32)
    columns, rows = columns + motion_px[..., 0], rows + motion_px[..., 1]
    return columns, rows, (columns >= 0) & (columns <= width - 1) & (rows >= 0) & (rows <= height - 1)
