"""What the renderer's loops over pixels have in common: photographs and canvas, splatting, support.

A plain version of all this is in tests/plain_rendering.py, and has to agree.
"""

import math
import typing

import numpy as np

from stereoweave.system.jit import compiled, inlined, kernel

NOTHING = np.float32(-1e9)
"""The disparity of a pixel that nothing lands on: behind everything, yet finite."""
SAME_SURFACE_PX = np.float32(3)
"""Disparities at most this far apart are taken for one surface: a matcher's noise, or a slant."""
FADE_PX = np.float32(2)
"""Over this further difference, a photograph's claim to show the surface fades to none."""
IMPURE = np.float32(0.1)
"""What a pixel that may carry the colour of a nearer neighbour weighs beside a pure one."""
PARTED_PX = np.float32(1)
"""A nearer neighbour's colour is out of place once the new view parts the two by more than this."""


class Side(typing.NamedTuple):
    """One photograph and what is known about it; arrays are [H, W], and C-contiguous.

    Attributes:
        photo: uint8 RGB [H, W, 3].
        grey: uint8.
        disparity_px: float32; column x lands at x + shift * disparity_px + offset_px in the new view.
        nearer_px: float32, how much nearer the nearest of a pixel and its eight neighbours is.
        shift: -position for the left side, 1 - position for the right one.
        offset_px: by which the whole view is moved.
        nearness: the photograph's weight by its camera's distance to the new one; the two add up to 1.
    """

    photo: np.ndarray
    grey: np.ndarray
    disparity_px: np.ndarray
    nearer_px: np.ndarray
    shift: float
    offset_px: float
    nearness: float


class Canvas(typing.NamedTuple):
    """The new view; arrays are [H, W], and C-contiguous.

    Attributes:
        surface_px: float32, the disparity of the surface that has most of a pixel, or NOTHING.
        image: uint8 RGB [H, W, 3].
        pure: bool, whether the colour comes from more than the rim of something nearer.
        drawn: bool, whether the colour comes from a photograph at all.
    """

    surface_px: np.ndarray
    image: np.ndarray
    pure: np.ndarray
    drawn: np.ndarray


def empty_canvas(photo: np.ndarray) -> Canvas:
    """A canvas that shows a photograph, uint8 RGB [H, W, 3], until it is drawn on; some rows never are."""
    size = photo.shape[:2]
    return Canvas(
        surface_px=np.full(size, NOTHING, np.float32),
        image=photo.copy(),
        pure=np.zeros(size, bool),
        drawn=np.ones(size, bool),
    )


class SurfaceRow(typing.NamedTuple):
    """What is known about a row of the new view before it is painted; arrays are float32 [W].

    Attributes:
        front_px: the disparity that a pixel shows, or NOTHING.
        back_px: that of a second surface in the pixel, or NOTHING.
        share: the front's part of the pixel, 0..1; the rest is the back's.
        in_left, in_right: how much of the photographs' pixels there shows the front: 0..1.
    """

    front_px: np.ndarray
    back_px: np.ndarray
    share: np.ndarray
    in_left: np.ndarray
    in_right: np.ndarray


_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)


@compiled
@typing.no_type_check
def splat_row(disparity_px, shift, offset_px, landed_px):
    """Write into landed_px [W] the nearest disparity that lands on each pixel of the new view, or NOTHING.

    Neighbours on one surface are joined by a straight line, so that slants and magnified surfaces have no
    cracks; the pixels at a surface's border reach half a pixel further.
    """
    width = disparity_px.shape[0]
    landed_px[:] = NOTHING
    right_end = True
    for x in range(width):
        d = disparity_px[x]
        u = x + shift * d + offset_px
        left_end = right_end
        rise = disparity_px[min(x + 1, width - 1)] - d
        right_end = x == width - 1 or abs(rise) > SAME_SURFACE_PX
        first = math.ceil(u - 0.5) if left_end else math.ceil(u)
        last = math.ceil(u + 0.5) - 1 if right_end else math.floor(u)
        for column in range(max(first, 0), min(last, width - 1) + 1):
            landed_px[column] = max(landed_px[column], d)
        # Where stretch <= 0, the surface turns its back on the new view.
        stretch = 1.0 + shift * rise
        if not right_end and stretch > 0:
            slope = rise / stretch
            for column in range(max(math.ceil(u), 0), min(math.floor(u + stretch), width - 1) + 1):
                landed_px[column] = max(landed_px[column], d + slope * (column - u))


@kernel
@typing.no_type_check
def splat(disparity_px, shift, offset_px, landed_px):
    """`splat_row` for all rows of landed_px [H, W]."""
    for y in range(disparity_px.shape[0]):
        splat_row(disparity_px[y], shift, offset_px, landed_px[y])


@inlined
@typing.no_type_check
def linear(row, x):
    """`row` [W] at the real column x; the border goes on."""
    last = row.shape[0] - 1
    i = math.floor(x)
    # As floats, because the difference of two uint8 wraps around.
    before = float(row[min(max(i, 0), last)])
    after = float(row[min(max(i + 1, 0), last)])
    return before + (x - i) * (after - before)


@inlined
@typing.no_type_check
def lies_on(apart_px):
    """1 for what is at most SAME_SURFACE_PX from a surface, falling to 0 over FADE_PX; float32."""
    return min(_ONE, max(_ZERO, _ONE + (SAME_SURFACE_PX - abs(apart_px)) / FADE_PX))


@inlined
@typing.no_type_check
def purity(shift, nearer_px):
    """1, falling to IMPURE where a nearer neighbour's colour may be in a pixel, and is out of place; float32.

    It is once the new view parts the two by more than PARTED_PX.
    """
    return min(_ONE, max(IMPURE, _ONE + PARTED_PX - abs(shift) * nearer_px))


@compiled
@typing.no_type_check
def support_in_row(side, y, front_px, support):
    """Write how much of the photograph shows each front_px [W] of a row: 0..1, float32.

    Two pixels of the photograph show it, as far as each lies on that surface, and pure ones more than others.
    """
    disparity_px, nearer_px = side.disparity_px[y], side.nearer_px[y]
    shift, offset_px = np.float32(side.shift), np.float32(side.offset_px)
    width = front_px.shape[0]
    last = np.float32(width - 1)
    for u in range(width):
        d = front_px[u]
        x = np.float32(u) - offset_px - shift * d
        inside = _ONE if x >= -_HALF and x <= last + _HALF else _ZERO
        x = min(max(x, _ZERO), last)
        i = np.uint32(x)
        k = np.uint32(min(x + _ONE, last))
        before = lies_on(disparity_px[i] - d) * purity(shift, nearer_px[i])
        after = lies_on(disparity_px[k] - d) * purity(shift, nearer_px[k])
        support[u] = inside * (before + (x - np.float32(i)) * (after - before))


@inlined
@typing.no_type_check
def support_at(disparity_px, nearer_px, shift, x, d):
    """As `support_in_row`, for the surface of disparity d at the real column x of the photograph's row."""
    last = disparity_px.shape[0] - 1
    if x < -0.5 or x > last + 0.5:
        return 0.0
    i = math.floor(x)
    j, k = max(i, 0), min(i + 1, last)
    before = lies_on(disparity_px[j] - d) * purity(shift, nearer_px[j])
    after = lies_on(disparity_px[k] - d) * purity(shift, nearer_px[k])
    return before + (x - i) * (after - before)
