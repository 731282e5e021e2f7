"""Ground truth of a new view of a known pair: disparity, and how many cameras see each pixel."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from stereoweave.bench.opencv_matchers import fill_rows
from stereoweave.data.samples import find_occluded
from stereoweave.stereo import Sample

# Neighbours whose disparities differ by at most this much are on the same surface; a larger step is an edge.
_JOINED_PX = 2.0
# Samples per pixel of a surface. They leave no cracks in a view between the cameras, which magnifies surfaces
# up to 3 times.
_SAMPLES_A_PIXEL = 4


@dataclass(frozen=True, kw_only=True)
class ViewTruth:
    """Ground truth of a new view; arrays are [H, W].

    Attributes:
        disparity_px: Disparity, from the left to the right image, of the surface in each pixel; NaN where no
            pixel of known disparity lands.
        one_sees: Mask of pixels of known disparity that only one of the two images shows.
        none_sees: Mask of pixels that neither image shows, after `fill_unknown` has filled unknown disparity.
    """

    disparity_px: Float[np.ndarray, "h w"]
    one_sees: Bool[np.ndarray, "h w"]
    none_sees: Bool[np.ndarray, "h w"]


def find_view_truth(sample: Sample, position: float) -> ViewTruth:
    """Return a view's ground truth: the nearest surface that lands on each pixel from either image.

    Args:
        sample: Sample with both disparities; pixels of unknown disparity never count as occluded.
        position: Position of the view; 0 is the left camera and 1 the right one.
    """
    sides = (sample.disparity_px, 0 - position), (sample.right_disparity_px, 1 - position)
    disparity_px = np.fmax(*(land_disparities(side_px, way) for side_px, way in sides))
    filled_px = np.fmax(*(land_disparities(fill_unknown(side_px), way) for side_px, way in sides))
    from_left, from_right = (_find_occluded_from(disparity_px, side_px, way) for side_px, way in sides)
    return ViewTruth(
        disparity_px=disparity_px, one_sees=from_left ^ from_right, none_sees=np.isnan(filled_px)
    )


def land_disparities(disparity_px: Float[np.ndarray, "h w"], way: float) -> Float[np.ndarray, "h w"]:
    """Return the disparity of the nearest surface at each pixel of a view [H, W]; NaN where nothing lands.

    Args:
        disparity_px: Disparity of an input image; NaN where unknown.
        way: Shift in px per px of disparity: column x lands on the pixel nearest to x + way * disparity_px.
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
    """Fill NaN with the farther of the known neighbours along the row, as `fill_rows` does."""
    # `fill_rows` treats 0 as unknown, but 0 is the true disparity of the sky.
    lift_px = 1 - np.min(disparity_px, where=np.isfinite(disparity_px), initial=0)
    return fill_rows(np.nan_to_num(disparity_px + lift_px).astype(np.float32)) - lift_px


def _find_occluded_from(
    disparity_px: Float[np.ndarray, "h w"], side_px: Float[np.ndarray, "h w"], way: float
) -> Bool[np.ndarray, "h w"]:
    """Return the mask of the view's pixels that an image does not show; for `way` see `land_disparities`."""
    if way < 0:
        # The image was taken to the left of the view; after mirroring, it lies to the right.
        return _find_occluded_from(disparity_px[:, ::-1], side_px[:, ::-1], -way)[:, ::-1]
    return find_occluded(way * disparity_px, way * side_px)
