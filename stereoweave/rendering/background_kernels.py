"""Kernels that continue an image's background behind its foreground, with texture.

The hidden background is synthesised once per image rather than once per view, so that it is consistent
between views. At every depth edge, the farther surface is continued as far behind the edge as a camera within
one baseline can see. Each hidden pixel copies the pixel of that surface whose neighbourhood is most similar.
The candidates lie next to the pixels from which the hidden pixel's neighbours were copied (Ashikhmin 2001,
"Synthesizing natural textures").
"""

import math
import typing

import numpy as np

from stereoweave.rendering.canvas_kernels import NOTHING, SAME_SURFACE_PX
from stereoweave.system.jit import compiled, inlined, kernel

RIM_PX = 1
"""Within this distance of a depth edge, background pixels may carry the foreground's colour."""
_PURE_PX = np.float32(1)
"""A pixel is not copied if a neighbour's disparity exceeds the pixel's own by more than this."""
_ALIKE_PX = 2 * SAME_SURFACE_PX
"""Largest disparity difference between a surface and the pixels copied to it."""
_LOOK_PX = 16
"""Largest distance of candidates that are not next to the source of a neighbour's colour."""


@kernel
@typing.no_type_check
def uncover(image, disparity_px, nearer_px, other_px, side, hidden_px, colours, first, end):
    """Write the disparity and colour of the background that neither camera sees.

    Args:
        image: uint8 RGB [H, W, 3].
        disparity_px: float32 [H, W], disparity of `image`.
        nearer_px: float32 [H, W], largest disparity in the 3x3 window minus the pixel's own.
        other_px: float32 [H, W], the other image's disparity.
        side: -1 for the left image, whose background is uncovered to the left of the foreground and whose
            column x corresponds to x - disparity in the other image; 1 for the right image.
        hidden_px: Output, float32 [H, W]: disparity of the hidden background; NOTHING elsewhere.
        colours: Output, uint8 RGB [H, W, 3]; written at hidden pixels only.
        first: First row of the band; rows above it are not used.
        end: Row after the last row of the band.
    """
    width = disparity_px.shape[1]
    origins = np.empty((2, width, 2), np.int32)  # source pixels of the colours in this row and the row above
    borders = np.empty(width, np.int32)  # column of the last visible background pixel before the foreground
    for y in range(first, end):
        _find_hidden(disparity_px[y], other_px[y], side, hidden_px[y], borders)
        for k in range(width):
            # Go from the edges inwards, so that the neighbour towards the background is already written.
            x = k if side < 0 else width - 1 - k
            origins[y % 2, x, 0], origins[y % 2, x, 1] = y, x
            if hidden_px[y, x] > NOTHING:
                _copy_example(
                    image, disparity_px, nearer_px, hidden_px, colours, origins, borders[x], first, y, x, side
                )


@compiled
@typing.no_type_check
def _find_hidden(disparity_px, other_px, side, hidden_px, borders):
    """Write the disparity of a row's background where the foreground hides it from both cameras."""
    width = disparity_px.shape[0]
    hidden_px[:] = NOTHING
    for seen in range(width):
        beside = seen - side
        if beside < 0 or beside >= width or disparity_px[beside] - disparity_px[seen] <= SAME_SURFACE_PX:
            continue
        behind_px = disparity_px[seen]
        for k in range(1, 3):
            behind_px = min(behind_px, disparity_px[min(max(seen + side * k, 0), width - 1)])
        reach = math.ceil(disparity_px[beside] - behind_px) + 1
        for k in range(1 - RIM_PX, reach + 1):
            at = seen - side * k
            if at < 0 or at >= width or (k > 0 and disparity_px[at] <= behind_px + SAME_SURFACE_PX):
                break
            there = round(at + side * behind_px)
            if 0 <= there < width and abs(other_px[there] - behind_px) <= SAME_SURFACE_PX:
                continue
            # Of two edges, the closer one decides.
            if hidden_px[at] == NOTHING or abs(at - borders[at]) > abs(k):
                hidden_px[at], borders[at] = behind_px, seen


