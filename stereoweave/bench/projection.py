"""Projection of the left image to the right view.

Used for Table I of "Fast Depth Estimation for View Synthesis". `rendering` makes better views, from both
images. This projection only serves to compare methods: it neither blends nor refines, so the views of two
methods differ only because of their disparities.
"""

import numpy as np
from jaxtyping import Float, UInt8

from stereoweave.errors import StereoweaveError
from stereoweave.stereo import View


def project_right(left: UInt8[np.ndarray, "h w 3"], disparity_px: Float[np.ndarray, "h w"]) -> View:
    """Project the left image to the right view; pixels without a source are black and not `drawn`.

    Column x of the left image goes to the right image's column nearest to x - disparity_px. Where several
    pixels land in the same column, the nearest surface wins. The paper only says
    "projected from the left images".

    Args:
        left: uint8 RGB [H, W, 3].
        disparity_px: Left disparity [H, W]; pixels with NaN or infinity are not projected.
    """
    if disparity_px.shape != left.shape[:2]:
        raise StereoweaveError(
            f"disparity_px: expected the left image's shape {left.shape[:2]}, found {disparity_px.shape}"
        )
    # Not np.rint, which rounds halves to even: a surface at 0.5 px would miss every second column.
    landed = np.floor(np.arange(left.shape[1]) - disparity_px + 0.5)
    inside = (landed >= 0) & (landed < left.shape[1])
    target = np.nonzero(inside)[0], landed[inside].astype(np.intp)
    image, drawn = np.zeros_like(left), np.zeros(disparity_px.shape, bool)
    # Of two pixels that land together, the nearer comes from farther right, so it is written last.
    image[target], drawn[target] = left[inside], True
    return View(image=image, drawn=drawn)


def fill_from_rows(view: View) -> UInt8[np.ndarray, "h w 3"]:
    """Fill the pixels that were not drawn with colours of drawn pixels in the same row.

    Each takes the colour of the nearest drawn pixel on its right or, if there is none, on its left.

    In a right view projected from the left image, nearer surfaces move farther left, so the area that they
    uncover has background on its right. The fill therefore needs no disparity and treats all methods alike. A
    row without drawn pixels copies the row above. Rows above the first row with drawn pixels stay black.
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
