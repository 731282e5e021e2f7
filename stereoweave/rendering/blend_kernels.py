"""Kernels that blend both images into the new view where at least one of them shows a pixel's surface."""

import typing

import numpy as np

from stereoweave.rendering.canvas_kernels import NOTHING, SAME_SURFACE_PX, support_at
from stereoweave.system.jit import compiled, inlined

RIM = 0.15
"""A pixel is pure if its support exceeds this, which impure pixels of one image alone cannot reach."""

WINDOW_REACH_PX = 2
"""Radius of the alignment window, which is 5x5 pixels in size."""
LARGEST_STEP_PX = np.float32(1)
"""Largest change that the alignment makes to a disparity."""
FLAT_LEVELS2 = np.float32(30)
"""Regularisation: mean squared grey-level slope below which a window is too flat to align."""
DOUBLES_REACH_PX = 12
"""A doubled object is thin: both sides have pixels within this distance that are not doubled."""
AGREED_LEVELS = 30
"""The images agree where their difference, summed over the channels, is at most this."""
ALIKE_LEVELS, UNLIKE_LEVELS = 20, 60
"""Colour differences: at most the first within a surface, and at least the second between two surfaces."""
_HALF, _ONE, _LARGEST = np.float32(0.5), np.float32(1), np.float32(255)
_LEAST = np.float32(1e-9)
_1, _2, _3 = np.uint32(1), np.uint32(2), np.uint32(3)


@compiled
@typing.no_type_check
def compare_row(left, right, y, row, sums):
    """Write a row's alignment terms, each summed over 5 columns, to `sums` [3, W].

    The terms are the grey-level difference times its derivative with respect to disparity, that derivative
    squared, and 1. Only columns where both images show the pixel's only surface are counted.
    """
    width = row.front_px.shape[0]
    left_grey, left_slope, right_grey, right_slope = np.empty((4, width), np.float32)
    products = np.zeros((3, width + 2 * WINDOW_REACH_PX), np.float32)
    _sample_grey_row(left, y, row.front_px, left_grey, left_slope)
    _sample_grey_row(right, y, row.front_px, right_grey, right_slope)
    for u in range(width):
        both = min(row.in_left[u], row.in_right[u]) >= _HALF and row.back_px[u] == NOTHING
        seen = _ONE if both else np.float32(0)
        slope = right_slope[u] - left_slope[u]
        products[0, u + WINDOW_REACH_PX] = seen * (left_grey[u] - right_grey[u]) * slope
        products[1, u + WINDOW_REACH_PX] = seen * slope * slope
        products[2, u + WINDOW_REACH_PX] = seen
    for k in range(3):
        of = products[k]
        for u in range(width):
            sums[k, u] = of[u] + of[u + 1] + of[u + 2] + of[u + 3] + of[u + 4]


@compiled
@typing.no_type_check
def align_row(sums, row):
    """Refine a row's disparities to align the images, using the terms `sums` [5, 3, W] of 5 rows.

    This is one Lucas-Kanade step. Without it, matching noise shows as blur, because each image is sampled
    slightly off the surface.
    """
    width = row.front_px.shape[0]
    for u in range(width):
        both = min(row.in_left[u], row.in_right[u]) >= _HALF and row.back_px[u] == NOTHING
        along = sums[0, 0, u] + sums[1, 0, u] + sums[2, 0, u] + sums[3, 0, u] + sums[4, 0, u]
        squares = sums[0, 1, u] + sums[1, 1, u] + sums[2, 1, u] + sums[3, 1, u] + sums[4, 1, u]
        count = sums[0, 2, u] + sums[1, 2, u] + sums[2, 2, u] + sums[3, 2, u] + sums[4, 2, u]
        step_px = -along / (squares + FLAT_LEVELS2 * max(count, _ONE))
        step_px = min(max(step_px, -LARGEST_STEP_PX), LARGEST_STEP_PX)
        row.front_px[u] += step_px if both else np.float32(0)


@compiled
@typing.no_type_check
def _sample_grey_row(side, y, front_px, grey, slope):
    """Write an image's grey level at each surface of a row, and its derivative with respect to disparity."""
    levels = side.grey[y]
    shift, offset_px = np.float32(side.shift), np.float32(side.offset_px)
    width = front_px.shape[0]
    padded = np.empty(width + 4, np.float32)
    _pad(levels, padded)
    for u in range(width):
        x = _clamp_column(np.float32(u) - offset_px - shift * front_px[u], width)
        i = np.uint32(x)
        part = x - np.float32(i)
        a, b, c, d = padded[i], padded[i + _1], padded[i + _2], padded[i + _3]
        grey[u] = b + part * (c - b)
        slope[u] = shift * _HALF * (c - a + part * (d - b - c + a))


