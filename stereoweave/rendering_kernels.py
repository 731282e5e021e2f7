"""The renderer's loops over pixels, compiled by Numba; `render` calls them, and explains their order.

Compiled code is kept between processes in the user's cache folder, never in the package, so that an
installation may be read-only. A plain version of all this is in tests/plain_rendering.py, and has to agree.
"""

import math
import os
import sys
import typing
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numba import config, njit

NOTHING = -1e9
"""The disparity of a pixel that nothing lands on: behind everything, yet finite."""
SAME_SURFACE_PX = 3.0
"""Disparities at most this far apart are taken for one surface: a matcher's noise, or a slant."""
FADE_PX = 2.0
"""Over this further difference, a photograph's claim to show the surface fades to none."""
IMPURE = 0.1
"""What a pixel that may carry the colour of a nearer neighbour weighs beside a pure one."""
RIM = 0.15
"""A surface with no more support than this is seen by one photograph alone, and through impure pixels."""
NOISE_LEVELS = 10.0
"""Differences below this, summed over the channels, say little about which of two surfaces is right."""
PRIOR = 0.3
"""What a disparity of no confidence is granted: a certain one outweighs it about four times."""


class Side(typing.NamedTuple):
    """One photograph and what is known about it; arrays are [H, W], and C-contiguous.

    Attributes:
        photo: uint8 RGB [H, W, 3].
        grey: uint8.
        disparity_px: float32; column x lands at x + shift * disparity_px in the new view.
        purity: float32, IMPURE..1, low for pixels that may carry the colour of a nearer neighbour.
        landed_px: float32, the nearest disparity that lands on each pixel of the new view; `splat` writes it.
        shift: -position for the left side, 1 - position for the right one.
        nearness: the photograph's weight by its camera's distance to the new one; the two add up to 1.
    """

    photo: np.ndarray
    grey: np.ndarray
    disparity_px: np.ndarray
    purity: np.ndarray
    landed_px: np.ndarray
    shift: float
    nearness: float

    def rows(self, rows: slice) -> "Side":
        """The same of some rows only."""
        photo, grey, disparity_px, purity, landed_px = (array[rows] for array in self[:5])
        return Side(photo, grey, disparity_px, purity, landed_px, self.shift, self.nearness)


class Canvas(typing.NamedTuple):
    """The new view while it is made; arrays are [H, W], and C-contiguous.

    Attributes:
        front_px: float32, the disparity that a pixel shows, or NOTHING.
        back_px: float32, that of a second surface in the pixel, or NOTHING.
        share: float32, the front's part of the pixel, 0..1; the rest is the back's.
        products: float32 [H, W, 3], see `compare`: the difference of both photographs' grey levels times its
            slope by disparity; that slope squared; and 1.
        image: float32 RGB [H, W, 3].
        pure: bool, whether the colour comes from more than the rim of something nearer.
        drawn: bool, whether the colour comes from a photograph at all.
    """

    front_px: np.ndarray
    back_px: np.ndarray
    share: np.ndarray
    products: np.ndarray
    image: np.ndarray
    pure: np.ndarray
    drawn: np.ndarray

    def rows(self, rows: slice) -> "Canvas":
        """The same of some rows only."""
        return Canvas(*(array[rows] for array in self))


