"""Hole filling: background colours for the pixels of the new view that neither image shows."""

import math
import typing

from stereoweave.rendering.canvas_kernels import NOTHING, SAME_SURFACE_PX
from stereoweave.system.jit import compiled, kernel

NARROW_PX = 8
"""Largest width of a hole that is filled with one colour, without texture."""


@kernel
@typing.no_type_check
def paint_background(hidden_px, colours, shift, offset_px, canvas):
    """Paint the hidden background (`background_kernels.uncover`) where the canvas has no pure colour.

    Impure pixels farther away than that background keep their colour, so that a gap in a fence stays open.
    """
    height, width = hidden_px.shape
    for y in range(height):
        for k in range(width):
            # Visit the nearest of the pixels that land on the same place first, to paint the place only once.
            x = k if shift > 0 else width - 1 - k
            d = hidden_px[y, x]
            if d == NOTHING:
                continue
            at = x + shift * d + offset_px
            for u in range(max(math.ceil(at - 0.5), 0), min(math.ceil(at + 0.5) - 1, width - 1) + 1):
                own_px = canvas.surface_px[y, u]
                farther = own_px > NOTHING and own_px < d - SAME_SURFACE_PX
                if farther or canvas.pure[y, u]:
                    continue
                _mix(hidden_px[y], colours[y], x, u - at, canvas.image[y, u])
                canvas.surface_px[y, u], canvas.pure[y, u], canvas.drawn[y, u] = d, True, False


@compiled
@typing.no_type_check
def _mix(hidden_px, colours, x, beyond, colour):
    """Write the colour `beyond` pixels away from the hidden pixel x, interpolated with its neighbour."""
    beside = x + (1 if beyond > 0 else -1)
    part = abs(beyond)
    if beside < 0 or beside >= hidden_px.shape[0] or abs(hidden_px[beside] - hidden_px[x]) > SAME_SURFACE_PX:
        part = 0.0
        beside = x
    for channel in range(3):
        colour[channel] = (1.0 - part) * colours[x, channel] + part * colours[beside, channel] + 0.5


@kernel
@typing.no_type_check
def fill(canvas):
    """Fill each remaining run of impure pixels from the farther of the two surfaces beside it.

    A narrow run gets the surface's mean colour, which gives the least error. A wide run gets the
    surface's mirrored texture, and so does a run at the image border, which has a surface on one side only.
    As in `paint_background`, impure pixels farther away than that surface keep their colour.
    """
    surface_px, pure, drawn = canvas.surface_px, canvas.pure, canvas.drawn
    height, width = pure.shape
    for y in range(height):
        start = 0
        while start < width:
            if pure[y, start]:
                start += 1
                continue
            end = start
            while end < width and not pure[y, end]:
                drawn[y, end] = surface_px[y, end] > NOTHING
                end += 1
            from_left = end == width or (start > 0 and surface_px[y, start - 1] <= surface_px[y, end])
            source = start - 1 if from_left else end
            mirrors = start == 0 or end == width or end - start > NARROW_PX
            if source >= 0:
                colour = _average_beside(canvas, y, source, -1 if from_left else 1)
                for u in range(start, end):
                    if not drawn[y, u] or surface_px[y, u] >= surface_px[y, source] - SAME_SURFACE_PX:
                        _fill_pixel(canvas, y, u, source, colour, mirrors)
            start = end


@compiled
@typing.no_type_check
def _average_beside(canvas, y, column, inwards):
    """Return the mean colour of the surface at (y, column).

    The mean is taken over two columns and three rows, with row y counted twice.
    """
    # Rounds a mean that is stored in one byte; levels of float32 already have the half.
    half = 0.5 if canvas.image.itemsize == 1 else 0.0
    height, width = canvas.pure.shape
    here_px = canvas.surface_px[y, column]
    red = green = blue = total = 0.0
    for row in range(max(y - 1, 0), min(y + 2, height)):
        for x in (column, min(max(column + inwards, 0), width - 1)):
            if canvas.pure[row, x] and abs(canvas.surface_px[row, x] - here_px) <= SAME_SURFACE_PX:
                weight = 2.0 if row == y else 1.0
                red += weight * canvas.image[row, x, 0]
                green += weight * canvas.image[row, x, 1]
                blue += weight * canvas.image[row, x, 2]
                total += weight
    return red / total + half, green / total + half, blue / total + half


@compiled
@typing.no_type_check
def _fill_pixel(canvas, y, u, source, colour, mirrors):
    """Fill a pixel with the colour of its mirror image about `source`, or with `colour`.

    The mirror image is used if `mirrors` is set and it is on the same surface as `source`.
    """
    width = canvas.pure.shape[1]
    mirrored = min(max(2 * source - u, 0), width - 1)
    apart_px = abs(canvas.surface_px[y, mirrored] - canvas.surface_px[y, source])
    if mirrors and canvas.pure[y, mirrored] and apart_px <= SAME_SURFACE_PX:
        for channel in range(3):
            canvas.image[y, u, channel] = canvas.image[y, mirrored, channel]
    else:
        canvas.image[y, u, 0], canvas.image[y, u, 1], canvas.image[y, u, 2] = colour
    canvas.surface_px[y, u], canvas.drawn[y, u] = canvas.surface_px[y, source], False
