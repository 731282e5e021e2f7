"""What colour a pixel of the new view has that no photograph shows: the background's, continued."""

import math
import typing

from stereoweave.rendering_kernels import NOTHING, SAME_SURFACE_PX, compiled, kernel


@kernel
@typing.no_type_check
def lay(hidden_px, colours, shift, offset_px, canvas):
    """Write the hidden background (hidden_kernels.uncover) where the canvas has no pure colour.

    A pixel on the rim of something keeps its colour if it is farther than that: a gap in a fence stays open.
    """
    height, width = hidden_px.shape
    for y in range(height):
        for x in range(width):
            d = hidden_px[y, x]
            if d == NOTHING:
                continue
            at = x + shift * d + offset_px
            for u in range(max(math.ceil(at - 0.5), 0), min(math.ceil(at + 0.5) - 1, width - 1) + 1):
                own_px = canvas.surface_px[y, u]
                farther = own_px > NOTHING and own_px < d - SAME_SURFACE_PX
                # A farther background may lie behind a nearer one, which is laid then.
                laid = canvas.pure[y, u] and not canvas.drawn[y, u]
                if farther or (canvas.pure[y, u] and not laid) or (laid and own_px >= d):
                    continue
                _mix(hidden_px[y], colours[y], x, u - at, canvas.image[y, u])
                canvas.surface_px[y, u], canvas.pure[y, u], canvas.drawn[y, u] = d, True, False


@compiled
@typing.no_type_check
def _mix(hidden_px, colours, x, beyond, colour):
    """Write the colour between the hidden pixel x and its neighbour, `beyond` pixels from it."""
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
    """Give every run of pixels that are still not pure what is seen beside its farther end, mirrored there.

    Where the picture ends there is one end only. As in `lay`, a farther pixel on the rim keeps its colour.
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
            if source >= 0:
                for u in range(start, end):
                    if not drawn[y, u] or surface_px[y, u] >= surface_px[y, source] - SAME_SURFACE_PX:
                        _mirror(canvas, y, u, source)
                        drawn[y, u] = False
            start = end


@compiled
@typing.no_type_check
def _mirror(canvas, y, u, source):
    """Write what lies as far beyond the source as u lies before it, if of its surface; else the source."""
    width = canvas.pure.shape[1]
    mirrored = min(max(2 * source - u, 0), width - 1)
    apart_px = abs(canvas.surface_px[y, mirrored] - canvas.surface_px[y, source])
    like = mirrored if canvas.pure[y, mirrored] and apart_px <= SAME_SURFACE_PX else source
    for channel in range(3):
        canvas.image[y, u, channel] = canvas.image[y, like, channel]
