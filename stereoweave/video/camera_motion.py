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
from jaxtyping import Float, Float32, Float64, UInt8

# One corner is tracked in each cell of this size, at half size, if its contrast exceeds the noise.
_CELL_PX, _LEAST_CORNER = 12, 5e-5
_WINDOW_PX, _LEVELS = 13, 4
_ROUNDS = 8
# Corners that are farther off than this multiple of the median do not count; the median is at least the
# second number. A corner follows the camera if it is off by less than the third.
_TUKEY, _LEAST_SPREAD_PX, _FOLLOWS_PX = 4.0, 0.1, 1.0
_LEAST_CORNERS = 60
# Places are in units of the width, disparities in units of 1/10 of it, so that one ridge suits all.
_DISPARITY_UNIT = 0.1
# Keeps the fit defined where all disparities are equal, as of a picture on a wall.
_RIDGE = 1e-6
_LEAST_SHARE = 0.5


class TrackedCorners(NamedTuple):
    """Corners of a frame and their disparities.

    Attributes:
        grey: uint8 [H2, W2], left image at half size.
        places_px: float32 [N, 2], columns and rows at half size.
        points: float64 [N, 4], their (x, y, 1, d) in units of the fit.
        width_px: Width of the frame at full size.
    """

    grey: np.ndarray
    places_px: np.ndarray
    points: np.ndarray
    width_px: int


def find_corners(grey: UInt8[np.ndarray, "h2 w2"], disparity_px: Float[np.ndarray, "h w"]) -> TrackedCorners:
    """Return the strongest corner of each cell of a left image at half size, with its disparity."""
    strength = cv2.cornerMinEigenVal(grey, 5)
    height, width = (side // _CELL_PX for side in strength.shape)
    cells = strength[: height * _CELL_PX, : width * _CELL_PX].reshape(height, _CELL_PX, width, _CELL_PX)
    cells = cells.transpose(0, 2, 1, 3).reshape(height, width, _CELL_PX**2)
    rows, columns = np.indices((height, width)) * _CELL_PX + np.array(np.divmod(cells.argmax(2), _CELL_PX))
    strong = cells.max(2) > _LEAST_CORNER
    rows, columns = rows[strong], columns[strong]
    d_px = disparity_px[2 * rows, 2 * columns].astype(np.float64)
    points = _normalise(2.0 * columns + 0.5, 2.0 * rows + 0.5, d_px, disparity_px.shape[1])
    return TrackedCorners(
        grey, np.stack([columns, rows], 1).astype(np.float32), points, disparity_px.shape[1]
    )


def fit_camera_motion(
    corners: TrackedCorners, grey: UInt8[np.ndarray, "h2 w2"]
) -> Float64[np.ndarray, "4 4"] | None:
    """Return the matrix that moves the points (x, y, 1, d) of a frame to another frame, in full-size pixels.

    Args:
        corners: Corners of the first frame.
        grey: Left image of the other frame, at half size.

    Returns:
        The matrix, or None if most of the corners are not found again or move otherwise.
    """
    if len(corners.places_px) < _LEAST_CORNERS:
        return None
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        corners.grey,
        grey,
        corners.places_px,
        None,
        winSize=(_WINDOW_PX, _WINDOW_PX),
        maxLevel=_LEVELS,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 12, 0.02),
    )
    kept = found[:, 0] > 0
    if kept.sum() < _LEAST_CORNERS:
        return None
    columns, rows = 2.0 * there[kept].T.astype(np.float64) + 0.5
    matrix, share = _fit_robustly(corners.points[kept], np.stack([columns, rows], 1) / corners.width_px)
    # Corners that were lost do not follow the camera.
    if share * kept.mean() < _LEAST_SHARE:
        return None
    unit = np.diag([corners.width_px, corners.width_px, 1.0, _DISPARITY_UNIT * corners.width_px])
    return unit @ matrix @ np.linalg.inv(unit)


def _normalise(
    columns: np.ndarray, rows: np.ndarray, disparity_px: np.ndarray, width_px: int
) -> Float64[np.ndarray, "n 4"]:
    ones = np.ones_like(disparity_px)
    return np.stack([columns, rows, ones, disparity_px / _DISPARITY_UNIT], 1) / [
        width_px,
        width_px,
        1,
        width_px,
    ]


def _fit_robustly(
    points: Float64[np.ndarray, "n 4"], there: Float64[np.ndarray, "n 2"]
) -> tuple[Float64[np.ndarray, "4 4"], float]:
    """Return the matrix that fits most points, by Tukey's weights, and the share of the points it fits.

    The equations are linear in the matrix: its first two rows, minus the new place times the third row, are 0
    for each point. The third row begins with that of the unit matrix, and the last row keeps it: a point twice
    as far away has half the disparity.
    """
    weights, width = np.ones(len(points)), 1.0
    still = np.eye(4)[:3, :]
    matrix = np.eye(4)
    x, y, _, d = points.T
    nothing = np.zeros_like(points)
    # Unknown: rows 0 and 1, and three numbers of row 2, as changes from the unit matrix.
    of_third = np.stack([x, y, d], 1)
    along = np.concatenate([points, nothing, -there[:, :1] * of_third], 1)
    down = np.concatenate([nothing, points, -there[:, 1:] * of_third], 1)
    moved = there - points[:, :2]
    reach = 1.0
    share = 0.0
    for _ in range(_ROUNDS):
        normal = (along * weights[:, None]).T @ along + (down * weights[:, None]).T @ down
        right = (along * weights[:, None]).T @ moved[:, 0] + (down * weights[:, None]).T @ moved[:, 1]
        change = np.linalg.solve(normal + _RIDGE * weights.sum() * np.eye(11), right)
        matrix[:2] = still[:2] + change[:8].reshape(2, 4)
        matrix[2] = still[2] + [change[8], change[9], 0, change[10]]
        placed = points @ matrix.T
        apart = np.hypot(*(placed[:, :2] / placed[:, 2:3] - there).T)
        reach = _TUKEY * max(float(np.median(apart)), _LEAST_SPREAD_PX / 640)
        weights = np.maximum(1 - (apart / reach) ** 2, 0) ** 2
    share = float((apart < _FOLLOWS_PX / 640).mean())
    return matrix, share
