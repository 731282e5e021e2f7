"""The right view made of the left image, as in Table I of "Fast Depth Estimation for View Synthesis".

`rendering` makes better views, of both photographs. This is a yardstick: nothing is blended or refined, so
that what differs between the views of two methods is their disparity alone.
"""

import numpy as np
from jaxtyping import Float, UInt8

from stereoweave.errors import StereoweaveError
from stereoweave.stereo import View


def project_right(left: UInt8[np.ndarray, "h w 3"], disparity_px: Float[np.ndarray, "h w"]) -> View:
    """The right view, made of the left image by forward projection; black and not `drawn` without a source.

    Column x of the left image goes to the column of the right one that is nearest to x - disparity_px. Where
    several land, the nearer surface stays. The paper says no more than "projected from the left images".

    Args:
        left: uint8 RGB [H, W, 3].
        disparity_px: [H, W], of the left view; a pixel whose disparity is NaN or infinite goes nowhere.
    """
    if disparity_px.shape != left.shape[:2]:
        raise StereoweaveError(
            f"disparity_px: expected the left image's shape {left.shape[:2]}, found {disparity_px.shape}"
        )
    # np.rint sends halves to even columns: a surface at 0.5 px would lose every second one.
    landed = np.floor(np.arange(left.shape[1]) - disparity_px + 0.5)
    inside = (landed >= 0) & (landed < left.shape[1])
    target = np.nonzero(inside)[0], landed[inside].astype(np.intp)
    image, drawn = np.zeros_like(left), np.zeros(disparity_px.shape, bool)
    # Of two pixels that land together the nearer came from farther right: from left to right, it stays.
    image[target], drawn[target] = left[inside], True
    return View(image=image, drawn=drawn)


def fill_from_rows(view: View) -> UInt8[np.ndarray, "h w 3"]:
    """The view's image with each pixel that was not drawn taken from the next drawn one to its right.

    Without one it takes the last to its left. In a right view made of the left image a nearer surface moves
    farther to the left, so that what it uncovers has the background on its right: this needs no disparity,
    and treats all methods alike. A row without any drawn pixel takes the one above; above the first row that
    has some, all is black.
    """
    height, width = view.drawn.shape
    after = np.where(view.drawn, np.arange(width), width)
    after = np.minimum.accumulate(after[:, ::-1], axis=1)[:, ::-1]
    last = width - 1 - view.drawn[:, ::-1].argmax(axis=1)
    source = np.where(after < width, after, last[:, None])
    image = np.where(view.drawn[..., None], view.image, np.uint8(0))
    filled = np.take_along_axis(image, source[..., None], axis=1)
    above = np.maximum.accumulate(np.where(view.drawn.any(axis=1), np.arange(height), 0))
    return filled[above]