@inlined
@typing.no_type_check
def _pad(row, padded):
    """Write a row as float32 between one copy of its first pixel and three copies of its last pixel."""
    width = row.shape[0]
    for x in range(width):
        padded[x + 1] = row[x]
    padded[0] = row[0]
    padded[width + 1 :] = row[width - 1]


@inlined
@typing.no_type_check
def _clamp_column(x, width):
    """Return a fractional column clamped to the image."""
    return min(max(x, np.float32(0)), np.float32(width - 1))


@compiled
@typing.no_type_check
def _sample_colour_row(side, y, front_px, padded, colours):
    """Sample an image at a row's surfaces into colours [3, W], by cubic convolution (Keys 1981, a = -1/2)."""
    shift, offset_px = np.float32(side.shift), np.float32(side.offset_px)
    width = front_px.shape[0]
    for channel in range(3):
        _pad(side.image[y, :, channel], padded[channel])
    red, green, blue = padded
    for u in range(width):
        x = _clamp_column(np.float32(u) - offset_px - shift * front_px[u], width)
        i = np.uint32(x)
        f = x - np.float32(i)
        w0, w1, w2, w3 = _cubic_weights(f)
        colours[0, u] = w0 * red[i] + w1 * red[i + _1] + w2 * red[i + _2] + w3 * red[i + _3]
        colours[1, u] = w0 * green[i] + w1 * green[i + _1] + w2 * green[i + _2] + w3 * green[i + _3]
        colours[2, u] = w0 * blue[i] + w1 * blue[i + _1] + w2 * blue[i + _2] + w3 * blue[i + _3]


@inlined
@typing.no_type_check
def _cubic_weights(f):
    """Return the weights, float32, of the pixels at -1, 0, 1 and 2 for a sample at f in 0..1."""
    w0 = ((-_HALF * f + _ONE) * f - _HALF) * f
    w1 = (np.float32(1.5) * f - np.float32(2.5)) * f * f + _ONE
    w3 = (_HALF * f - _HALF) * f * f
    return w0, w1, _ONE - w0 - w1 - w3, w3


@compiled
@typing.no_type_check
def paint_row(left, right, y, row, canvas):
    """Write `image`, `pure` and `surface_px` of a canvas row.

    The canvas image is unchanged where neither input image shows the surface.
    """
    front_px, in_left, in_right = row.front_px, row.in_left, row.in_right
    surface_px, image, pure = canvas.surface_px[y], canvas.image[y], canvas.pure[y]
    width = front_px.shape[0]
    left_padded, right_padded = np.empty((2, 3, width + 4), np.float32)
    left_colours, right_colours = np.empty((2, 3, width), np.float32)
    of_left = np.empty(width, np.float32)
    left_share, right_share = np.float32(left.nearness), np.float32(right.nearness)
    _sample_colour_row(left, y, front_px, left_padded, left_colours)
    _sample_colour_row(right, y, front_px, right_padded, right_colours)
    for u in range(width):
        total = left_share * in_left[u] + right_share * in_right[u]
        of_left[u] = left_share * in_left[u] / max(total, _LEAST)
        pure[u] = in_left[u] + in_right[u] > RIM
        surface_px[u] = front_px[u] if in_left[u] + in_right[u] > 0 else NOTHING
    _resolve_doubles(row, left_colours, right_colours, of_left)
    for channel in range(3):
        a, b = left_colours[channel], right_colours[channel]
        for u in range(width):
            a[u] = min(max(b[u] + of_left[u] * (a[u] - b[u]), np.float32(0)), _LARGEST) + _HALF
    for u in range(width):
        if row.back_px[u] > NOTHING:
            _paint_two(left, right, y, u, row, left_padded, right_padded, canvas)
        elif in_left[u] + in_right[u] > 0:
            image[u, 0], image[u, 1], image[u, 2] = left_colours[0, u], left_colours[1, u], left_colours[2, u]


