"""Kernels that move the points of a frame to another one by the camera's motion (`camera_motion`)."""

import typing

import numpy as np

from stereoweave.system.jit import kernel

IN_FRONT_PX = 1.0
"""A point hides another one if its disparity is greater by more than this."""
CRACK_PX = 2.0
"""A pixel is a crack in a surface that is in front of it by more than this on both sides."""
NOWHERE_PX = -1e9
"""Disparity of a pixel that shows no point."""


@kernel
@typing.no_type_check
def splat(matrix, right, disparity_px, offset_px, nearest_px, source, new_offset_px):
    """Write to each pixel of the other frame the index of the point that it shows, -1 where there is none.

    A point keeps its place between the pixels as an offset from its pixel's centre, because it would stand
    still otherwise while the camera moves by less than half a pixel a frame.

    `matrix` float64 [4, 4] moves (x, y, 1, d) of the left view; `right` is 1 for the right view, else 0.
    `disparity_px`, `nearest_px` and `source` (int32) are [H, W], and `offset_px` and `new_offset_px` [H, W,
    2] hold offsets to the right and down. `nearest_px` receives the points' disparity in the other frame.
    """
    height, width = disparity_px.shape
    source[:] = -1
    nearest_px[:] = NOWHERE_PX
    new_offset_px[:] = 0.0
    for y in range(height):
        for x in range(width):
            d = disparity_px[y, x]
            column, row = x + offset_px[y, x, 0] + right * d, y + offset_px[y, x, 1]
            third = matrix[2, 0] * column + matrix[2, 1] * row + matrix[2, 2] + matrix[2, 3] * d
            scale = 1.0 / third
            there_px = d * scale
            to_column = matrix[0, 0] * column + matrix[0, 1] * row + matrix[0, 2] + matrix[0, 3] * d
            to_row = matrix[1, 0] * column + matrix[1, 1] * row + matrix[1, 2] + matrix[1, 3] * d
            to_column, to_row = to_column * scale - right * there_px, to_row * scale
            if not (-0.5 < to_column < width - 0.5 and -0.5 < to_row < height - 0.5):
                continue
            # Faster than to round.
            i, j = int(np.floor(to_row + 0.5)), int(np.floor(to_column + 0.5))
            in_front_px = there_px - nearest_px[i, j]
            if in_front_px < -IN_FRONT_PX:
                continue
            if in_front_px <= IN_FRONT_PX:
                # Of two points of one surface, the one nearer to the pixel's centre.
                off_px2 = new_offset_px[i, j, 0] ** 2 + new_offset_px[i, j, 1] ** 2
                if off_px2 <= (to_column - j) ** 2 + (to_row - i) ** 2:
                    continue
            source[i, j] = y * width + x
            nearest_px[i, j] = there_px
            new_offset_px[i, j, 0], new_offset_px[i, j, 1] = to_column - j, to_row - i


@kernel
@typing.no_type_check
def fill_cracks(nearest_px, source, new_offset_px):
    """Fill cracks one pixel wide, which open where a surface comes nearer, with the point before.

    Both neighbours of a crack, in its row or else in its column, show one surface in front of it.
    """
    height, width = nearest_px.shape
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            in_front_px = nearest_px[y, x] + CRACK_PX
            for row, column in ((y, x - 1), (y - 1, x)):
                before_px, after_px = nearest_px[row, column], nearest_px[2 * y - row, 2 * x - column]
                if before_px > in_front_px and abs(before_px - after_px) <= CRACK_PX:
                    source[y, x] = source[row, column]
                    nearest_px[y, x] = before_px
                    new_offset_px[y, x, 0] = new_offset_px[y, x, 1] = 0.0
                    break


@kernel
@typing.no_type_check
def find_places(source, offset_px, new_offset_px, to_source_px, known):
    """Write the offset in px of every second pixel to its place in the frame of `source`.

    `to_source_px` is float32 [H2, W2, 2], and `known` [H2, W2] receives whether there is such a place.
    """
    width = source.shape[1]
    for i in range(known.shape[0]):
        for j in range(known.shape[1]):
            y, x = 2 * i, 2 * j
            index = source[y, x]
            known[i, j] = index >= 0
            to_source_px[i, j, 0] = to_source_px[i, j, 1] = 0.0
            if index >= 0:
                row, column = index // width, index % width
                to_source_px[i, j, 0] = column + offset_px[row, column, 0] - x - new_offset_px[y, x, 0]
                to_source_px[i, j, 1] = row + offset_px[row, column, 1] - y - new_offset_px[y, x, 1]