@compiled
@typing.no_type_check
def _copy_example(image, disparity_px, nearer_px, hidden_px, colours, origins, border, first, y, x, side):
    """Write the colour of a hidden pixel; `side` is the direction of its visible background, -1 or 1."""
    width = disparity_px.shape[1]
    d = hidden_px[y, x]
    best, best_y, best_x = math.inf, -1, -1
    searches = not _can_continue(disparity_px, nearer_px, origins[y % 2, x + side], side, d)
    compared = 7 if searches else 4
    # New candidates: a stretch of the row if the neighbour's source cannot continue, else the mirrored pixel
    # and a pseudo-random pixel.
    for k in range(4 + (_LOOK_PX if searches else 2)):
        if k < 4:  # next to the source of a neighbour's colour
            row, column = y - (k > 0), x + side * _neighbour_offset(k)
            if row < first or column < 0 or column >= width:
                continue
            at_y, at_x = origins[row % 2, column, 0] + y - row, origins[row % 2, column, 1] + x - column
        elif searches or k == 4:
            at_y, at_x = y, border + side * (RIM_PX + (k - 4 if searches else abs(x - border)))
        else:
            at_y, at_x = y - (x * 31 + y * 17) % 8, border + side * (2 + (x * 7919 + y * 104729) % _LOOK_PX)
        if (at_y == best_y and at_x == best_x) or not _is_example(disparity_px, nearer_px, at_y, at_x, d):
            continue
        apart = _compare_surroundings(
            image, disparity_px, hidden_px, colours, y, x, at_y, at_x, side, compared, first, best
        )
        if apart < best:
            best, best_y, best_x = apart, at_y, at_x
    if best_x < 0:
        best_y, best_x = y, min(max(border + side * RIM_PX, 0), width - 1)
    origins[y % 2, x, 0], origins[y % 2, x, 1] = best_y, best_x
    for channel in range(3):
        colours[y, x, channel] = image[best_y, best_x, channel]


@inlined
@typing.no_type_check
def _can_continue(disparity_px, nearer_px, origin, side, d):
    """Return whether the pixel that follows the source of the neighbour's colour can be copied too."""
    return _is_example(disparity_px, nearer_px, origin[0], origin[1] - side, d)


@inlined
@typing.no_type_check
def _is_example(disparity_px, nearer_px, y, x, d):
    """Return whether the pixel is on the surface of disparity d and free of a nearer surface's colour."""
    height, width = disparity_px.shape
    if y < 0 or y >= height or x < 0 or x >= width:
        return False
    return abs(disparity_px[y, x] - d) <= _ALIKE_PX and nearer_px[y, x] <= _PURE_PX


@inlined
@typing.no_type_check
def _compare_surroundings(
    image, disparity_px, hidden_px, colours, y, x, at_y, at_x, side, compared, first, enough
):
    """Return the mean squared difference between the known neighbours of (y, x) and those of (at_y, at_x)."""
    width = disparity_px.shape[1]
    total, count = 0.0, 0
    for k in range(compared):
        up, along = 0 < k < 4, side * _neighbour_offset(k)
        row, column, like_y, like_x = y - up, x + along, at_y - up, at_x + along
        if row < first or like_y < 0 or min(column, like_x) < 0 or max(column, like_x) >= width:
            continue
        seen = hidden_px[row, column] == NOTHING
        # A pixel that is neither hidden nor on this surface is foreground.
        if seen and abs(disparity_px[row, column] - hidden_px[y, x]) > _ALIKE_PX:
            continue
        count += 1
        for channel in range(3):
            level = image[row, column, channel] if seen else colours[row, column, channel]
            apart = np.int32(level) - np.int32(image[like_y, like_x, channel])
            total += apart * apart
        if total >= compared * enough:
            return total
    return total / count if count else 1e9


@inlined
@typing.no_type_check
def _neighbour_offset(k):
    """Return the column offset of neighbour k towards the background.

    Neighbour 0 is beside the pixel, neighbours 1 to 3 are in the row above, and neighbours 4 and up are
    farther along the pixel's own row.
    """
    return k - 2 if k > 3 else 1 - (k == 1) - 2 * (k == 3)
