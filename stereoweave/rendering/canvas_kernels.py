"""Types and kernels that the renderer's other kernels share: input images, canvas, splatting and support.

Tests compare the kernels with the plain implementation in tests/helpers/plain_rendering.py.
"""

import math
import typing

import numpy as np

from stereoweave.system.jit import compiled, inlined, kernel

NOTHING = np.float32(-1e9)
"""Disparity of a pixel on which nothing lands: behind everything, but finite."""
SAME_SURFACE_PX = np.float32(3)
"""Largest disparity difference within one surface, from matching noise or slant."""
FADE_PX = np.float32(2)
"""Further difference over which an image's support for a surface falls to 0."""
IMPURE = np.float32(0.1)
"""Weight of a pixel that may carry a nearer neighbour's colour, relative to a pure pixel."""
PARTED_PX = np.float32(1)
"""Parallax in the new view above which a nearer neighbour's colour is out of place."""


class Side(typing.NamedTuple):
    """One input image and its maps; arrays are C-contiguous [H, W] unless stated otherwise.

    Attributes:
        image: uint8 RGB [H, W, 3].
        grey: Grey levels, uint8.
        disparity_px: float32; column x lands at x + shift * disparity_px + offset_px in the new view.
        nearer_px: float32; largest disparity in the 3x3 window minus the pixel's own.
        shift: -position for the left image, 1 - position for the right one.
        offset_px: Shift of the whole view to the right.
        nearness: Weight that falls with the distance from the image's camera to the new camera; the weights
            of both images sum to 1.
    """

    image: np.ndarray
    grey: np.ndarray
    disparity_px: np.ndarray
    nearer_px: np.ndarray
    shift: float
    offset_px: float
    nearness: float


class Canvas(typing.NamedTuple):
    """The new view; arrays are C-contiguous [H, W] unless stated otherwise.

    Attributes:
        surface_px: float32; disparity of the surface that covers most of a pixel, or NOTHING.
        image: uint8 RGB [H, W, 3].
        pure: bool; whether the colour is free of a nearer surface's colour.
        drawn: bool; whether the colour comes from an input image.
    """

    surface_px: np.ndarray
    image: np.ndarray
    pure: np.ndarray
    drawn: np.ndarray


def empty_canvas(image: np.ndarray) -> Canvas:
    """Create a canvas without surfaces; it shows `image`, uint8 RGB [H, W, 3], until it is drawn on."""
    size = image.shape[:2]
    return Canvas(
        surface_px=np.full(size, NOTHING, np.float32),
        image=image.copy(),
        pure=np.zeros(size, bool),
        drawn=np.ones(size, bool),
    )


class SurfaceRow(typing.NamedTuple):
    """Surfaces in a row of the new view, before the row is painted; arrays are float32 [W].

    Attributes:
        front_px: Disparity of the visible surface, or NOTHING.
        back_px: Disparity of a second surface in the pixel, or NOTHING.
        share: Part of the pixel that the front surface covers, 0..1; the back surface covers the rest.
        in_left, in_right: Support of the left and of the right image for the front surface, 0..1.
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
    """Write to landed_px [W] the nearest disparity that lands on each pixel of the new view, or NOTHING.

    Disparity is interpolated linearly between neighbours on the same surface, so that slanted and magnified
    surfaces have no cracks. Pixels at the edge of a surface reach half a pixel farther.
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
        # Where stretch <= 0, the surface faces away from the new view.
        stretch = 1.0 + shift * rise
        if not right_end and stretch > 0:
            slope = rise / stretch
            for column in range(max(math.ceil(u), 0), min(math.floor(u + stretch), width - 1) + 1):
                landed_px[column] = max(landed_px[column], d + slope * (column - u))


@kernel
@typing.no_type_check
def splat(disparity_px, shift, offset_px, landed_px):
    """Splat all rows into landed_px [H, W]; see `splat_row`."""
    for y in range(disparity_px.shape[0]):
        splat_row(disparity_px[y], shift, offset_px, landed_px[y])


@inlined
@typing.no_type_check
def sample_linear(row, x):
    """Sample `row` [W] linearly at the fractional column x, clamped to the border."""
    last = row.shape[0] - 1
    i = math.floor(x)
    # As floats, because the difference of two uint8 values wraps around.
    before = float(row[min(max(i, 0), last)])
    after = float(row[min(max(i + 1, 0), last)])
    return before + (x - i) * (after - before)


@inlined
@typing.no_type_check
def lies_on(apart_px):
    """Return a pixel's weight: 1 up to SAME_SURFACE_PX from a surface, falling to 0 over FADE_PX."""
    return min(_ONE, max(_ZERO, _ONE + (SAME_SURFACE_PX - abs(apart_px)) / FADE_PX))


@inlined
@typing.no_type_check
def purity(shift, nearer_px):
    """Return a pixel's weight: 1, falling to IMPURE where it may carry a nearer neighbour's colour.

    The weight falls once the parallax between pixel and neighbour in the new view exceeds PARTED_PX.
    """
    return min(_ONE, max(IMPURE, _ONE + PARTED_PX - abs(shift) * nearer_px))


@compiled
@typing.no_type_check
def support_in_row(side, y, front_px, support):
    """Write an image's support, float32 in 0..1, for each surface of a row, front_px [W].

    The support is interpolated between two pixels, each weighted by `lies_on` and `purity`.
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
    """Return an image row's support, at the fractional column x, for the surface of disparity d.

    See `support_in_row`.
    """
    last = disparity_px.shape[0] - 1
    if x < -0.5 or x > last + 0.5:
        return 0.0
    i = math.floor(x)
    j, k = max(i, 0), min(i + 1, last)
    before = lies_on(disparity_px[j] - d) * purity(shift, nearer_px[j])
    after = lies_on(disparity_px[k] - d) * purity(shift, nearer_px[k])
    return before + (x - i) * (after - before)