@compiled
@typing.no_type_check
def _resolve_doubles(row, left_colours, right_colours, of_left):
    """Use only the image that shows the background where both disparity maps missed a thin object.

    Otherwise, the object would be doubled, because the two images show it in front of different parts of the
    background. Such an object is recognised where the images differ but agree at nearby pixels on both sides,
    which are on the same surface, and where one image has the colour of that surface. The other image shows
    the object.
    """
    width = of_left.shape[0]
    agreed = np.empty(width, np.int32)  # for each column, the last column up to it where both images agree
    last = -2 * DOUBLES_REACH_PX
    for u in range(width):
        if (
            _is_shared_surface(row, u)
            and _colour_distance_levels(left_colours, u, right_colours, u) <= AGREED_LEVELS
        ):
            last = u
        agreed[u] = last
    after = width + 2 * DOUBLES_REACH_PX
    for k in range(width):
        u = width - 1 - k
        before = agreed[u]
        if before == u:
            after = u
        elif _is_shared_surface(row, u) and max(u - before, after - u) <= DOUBLES_REACH_PX:
            d = row.front_px[u]
            slant_px = max(abs(row.front_px[before] - d), abs(row.front_px[after] - d))
            sides_levels = _colour_distance_levels(left_colours, before, left_colours, after)
            if slant_px > SAME_SURFACE_PX or sides_levels > ALIKE_LEVELS:
                continue
            of_one = _colour_distance_levels(left_colours, u, left_colours, before)
            of_other = _colour_distance_levels(right_colours, u, left_colours, before)
            if min(of_one, of_other) <= ALIKE_LEVELS and max(of_one, of_other) >= UNLIKE_LEVELS:
                of_left[u] = 1 if of_one < of_other else 0


@inlined
@typing.no_type_check
def _is_shared_surface(row, u):
    """Return whether both images show a pixel's only surface."""
    return min(row.in_left[u], row.in_right[u]) >= _HALF and row.back_px[u] == NOTHING


@inlined
@typing.no_type_check
def _colour_distance_levels(colours, u, others, v):
    """Return the absolute difference between two colours of rows [3, W], summed over the channels."""
    red, green, blue = (
        colours[0, u] - others[0, v],
        colours[1, u] - others[1, v],
        colours[2, u] - others[2, v],
    )
    return abs(red) + abs(green) + abs(blue)


@compiled
@typing.no_type_check
def _paint_two(left, right, y, u, row, left_padded, right_padded, canvas):
    """Paint a pixel that two surfaces share."""
    red = green = blue = known = most = support = 0.0
    seen_px = NOTHING
    for layer in range(2):
        d = row.front_px[u] if layer == 0 else row.back_px[u]
        part = row.share[u] if layer == 0 else 1.0 - row.share[u]
        x = u - left.offset_px - left.shift * d
        z = u - right.offset_px - right.shift * d
        in_left = support_at(left.disparity_px[y], left.nearer_px[y], left.shift, x, d)
        in_right = support_at(right.disparity_px[y], right.nearer_px[y], right.shift, z, d)
        if in_left + in_right == 0:
            continue
        known += part
        if part > most:
            most, seen_px, support = part, d, in_left + in_right
        of_left = left.nearness * in_left
        of_left /= of_left + right.nearness * in_right
        for padded, column, weight in ((left_padded, x, of_left), (right_padded, z, 1.0 - of_left)):
            r, g, b = _sample_colour(padded, column)
            red += part * weight * r
            green += part * weight * g
            blue += part * weight * b
    if known > 0:
        canvas.image[y, u, 0] = min(max(red / known, 0.0), 255.0) + 0.5
        canvas.image[y, u, 1] = min(max(green / known, 0.0), 255.0) + 0.5
        canvas.image[y, u, 2] = min(max(blue / known, 0.0), 255.0) + 0.5
    canvas.surface_px[y, u] = seen_px
    canvas.pure[y, u] = support > RIM


@inlined
@typing.no_type_check
def _sample_colour(padded, x):
    """Sample a padded row [3, W + 4] at the fractional column x, as `_sample_colour_row` does."""
    x = _clamp_column(np.float32(x), padded.shape[1] - 4)
    i = np.uint32(x)
    w0, w1, w2, w3 = _cubic_weights(x - np.float32(i))
    a, b, c, d = padded[:, i], padded[:, i + _1], padded[:, i + _2], padded[:, i + _3]
    red = w0 * a[0] + w1 * b[0] + w2 * c[0] + w3 * d[0]
    green = w0 * a[1] + w1 * b[1] + w2 * c[1] + w3 * d[1]
    blue = w0 * a[2] + w1 * b[2] + w2 * c[2] + w3 * d[2]
    return red, green, blue
