"""What a photograph's background may look like where its foreground hides it: continued with its texture.

It is found once for a photograph, not for each view of it, so that it stays the same from view to view. From
every border of something nearer, the surface behind goes on as far as a camera within one baseline may look
behind it. It takes each pixel's colour from the place of that surface whose surroundings are most alike, out
of those next to where its neighbours took theirs from (Ashikhmin 2001, "Synthesizing natural textures").
"""

import math
import typing

import numpy as np

from stereoweave.rendering.canvas_kernels import NOTHING, SAME_SURFACE_PX
from stereoweave.system.jit import compiled, inlined, kernel

RIM_PX = 1
"""So far from a border the background's pixels may carry the foreground's colour."""
_PURE_PX = np.float32(1)
"""A pixel whose neighbours are nearer than it by more than this is no example for others."""
_ALIKE_PX = 2 * SAME_SURFACE_PX
"""What differs in disparity by no more than this from a surface may be an example for it."""
_LOOK_PX = 16
"""A fresh place to take colours from lies within so many pixels."""


@kernel
@typing.no_type_check
def uncover(photo, disparity_px, nearer_px, other_px, side, hidden_px, colours, first, end):
    """Write the background's disparity where neither camera sees it, else NOTHING, and its colours there.

    Args:
        photo: uint8 RGB [H, W, 3].
        disparity_px: float32 [H, W], of the photograph.
        nearer_px: float32 [H, W], how much nearer the nearest of a pixel and its eight neighbours is.
        other_px: float32 [H, W], the disparity of the other photograph.
        side: -1 for the left photograph, whose background is uncovered to the left of the foreground, and
            which shows at column x what is at x - disparity in the other; 1 for the right one.
        hidden_px: float32 [H, W] to write.
        colours: uint8 RGB [H, W, 3], of which the hidden pixels are written.
        first: the first row, which does not follow the one above.
        end: the row to end before.
    """
    width = disparity_px.shape[1]
    origins = np.empty((2, width, 2), np.int32)  # where the colours of this row and the one above come from
    borders = np.empty(width, np.int32)  # beside which pixel of the background the foreground begins
    for y in range(first, end):
        _find_hidden(disparity_px[y], other_px[y], side, hidden_px[y], borders)
        for k in range(width):
            # From the borders inwards, so that a pixel's neighbour towards the background is known.
            x = k if side < 0 else width - 1 - k
            origins[y % 2, x, 0], origins[y % 2, x, 1] = y, x
            if hidden_px[y, x] > NOTHING:
                _copy_example(
                    photo, disparity_px, nearer_px, hidden_px, colours, origins, borders[x], first, y, x, side
                )


@compiled
@typing.no_type_check
def _find_hidden(disparity_px, other_px, side, hidden_px, borders):
    """Write for a row where the background goes on behind the foreground, unseen by both cameras."""
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
            # Of two borders the closer one decides.
            if hidden_px[at] == NOTHING or abs(at - borders[at]) > abs(k):
                hidden_px[at], borders[at] = behind_px, seen


@compiled
@typing.no_type_check
def _copy_example(photo, disparity_px, nearer_px, hidden_px, colours, origins, border, first, y, x, side):
    """Write the colour of a hidden pixel, whose background is on that side of it: -1 left, 1 right."""
    width = disparity_px.shape[1]
    d = hidden_px[y, x]
    best, best_y, best_x = math.inf, -1, -1
    searches = not _can_continue(disparity_px, nearer_px, origins[y % 2, x + side], side, d)
    compared = 7 if searches else 4
    # Fresh places to take it from: all along the row where the neighbour's does not go on, else the mirrored
    # one and one that is as good as drawn by lot.
    for k in range(4 + (_LOOK_PX if searches else 2)):
        if k < 4:  # next to where a neighbour's colour comes from
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
            photo, disparity_px, hidden_px, colours, y, x, at_y, at_x, side, compared, first, best
        )
        if apart < best:
            best, best_y, best_x = apart, at_y, at_x
    if best_x < 0:
        best_y, best_x = y, min(max(border + side * RIM_PX, 0), width - 1)
    origins[y % 2, x, 0], origins[y % 2, x, 1] = best_y, best_x
    for channel in range(3):
        colours[y, x, channel] = photo[best_y, best_x, channel]


@inlined
@typing.no_type_check
def _can_continue(disparity_px, nearer_px, origin, side, d):
    """Whether what follows the origin of a neighbour's colour is an example for the next pixel."""
    return _is_example(disparity_px, nearer_px, origin[0], origin[1] - side, d)


@inlined
@typing.no_type_check
def _is_example(disparity_px, nearer_px, y, x, d):
    """Whether that is a pixel of the surface of disparity d, with none of a nearer one's colour."""
    height, width = disparity_px.shape
    if y < 0 or y >= height or x < 0 or x >= width:
        return False
    return abs(disparity_px[y, x] - d) <= _ALIKE_PX and nearer_px[y, x] <= _PURE_PX


@inlined
@typing.no_type_check
def _compare_surroundings(
    photo, disparity_px, hidden_px, colours, y, x, at_y, at_x, side, compared, first, enough
):
    """The mean squared difference of what is known around (y, x) and around (at_y, at_x)."""
    width = disparity_px.shape[1]
    total, count = 0.0, 0
    for k in range(compared):
        up, along = 0 < k < 4, side * _neighbour_offset(k)
        row, column, like_y, like_x = y - up, x + along, at_y - up, at_x + along
        if row < first or like_y < 0 or min(column, like_x) < 0 or max(column, like_x) >= width:
            continue
        seen = hidden_px[row, column] == NOTHING
        # What is neither hidden nor of this surface is the foreground.
        if seen and abs(disparity_px[row, column] - hidden_px[y, x]) > _ALIKE_PX:
            continue
        count += 1
        for channel in range(3):
            level = photo[row, column, channel] if seen else colours[row, column, channel]
            apart = np.int32(level) - np.int32(photo[like_y, like_x, channel])
            total += apart * apart
        if total >= compared * enough:
            return total
    return total / count if count else 1e9


@inlined
@typing.no_type_check
def _neighbour_offset(k):
    """How far towards the background neighbour k is: 0 beside, 1 to 3 above, from 4 on farther beside."""
    return k - 2 if k > 3 else 1 - (k == 1) - 2 * (k == 3)
