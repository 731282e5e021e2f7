"""The largest rectangle that is valid in both pictures of a rectified pair."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from stereoweave.errors import StereoweaveError
from stereoweave.stereo import StereoCamera, StereoPair

# The largest rectangle is sought in a grid with this many cells along the longer side, and at least this many
# along the shorter side, because one invalid pixel makes a whole cell unusable.
_CELLS, _LEAST_CELLS = 256, 32


def find_content(pair: StereoPair) -> tuple[slice, slice]:
    """Return the rows and columns of the largest rectangle that is valid in both pictures.

    Raises:
        StereoweaveError: No pixel is valid in both pictures.
    """
    full = np.ones(pair.left.shape[:2], bool)
    for seen in (pair.left_seen, pair.right_seen):
        full &= True if seen is None else seen
    return find_largest_rectangle(full)


def crop(pair: StereoPair) -> StereoPair:
    """Crop a pair to the largest rectangle that is valid in both pictures, and adjust its camera.

    Raises:
        StereoweaveError: No pixel is valid in both pictures.
    """
    if pair.left_seen is None and pair.right_seen is None:
        return pair
    rows, columns = find_content(pair)
    camera = pair.camera and crop_camera(pair.camera, rows, columns)
    left, right = (np.ascontiguousarray(image[rows, columns]) for image in (pair.left, pair.right))
    return StereoPair(left=left, right=right, camera=camera)


def crop_camera(camera: StereoCamera, rows: slice, columns: slice) -> StereoCamera:
    """Return the camera of these rows and columns of its pictures."""
    return replace(camera, cx_px=camera.cx_px - columns.start, cy_px=camera.cy_px - rows.start)


def find_largest_rectangle(full: Bool[np.ndarray, "h w"]) -> tuple[slice, slice]:
    """Return the rows and columns of the largest rectangle of full cells, enlarged pixel by pixel.

    Raises:
        StereoweaveError: No cell is full.
    """
    cell_px = max(1, min(-(-max(full.shape) // _CELLS), min(full.shape) // _LEAST_CELLS))
    top, bottom, start, stop = (
        cell_px * side for side in _find_largest_of_cells(_find_full_cells(full, cell_px))
    )
    bottom, stop = min(bottom, full.shape[0]), min(stop, full.shape[1])
    for _ in range(cell_px):
        top -= top > 0 and bool(full[top - 1, start:stop].all())
        bottom += bottom < full.shape[0] and bool(full[bottom, start:stop].all())
        start -= start > 0 and bool(full[top:bottom, start - 1].all())
        stop += stop < full.shape[1] and bool(full[top:bottom, stop].all())
    return slice(top, bottom), slice(start, stop)


def _find_full_cells(full: Bool[np.ndarray, "h w"], cell_px: int) -> Bool[np.ndarray, "rows columns"]:
    """Return which cells are full; in a cell cut by the picture's border, only the pixels inside count."""
    height, width = full.shape
    padded = np.pad(full, ((0, -height % cell_px), (0, -width % cell_px)), constant_values=True)
    cells = padded.reshape(-1, cell_px, padded.shape[1] // cell_px, cell_px)
    return np.asarray(cells.all(axis=(1, 3)))


def _find_largest_of_cells(full: Bool[np.ndarray, "rows columns"]) -> tuple[int, int, int, int]:
    """Return the largest rectangle of full cells: top and bottom rows, start and stop columns.

    For each row, a histogram counts each column's consecutive full cells upwards, and a stack of bars finds
    the largest rectangle under the histogram.
    """
    best, found = 0, (0, 0, 0, 0)
    heights = np.zeros(full.shape[1], int)
    for row, cells in enumerate(full):
        heights = (heights + 1) * cells
        standing: list[tuple[int, int]] = []  # column and height, in ascending order of height
        for column, height in enumerate([*heights.tolist(), 0]):
            start = column
            while standing and standing[-1][1] >= height:
                start, bar = standing.pop()
                if bar * (column - start) > best:
                    best, found = bar * (column - start), (row + 1 - bar, row + 1, start, column)
            standing.append((start, height))
    if not best:
        raise StereoweaveError(
            "expected two pictures that overlap after rectification, found no common pixels"
        )
    return found
