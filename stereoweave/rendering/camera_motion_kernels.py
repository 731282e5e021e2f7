"""Kernel that warps a view along its rows, each pixel by its own shift.

Views are transposed to warp them along their columns.
"""

import math
import typing

import numpy as np

from stereoweave.rendering.canvas_kernels import SAME_SURFACE_PX
from stereoweave.system.jit import compiled, kernel


@kernel
@typing.no_type_check
def move(image, surface_px, drawn, targets, disparity_px, canvas):
    """Move each pixel (y, x) to the fractional column targets[y, x] of the canvas; the nearest surface wins.

    Colours are interpolated between neighbours on the same surface, so that magnified surfaces have no
    cracks. `pure` stays False where nothing lands.

    Args:
        image: uint8 RGB [H, W, 3].
        surface_px: float32 [H, W], disparity before the motion; it separates surfaces.
        drawn: bool [H, W]; whether the colour comes from an input image.
        targets: float32 [H, W], target columns.
        disparity_px: float32 [H, W], disparity after the motion.
        canvas: Empty canvas, output.
    """
    for y in range(image.shape[0]):
        _move_row(image[y], surface_px[y], drawn[y], targets[y], disparity_px[y], y, canvas)


@compiled
@typing.no_type_check
def _move_row(image, surface_px, drawn, targets, disparity_px, y, canvas):
    width = image.shape[0]
    right_end = True
    for x in range(width):
        left_end = right_end
        after = min(x + 1, width - 1)
        right_end = x == width - 1 or abs(surface_px[after] - surface_px[x]) > SAME_SURFACE_PX
        begin = targets[x] - 0.5 if left_end else targets[x]
        # A pixel without a neighbour on its surface extends by half a pixel to either side.
        end = targets[x] + 0.5 if right_end else targets[after]
        stretch = 1.0 if right_end else targets[after] - targets[x]
        if stretch <= 0:
            continue
        for u in range(max(math.ceil(begin), 0), min(math.ceil(end) - 1, width - 1) + 1):
            part = min(max((u - targets[x]) / stretch, 0.0), 1.0) if not right_end else 0.0
            near_px = disparity_px[x] + part * (disparity_px[after] - disparity_px[x])
            if near_px > canvas.surface_px[y, u]:
                _copy(image, surface_px, x, part, canvas.image[y, u])
                canvas.surface_px[y, u], canvas.pure[y, u] = near_px, True
                canvas.drawn[y, u] = drawn[x if part < 0.5 else after]


@compiled
@typing.no_type_check
def _copy(image, surface_px, x, part, colour):
    """Write the colour at the fraction `part` of the way from pixel x to the next pixel.

    The interpolation is cubic if the four nearest pixels are on the same surface, else linear.
    """
    width = image.shape[0]
    a, b, c, d = max(x - 1, 0), x, min(x + 1, width - 1), min(x + 2, width - 1)
    w0, w1, w2, w3 = 0.0, 1.0 - part, part, 0.0
    low_px = min(min(surface_px[a], surface_px[b]), min(surface_px[c], surface_px[d]))
    high_px = max(max(surface_px[a], surface_px[b]), max(surface_px[c], surface_px[d]))
    if high_px - low_px <= SAME_SURFACE_PX:
        w0 = ((-0.5 * part + 1.0) * part - 0.5) * part
        w1 = (1.5 * part - 2.5) * part * part + 1.0
        w3 = (0.5 * part - 0.5) * part * part
        w2 = 1.0 - w0 - w1 - w3
    for k in range(3):
        level = w0 * image[a, k] + w1 * image[b, k] + w2 * image[c, k] + w3 * image[d, k]
        colour[k] = np.uint8(min(max(level, 0.0), 255.0) + 0.5)