def cache_folder() -> Path:
    """Where compiled kernels are kept, unless NUMBA_CACHE_DIR names a folder: the user's place for caches."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or "~/AppData/Local"
    elif sys.platform == "darwin":
        base = "~/Library/Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(base).expanduser() / "stereoweave" / "kernels"


def kernel(function: Callable[..., None]) -> Callable[..., None]:
    """`function`, compiled when it is first called, or loaded where an earlier process has compiled it."""
    settings: typing.Any = config
    chosen_by_user = settings.CACHE_DIR
    # Numba reads this setting while it decorates; it is put back for the sake of other packages' functions.
    try:
        settings.CACHE_DIR = chosen_by_user or str(cache_folder())
        return njit(cache=True, nogil=True)(function)
    except RuntimeError:
        # No home, or no folder that can be written: better to compile in every process than not to work.
        return njit(nogil=True)(function)
    finally:
        settings.CACHE_DIR = chosen_by_user


# The helpers take arrays, not a Side: Numba would count references to all of its arrays at every pixel.
_inlined = njit(nogil=True, forceinline=True)


@kernel
@typing.no_type_check
def splat(disparity_px, shift, landed_px):
    """Write into landed_px the nearest disparity that lands on each pixel of the new view, or NOTHING.

    Neighbours on one surface are joined by a straight line, so that slants and magnified surfaces have no
    cracks; the pixels at a surface's border reach half a pixel further.
    """
    height, width = disparity_px.shape
    for y in range(height):
        for x in range(width):
            landed_px[y, x] = NOTHING
        for x in range(width):
            d = disparity_px[y, x]
            u = x + shift * d
            left_end = x == 0 or abs(disparity_px[y, x - 1] - d) > SAME_SURFACE_PX
            right_end = x == width - 1 or abs(disparity_px[y, x + 1] - d) > SAME_SURFACE_PX
            first = math.ceil(u - 0.5) if left_end else math.ceil(u)
            last = math.ceil(u + 0.5) - 1 if right_end else math.floor(u)
            for column in range(max(first, 0), min(last, width - 1) + 1):
                landed_px[y, column] = max(landed_px[y, column], d)
            if not right_end:
                slope = disparity_px[y, x + 1] - d
                stretch = 1.0 + shift * slope
                # Where stretch <= 0, the surface turns its back on the new view.
                if stretch > 0:
                    for column in range(max(math.ceil(u), 0), min(math.floor(u + stretch), width - 1) + 1):
                        between = d + slope * (column - u) / stretch
                        landed_px[y, column] = max(landed_px[y, column], between)


@_inlined
@typing.no_type_check
def _linear(values, y, x):
    """`values` [H, W] at the real column x; the border goes on."""
    last = values.shape[1] - 1
    i = math.floor(x)
    # As floats, because the difference of two uint8 wraps around.
    before = float(values[y, min(max(i, 0), last)])
    after = float(values[y, min(max(i + 1, 0), last)])
    return before + (x - i) * (after - before)


@_inlined
@typing.no_type_check
def _lies_on(disparity_px, y, column, d):
    """1 if the pixel lies on the surface of disparity d, falling to 0 over FADE_PX."""
    apart = abs(disparity_px[y, column] - d)
    return min(1.0, max(0.0, 1.0 + (SAME_SURFACE_PX - apart) / FADE_PX))


@_inlined
@typing.no_type_check
def _coverage(disparity_px, y, x, d):
    """How much of the photograph at the real column x is the surface of disparity d: 0..1, 0 outside."""
    last = disparity_px.shape[1] - 1
    if x < -0.5 or x > last + 0.5:
        return 0.0
    i = math.floor(x)
    before = _lies_on(disparity_px, y, max(i, 0), d)
    after = _lies_on(disparity_px, y, min(i + 1, last), d)
    return before + (x - i) * (after - before)


@_inlined
@typing.no_type_check
def _support(disparity_px, purity, y, x, d):
    """`_coverage`, with impure pixels counting for little."""
    last = disparity_px.shape[1] - 1
    if x < -0.5 or x > last + 0.5:
        return 0.0
    i = math.floor(x)
    before = _lies_on(disparity_px, y, max(i, 0), d) * purity[y, max(i, 0)]
    after = _lies_on(disparity_px, y, min(i + 1, last), d) * purity[y, min(i + 1, last)]
    return before + (x - i) * (after - before)


@njit(nogil=True)
@typing.no_type_check
def _weight(left, right, y, u, d):
    """How well both photographs together show the surface of disparity d at (y, u) of the new view."""
    in_left = _support(left.disparity_px, left.purity, y, u - left.shift * d, d)
    in_right = _support(right.disparity_px, right.purity, y, u - right.shift * d, d)
    return left.nearness * in_left + right.nearness * in_right


@njit(nogil=True)
@typing.no_type_check
def _gap_px(side, y, u, d):
    """How much nearer than d is what this side has there: the more similar one of two pixels; 0 outside."""
    last = side.disparity_px.shape[1] - 1
    x = u - side.shift * d
    if x < 0 or x > last:
        return 0.0
    i = math.floor(x)
    before = side.disparity_px[y, i] - d
    after = side.disparity_px[y, min(i + 1, last)] - d
    return before if abs(before) < abs(after) else after


@njit(nogil=True)
@typing.no_type_check
def _mismatch_levels(left, right, y, u, d):
    """How the photographs differ over three pixels around u if d is right: the channels' sum; -1 outside."""
    last = left.photo.shape[1] - 1
    total, count = 0.0, 0
    for column in range(u - 1, u + 2):
        x_left = column - left.shift * d
        x_right = column - right.shift * d
        if min(x_left, x_right) >= 0 and max(x_left, x_right) <= last:
            for channel in range(3):
                there = _linear(right.photo[:, :, channel], y, x_right)
                total += abs(_linear(left.photo[:, :, channel], y, x_left) - there)
            count += 1
    return total / count if count else -1.0


