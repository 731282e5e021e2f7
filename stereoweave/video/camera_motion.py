"""Motion of a rigid scene in front of a moving camera, from tracked corners and disparity.

Where nothing moves but the camera, a point's motion depends on its place and its disparity alone. With place
(x, y) and disparity d, the vector (x, y, 1, d) of each point is multiplied by one 4x4 matrix and divided by
its third component (D. Demirdjian and R. Horaud, "Motion-Egomotion Discrimination and Motion Segmentation
from Image-Pair Streams", 2000). Optical flow is blurred at depth edges; this motion is as sharp as the
disparity.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Float64, UInt8

from stereoweave.video.motion import match_brightness

# The strongest corner of each cell of this size is tracked, at half size, if it is stronger than noise.
_CELL_PX, _LEAST_CORNER = 14, 5e-5
_CORNER_PX, _WINDOW_PX, _LEVELS = 5, 13, 4
_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 12, 0.02)
_ROUNDS = 6
# Corners that are farther off than this multiple of the median do not count; the median is at least the
# second number of px. A corner follows the camera if it is off by less than the third.
_TUKEY, _LEAST_SPREAD_PX, _FOLLOWS_PX = 4.0, 0.1, 1.0
# The fit has 11 unknowns, and each corner gives two equations; a frame of 256x192 has 54 cells.
_LEAST_CORNERS, _LEAST_SHARE = 40, 0.5
# Places are in units of the width, disparities in units of a tenth of it, so that one ridge suits all.
_DISPARITY_UNIT = 0.1
# Keeps the fit defined where all disparities are equal, as of a picture on a wall.
_RIDGE = 1e-6
# A camera that moves its picture by less than this rests.
_LEAST_MOTION_PX = 0.1


class TrackedCorners(NamedTuple):
    """Corners of a frame.

    Attributes:
        grey: uint8 [H2, W2], left image at half size.
        places_px: float32 [N, 2], columns and rows at half size.
        points: float64 [N, 4], (x, y, 1, d) of each corner, in full-size pixels.
        width_px: Width of the frame at full size.
    """

    grey: np.ndarray
    places_px: np.ndarray
    points: np.ndarray
    width_px: int


def find_corners(grey: UInt8[np.ndarray, "h2 w2"], disparity_px: Float[np.ndarray, "h w"]) -> TrackedCorners:
    """Return the strongest corner of each cell of a left image at half size, with its disparity."""
    strength = cv2.cornerMinEigenVal(grey, _CORNER_PX)
    height, width = (side // _CELL_PX for side in strength.shape)
    cells = strength[: height * _CELL_PX, : width * _CELL_PX].reshape(height, _CELL_PX, width, _CELL_PX)
    by_cell = cells.transpose(0, 2, 1, 3).reshape(height, width, _CELL_PX**2)
    within = np.array(np.divmod(by_cell.argmax(2), _CELL_PX))
    rows, columns = (_CELL_PX * np.indices((height, width)) + within)[:, by_cell.max(2) > _LEAST_CORNER]
    d_px = disparity_px[2 * rows, 2 * columns].astype(np.float64)
    # A pixel at half size covers two pixels in each direction.
    points = np.stack([2.0 * columns + 0.5, 2.0 * rows + 0.5, np.ones_like(d_px), d_px], 1)
    places_px = np.stack([columns, rows], 1).astype(np.float32)
    return TrackedCorners(grey, places_px, points, disparity_px.shape[1])


def find_camera_motion(
    corners: TrackedCorners, grey: UInt8[np.ndarray, "h2 w2"]
) -> Float64[np.ndarray, "4 4"] | None:
    """Return the matrix that moves the points (x, y, 1, d) of a frame to another frame, in full-size pixels.

    Args:
        corners: Corners of the first frame.
        grey: Left image of the other frame, at half size.

    Returns:
        The matrix, or None if the camera rests, or if most of the corners are lost or move otherwise.
    """
    if len(corners.points) < _LEAST_CORNERS:
        return None
    before = match_brightness(corners.grey, grey)
    there, found, _ = cv2.calcOpticalFlowPyrLK(  # type: ignore[call-overload]
        before, grey, corners.places_px, None, winSize=(_WINDOW_PX,) * 2, maxLevel=_LEVELS, criteria=_STOP
    )
    kept = found[:, 0] > 0
    if kept.sum() < _LEAST_CORNERS:
        return None
    points, there_px = corners.points[kept], 2.0 * there[kept].astype(np.float64) + 0.5
    if np.percentile(np.hypot(*(there_px - points[:, :2]).T), 90) < _LEAST_MOTION_PX:
        return None
    unit = np.diag([1.0, 1.0, 1.0 / corners.width_px, _DISPARITY_UNIT]) * corners.width_px
    matrix = unit @ _fit_robustly(
        points @ np.linalg.inv(unit), there_px / corners.width_px, 1 / corners.width_px
    )
    matrix = matrix @ np.linalg.inv(unit)
    apart_px = _measure_distances(matrix, points, there_px)
    # Corners that were lost do not follow the camera.
    return matrix if (apart_px < _FOLLOWS_PX).mean() * kept.mean() >= _LEAST_SHARE else None


def _fit_robustly(
    points: Float64[np.ndarray, "n 4"], there: Float64[np.ndarray, "n 2"], px: float
) -> Float64[np.ndarray, "4 4"]:
    """Return the matrix that moves most points there, by least squares with Tukey's weights.

    Each point gives two equations that are linear in the matrix: its new place times the third row is the
    first row, or the second. The last row is that of the unit matrix, because a point twice as far away has
    half the disparity. `px` is the length of a pixel.
    """
    nothing, known = np.zeros_like(points), points[:, [0, 1, 3]]
    across = np.concatenate([points, nothing, -there[:, :1] * known], 1)
    down = np.concatenate([nothing, points, -there[:, 1:] * known], 1)
    equations, moved = np.concatenate([across, down]), (there - points[:, :2]).T.ravel()
    weights, matrix = np.ones(len(points)), np.eye(4)
    for _ in range(_ROUNDS):
        weighted = equations.T * np.tile(weights, 2)
        ridge = _RIDGE * weights.sum() * np.eye(equations.shape[1])
        change = np.linalg.solve(weighted @ equations + ridge, weighted @ moved)
        matrix[:2] = np.eye(4)[:2] + change[:8].reshape(2, 4)
        matrix[2, [0, 1, 3]] = change[8:]
        apart = _measure_distances(matrix, points, there)
        reach = _TUKEY * max(float(np.median(apart)), _LEAST_SPREAD_PX * px)
        weights = np.maximum(1 - (apart / reach) ** 2, 0) ** 2
    return matrix


def _measure_distances(
    matrix: Float64[np.ndarray, "4 4"], points: Float64[np.ndarray, "n 4"], there: Float64[np.ndarray, "n 2"]
) -> Float64[np.ndarray, " n"]:
    """Return how far each point, moved by the matrix, is from where it is found."""
    placed = points @ matrix.T
    return np.hypot(*(placed[:, :2] / placed[:, 2:3] - there).T)
