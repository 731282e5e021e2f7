"""Kernels that move the points of a frame to another one by the camera's motion (`camera_motion`)."""

import typing

from stereoweave.system.jit import kernel

_IN_FRONT_PX = 1.0
"""A point hides another one if its disparity is greater by more than this."""


@kernel
@typing.no_type_check
def splat(matrix, right, disparity_px, offset_px, nearest_px, source, new_offset_px):
    """Write to each pixel of the other frame the index of the point that it shows, -1 where none does.

    Points are not rounded to pixels: each has an offset from its pixel, so that it does not stand still while
    the camera moves by less than half a pixel a frame. A pixel between two points of one surface, as where a
    surface comes nearer, takes one of them.

    `matrix` float64 [4, 4] moves (x, y, 1, d) of the left view, `right` is 1 for the right view, else 0.
    `disparity_px`, `nearest_px` and `source` (int32) are [H, W], `offset_px` and `new_offset_px` [H, W, 2]:
    to the right and down. `nearest_px` becomes the disparity of the points in the other frame.
    """
    height, width = disparity_px.shape
    for y in range(height):
        for x in range(width):
            source[y, x] = -1
            nearest_px[y, x] = -1e9
            new_offset_px[y, x, 0] = new_offset_px[y, x, 1] = 0.0
    for y in range(height):
        for x in range(width):
            d = disparity_px[y, x]
            column = x + offset_px[y, x, 0] + right * d
            row = y + offset_px[y, x, 1]
            third = matrix[2, 0] * column + matrix[2, 1] * row + matrix[2, 2] + matrix[2, 3] * d
            there_px = d / third
            to_column = (
                matrix[0, 0] * column + matrix[0, 1] * row + matrix[0, 2] + matrix[0, 3] * d
            ) / third - right * there_px
            to_row = (matrix[1, 0] * column + matrix[1, 1] * row + matrix[1, 2] + matrix[1, 3] * d) / third
            if not (-0.5 < to_column < width - 0.5 and -0.5 < to_row < height - 0.5):
                continue
            i, j = int(round(to_row)), int(round(to_column))
            if source[i, j] >= 0:
                if there_px < nearest_px[i, j] - _IN_FRONT_PX:
                    continue
                if there_px <= nearest_px[i, j] + _IN_FRONT_PX:
                    # Of two points of one surface, the one nearer to the pixel's centre.
                    before = new_offset_px[i, j, 0] ** 2 + new_offset_px[i, j, 1] ** 2
                    if before <= (to_column - j) ** 2 + (to_row - i) ** 2:
                        continue
            source[i, j] = y * width + x
            nearest_px[i, j] = there_px
            new_offset_px[i, j, 0] = to_column - j
            new_offset_px[i, j, 1] = to_row - i
    # Cracks: both neighbours along a row or a column belong to one surface, in front of the pixel's own.
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            before_px, after_px = nearest_px[y, x - 1], nearest_px[y, x + 1]
            step = 1
            if not abs(before_px - after_px) <= 2 * _IN_FRONT_PX or before_px < -1e8:
                before_px, after_px = nearest_px[y - 1, x], nearest_px[y + 1, x]
                step = width
            if (
                abs(before_px - after_px) <= 2 * _IN_FRONT_PX
                and before_px > nearest_px[y, x] + 2 * _IN_FRONT_PX
            ):
                index = source[y, x - 1] if step == 1 else source[y - 1, x]
                if index >= 0:
                    source[y, x] = index
                    nearest_px[y, x] = before_px
                    new_offset_px[y, x, 0] = new_offset_px[y, x, 1] = 0.0


@kernel
@typing.no_type_check
def find_places(source, offset_px, new_offset_px, to_source_px, known):
    """Write for every second pixel the offset in px to its place in the frame of `source`, and whether it is known.

    `to_source_px` is float32 [H2, W2, 2], `known` bool [H2, W2].
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