@njit(nogil=True)
@typing.no_type_check
def _share_of_left(left, right, confidence, y, u):
    """The left disparity's part, of 1, of a pixel for which the two sides have different surfaces."""
    a = left.landed_px[y, u]
    b = right.landed_px[y, u]
    gap_a_px = _gap_px(right, y, u, a)
    gap_b_px = _gap_px(left, y, u, b)
    # The nearer surface hides the other, unless the camera that does not have it looks through it.
    if a > b and gap_a_px >= -SAME_SURFACE_PX:
        return 1.0
    if b > a and gap_b_px >= -SAME_SURFACE_PX:
        return 0.0
    trust_a = _linear(confidence, y, u - left.shift * a)
    trust_b = _linear(confidence, y, u - left.shift * b)
    # The confidence is about the left map, which may have something else at b's place: nearer, so that it
    # knows nothing of b, or farther, so that it denies b.
    if gap_b_px > SAME_SURFACE_PX:
        trust_b = 0.5
    elif gap_b_px < -SAME_SURFACE_PX:
        trust_b = 1.0 - trust_b
    mismatch_a = _mismatch_levels(left, right, y, u, a)
    mismatch_b = _mismatch_levels(left, right, y, u, b)
    if min(mismatch_a, mismatch_b) < 0:
        mismatch_a = mismatch_b = 0.0
    score_a = (PRIOR + trust_a) / (NOISE_LEVELS + mismatch_a) * _weight(left, right, y, u, a)
    score_b = (PRIOR + trust_b) / (NOISE_LEVELS + mismatch_b) * _weight(left, right, y, u, b)
    return score_a / (score_a + score_b) if score_a > 0 else 0.0


@kernel
@typing.no_type_check
def choose(left, right, confidence, canvas):
    """Write the surface of every pixel of the new view, and where there is a second one, that and the shares.

    There are two where the sides contradict each other, and where a nearer surface ends within the pixel.
    """
    front_px, back_px, share = canvas.front_px, canvas.back_px, canvas.share
    height, width = front_px.shape
    landed_left, landed_right = left.landed_px, right.landed_px
    for y in range(height):
        for u in range(width):
            a, b = landed_left[y, u], landed_right[y, u]
            front, back, part = max(a, b), NOTHING, 1.0
            if min(a, b) > NOTHING:
                if abs(a - b) <= SAME_SURFACE_PX:
                    front = 0.5 * (a + b)
                else:
                    part = _share_of_left(left, right, confidence, y, u)
                    front, back = a, b
                    if part == 0:
                        front, back, part = b, NOTHING, 1.0
                    elif part == 1:
                        back = NOTHING
            before, after = max(u - 1, 0), min(u + 1, width - 1)
            nearer = max(landed_left[y, before], landed_left[y, after])
            nearer = max(nearer, landed_right[y, before], landed_right[y, after])
            if back == NOTHING and front > NOTHING and nearer > front + SAME_SURFACE_PX:
                covered = left.nearness * _coverage(left.disparity_px, y, u - left.shift * nearer, nearer)
                covered += right.nearness * _coverage(right.disparity_px, y, u - right.shift * nearer, nearer)
                if covered > 0:
                    front, back, part = nearer, front, covered
            front_px[y, u], back_px[y, u], share[y, u] = front, back, part


@kernel
@typing.no_type_check
def compare(left, right, canvas):
    """Write into products how the photographs differ where both show a pixel's only surface, 0 elsewhere."""
    front_px, back_px, products = canvas.front_px, canvas.back_px, canvas.products
    height, width = front_px.shape
    left_px, left_purity, left_grey = left.disparity_px, left.purity, left.grey
    right_px, right_purity, right_grey = right.disparity_px, right.purity, right.grey
    for y in range(height):
        for u in range(width):
            products[y, u, 0] = products[y, u, 1] = products[y, u, 2] = 0.0
            d = front_px[y, u]
            if d == NOTHING or back_px[y, u] > NOTHING:
                continue
            x = u - left.shift * d
            z = u - right.shift * d
            if min(_support(left_px, left_purity, y, x, d), _support(right_px, right_purity, y, z, d)) < 0.5:
                continue
            difference = _linear(left_grey, y, x) - _linear(right_grey, y, z)
            slope = 0.5 * right.shift * (_linear(right_grey, y, z + 1) - _linear(right_grey, y, z - 1))
            slope -= 0.5 * left.shift * (_linear(left_grey, y, x + 1) - _linear(left_grey, y, x - 1))
            products[y, u, 0] = difference * slope
            products[y, u, 1] = slope * slope
            products[y, u, 2] = 1.0


