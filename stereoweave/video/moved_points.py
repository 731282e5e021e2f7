"""Points of a frame as the camera's motion moves them to another frame."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from stereoweave.video.motion import CameraPath
from stereoweave.video.splat_kernels import fill_cracks, find_places, splat
from stereoweave.video.temporal_kernels import Track


class MovedPoints(NamedTuple):
    """Points of a view in another frame.

    Attributes:
        source: int32 [H, W], index of the pixel whose point each pixel of the other frame shows; -1 if none.
        offset_px: float32 [H, W, 2], place of the point to the right of and below the pixel's centre.
        path: Where the points come from, at half size; None if the camera rests or its motion is unknown.
    """

    source: np.ndarray
    offset_px: np.ndarray
    path: CameraPath | None


def move_points(matrix: Float64[np.ndarray, "4 4"] | None, track: Track, right: bool) -> MovedPoints:
    """Return a view's points in another frame.

    Args:
        matrix: Motion of the camera (`find_camera_motion`); None if it rests.
        track: Points of the view.
        right: Whether the view is the right one.
    """
    height, width = track.disparity_px.shape
    if matrix is None:
        return MovedPoints(np.full((height, width), -1, np.int32), np.zeros((1, 1, 2), np.float32), None)
    source, nearest_px = np.empty((height, width), np.int32), np.empty((height, width), np.float32)
    offset_px = np.empty((height, width, 2), np.float32)
    splat(matrix, float(right), track.disparity_px, track.offset_px, nearest_px, source, offset_px)
    fill_cracks(nearest_px, source, offset_px)
    half = (height + 1) // 2, (width + 1) // 2
    path = CameraPath(np.empty((*half, 2), np.float32), np.empty(half, bool))
    find_places(source, track.offset_px, offset_px, path.to_before_px, path.known)
    return MovedPoints(source, offset_px, path)
