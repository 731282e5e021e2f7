"""What a camera beside those of a known pair would see: true disparity, and who else sees it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from stereoweave.data.samples import find_hidden
from stereoweave.matching.opencv import fill_rows
from stereoweave.stereo import Sample

# Neighbours up to this far apart are one surface. A larger step is an edge, as in edges.py.
_JOINED_PX = 2.0
# Of one surface, so that it has no cracks where the view magnifies it: by 3 at most between the cameras.
_SAMPLES_A_PIXEL = 4


@dataclass(frozen=True, kw_only=True)
class ViewTruth:
    """What a new view shows; arrays are [H, W].

    Attributes:
        disparity_px: Of the surface in each pixel, in pixels between the left and the right photograph; NaN
            where no pixel of known disparity shows it.
        one_sees: Of known disparity, and hidden from one of the two photographs.
        none_sees: Shown by no pixel of either, those of unknown disparity taken as by `fill_unknown`.
    """

    disparity_px: Float[np.ndarray, "h w"]
    one_sees: Bool[np.ndarray, "h w"]
    none_sees: Bool[np.ndarray, "h w"]


def find_view_truth(sample: Sample, position: float) -> ViewTruth:
    """What the view from a position shows of a pair: the nearest of what lands there from either side.

    Args:
        sample: With both disparities; where one is unknown nothing is said to be hidden.
        position: 0 is the left camera, 1 the right one.
    """
    sides = (sample.disparity_px, 0 - position), (sample.right_disparity_px, 1 - position)
    disparity_px = np.fmax(*(land_disparities(side_px, way) for side_px, way in sides))
    filled_px = np.fmax(*(land_disparities(fill_unknown(side_px), way) for side_px, way in sides))
    from_left, from_right = (_find_hidden_from(disparity_px, side_px, way) for side_px, way in sides)
    return ViewTruth(
        disparity_px=disparity_px, one_sees=from_left ^ from_right, none_sees=np.isnan(filled_px)
    )


def land_disparities(disparity_px: Float[np.ndarray, "h w"], way: float) -> Float[np.ndarray, "h w"]:
    """The nearest disparity that lands on each pixel of a view [H, W]; NaN where none does.

    Args:
        disparity_px: Of a photograph; NaN where it is unknown.
        way: Column x lands at x + way * disparity_px, on the pixel that is nearest.
    """
    height, width = disparity_px.shape
    landed = np.full((height, width), -np.inf, np.float32)
    to_next_px = np.diff(disparity_px, append=np.nan)
    joined = np.abs(to_next_px) <= _JOINED_PX
    for share in np.arange(_SAMPLES_A_PIXEL) / _SAMPLES_A_PIXEL:
        values_px = np.where(joined, disparity_px + share * to_next_px, np.nan) if share else disparity_px
        columns = np.floor(np.arange(width) + share + way * values_px + 0.5)
        inside = (columns >= 0) & (columns < width)
        places = np.nonzero(inside)[0], columns[inside].astype(np.intp)
        np.maximum.at(landed, places, values_px[inside].astype(np.float32))
    return np.where(np.isfinite(landed), landed, np.float32(np.nan))


def fill_unknown(disparity_px: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """The map with NaN filled from the farther of its known neighbours along the row, as by `fill_rows`."""
    # To that function 0 is unknown, which is the sky's true disparity.
    lift_px = 1 - np.min(disparity_px, where=np.isfinite(disparity_px), initial=0)
    return fill_rows(np.nan_to_num(disparity_px + lift_px).astype(np.float32)) - lift_px


def _find_hidden_from(
    disparity_px: Float[np.ndarray, "h w"], side_px: Float[np.ndarray, "h w"], way: float
) -> Bool[np.ndarray, "h w"]:
    """Pixels of the new view that the photograph which lands in it by `way` does not see."""
    if way < 0:  # the photograph was taken to the left: in a mirror, to the right
        return _find_hidden_from(disparity_px[:, ::-1], side_px[:, ::-1], -way)[:, ::-1]
    return find_hidden(way * disparity_px, way * side_px)