@_inlined
@typing.no_type_check
def _cubic(photo, y, x):
    """The photograph's colour at the real column x, by a cubic through four pixels (Keys 1981, a = -1/2)."""
    last = photo.shape[1] - 1
    i = math.floor(x)
    f = x - i
    w0 = ((-0.5 * f + 1.0) * f - 0.5) * f
    w1 = (1.5 * f - 2.5) * f * f + 1.0
    w3 = (0.5 * f - 0.5) * f * f
    w2 = 1.0 - w0 - w1 - w3
    a = min(max(i - 1, 0), last)
    b = min(max(i, 0), last)
    c = min(max(i + 1, 0), last)
    d = min(max(i + 2, 0), last)
    red = w0 * photo[y, a, 0] + w1 * photo[y, b, 0] + w2 * photo[y, c, 0] + w3 * photo[y, d, 0]
    green = w0 * photo[y, a, 1] + w1 * photo[y, b, 1] + w2 * photo[y, c, 1] + w3 * photo[y, d, 1]
    blue = w0 * photo[y, a, 2] + w1 * photo[y, b, 2] + w2 * photo[y, c, 2] + w3 * photo[y, d, 2]
    return red, green, blue


@kernel
@typing.no_type_check
def paint(left, right, canvas):
    """Write the new view's colours into image, and into pure whether they come from pure pixels.

    Leaves in front_px the disparity of the surface that has most of the pixel, or NOTHING where no photograph
    shows any: there the image stays as it is.
    """
    front_px, back_px, share = canvas.front_px, canvas.back_px, canvas.share
    image, pure = canvas.image, canvas.pure
    height, width = front_px.shape
    left_photo, left_px, left_purity = left.photo, left.disparity_px, left.purity
    right_photo, right_px, right_purity = right.photo, right.disparity_px, right.purity
    for y in range(height):
        for u in range(width):
            red = green = blue = known = most = support = 0.0
            seen_px = NOTHING
            for layer in range(2):
                d = front_px[y, u] if layer == 0 else back_px[y, u]
                part = share[y, u] if layer == 0 else 1.0 - share[y, u]
                if d == NOTHING:
                    continue
                x = u - left.shift * d
                z = u - right.shift * d
                in_left = _support(left_px, left_purity, y, x, d)
                in_right = _support(right_px, right_purity, y, z, d)
                if in_left + in_right == 0:
                    continue
                known += part
                if part > most:
                    most, seen_px, support = part, d, in_left + in_right
                of_left = left.nearness * in_left
                of_left /= of_left + right.nearness * in_right
                if in_left > 0:
                    r, g, b = _cubic(left_photo, y, x)
                    red += part * of_left * r
                    green += part * of_left * g
                    blue += part * of_left * b
                if in_right > 0:
                    r, g, b = _cubic(right_photo, y, z)
                    red += part * (1.0 - of_left) * r
                    green += part * (1.0 - of_left) * g
                    blue += part * (1.0 - of_left) * b
            if known > 0:
                image[y, u, 0] = red / known
                image[y, u, 1] = green / known
                image[y, u, 2] = blue / known
            front_px[y, u] = seen_px
            pure[y, u] = support > RIM


@njit(nogil=True)
@typing.no_type_check
def _mean_beside(canvas, y, column, inwards):
    """The mean colour of the surface at (y, column): two columns of three rows, its own counting twice."""
    height, width = canvas.pure.shape
    here_px = canvas.front_px[y, column]
    image = canvas.image
    red = green = blue = total = 0.0
    for row in range(max(y - 1, 0), min(y + 2, height)):
        for x in (column, min(max(column + inwards, 0), width - 1)):
            if canvas.pure[row, x] and abs(canvas.front_px[row, x] - here_px) <= SAME_SURFACE_PX:
                weight = 2.0 if row == y else 1.0
                red += weight * image[row, x, 0]
                green += weight * image[row, x, 1]
                blue += weight * image[row, x, 2]
                total += weight
    return red / total, green / total, blue / total


@kernel
@typing.no_type_check
def fill(canvas):
    """Give every run of pixels that are not pure the colour of its farther end; drawn is False where it did.

    A pixel on the rim keeps its own colour if it is farther than that end: a gap in a fence is not closed.
    """
    front_px, image, pure, drawn = canvas.front_px, canvas.image, canvas.pure, canvas.drawn
    height, width = pure.shape
    for y in range(height):
        start = 0
        while start < width:
            if pure[y, start]:
                drawn[y, start] = True
                start += 1
                continue
            end = start
            while end < width and not pure[y, end]:
                drawn[y, end] = front_px[y, end] > NOTHING
                end += 1
            from_left = end == width or (start > 0 and front_px[y, start - 1] <= front_px[y, end])
            source = start - 1 if from_left else end
            if source >= 0:
                colour = _mean_beside(canvas, y, source, -1 if from_left else 1)
                for x in range(start, end):
                    if not drawn[y, x] or front_px[y, x] >= front_px[y, source] - SAME_SURFACE_PX:
                        image[y, x, 0], image[y, x, 1], image[y, x, 2] = colour
                        drawn[y, x] = False
            start = end
