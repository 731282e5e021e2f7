"""Kernels that paint collages: distance fields of silhouettes, blending of layers, and occlusion.

A layer is defined over the columns and rows of the left image, as a `Sheet`. Its disparity is linear between
columns, so warping to the right view is exact.
"""

import math
import typing
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numba import njit

REACH_PX = 2.0  # at this distance a pixel is clearly inside or outside, even halfway between two columns


class Sheet(NamedTuple):
    """A layer as seen in one view, starting at column `left` and row `top`.

    Attributes:
        field: Signed distance in px to the silhouette, float32 [h, w], positive inside and clamped to
            +-REACH_PX. The coverage of a pixel is field + 0.5, clamped to 0..1. The disparity is defined
            where the field is >= 0.
        disparity_px: Disparity of each pixel, float32 [h, w].
    """

    field: Float[np.ndarray, "h w"]
    disparity_px: Float[np.ndarray, "h w"]
    left: int
    top: int


class Paint(NamedTuple):
    """Appearance of a layer. x and y are left-image coordinates; all arrays except the texture are float32.

    Attributes:
        texture: Texels in uint8 RGB, tiled by mirroring.
        to_texture: Affine mapping from x, y, 1 to texel coordinates.
        to_colour: Affine mapping from a texel's r, g, b, 1 to the layer's colour.
        light: Light map, whose values multiply the colour, tiled by mirroring.
        to_light: Affine mapping from x, y, 1 to coordinates in the light map.
        gloss: A highlight's centre x and y, inverse radii along x and y, strength, and shift in the right
            view.
    """

    texture: UInt8[np.ndarray, "_ _ 3"]
    to_texture: Float[np.ndarray, "2 3"]
    to_colour: Float[np.ndarray, "3 4"]
    light: Float[np.ndarray, "_ _"]
    to_light: Float[np.ndarray, "2 3"]
    gloss: Float[np.ndarray, "6"]


def draw_outline_field(
    contours: tuple[Float[np.ndarray, "_ 2"], ...], left: int, top: int, shape: tuple[int, int]
) -> Float[np.ndarray, "h w"]:
    """Return the signed distance in px, float32, to closed contours (x, y) filled by the even-odd rule."""
    field = np.full(shape, -REACH_PX, np.float32)
    crossings = np.zeros(shape, np.uint8)
    for contour in contours:
        closed = np.concatenate([contour, contour[:1]]) - (left, top)
        _stroke(field, closed, 0.0)
        _cross(crossings, closed)
    _negate_inside(field, crossings)
    return field


def draw_stroke_field(
    strokes: tuple[tuple[Float[np.ndarray, "_ 2"], float], ...], left: int, top: int, shape: tuple[int, int]
) -> Float[np.ndarray, "h w"]:
    """Return the signed distance in px, float32, to polylines (x, y), each with its own half width."""
    field = np.full(shape, -REACH_PX, np.float32)
    for points, half_width_px in strokes:
        _stroke(field, points - (left, top), half_width_px)
    return field


def sum_surface(
    columns: Float[np.ndarray, "k w"], rows: Float[np.ndarray, "k h"], limit_px: float
) -> Float[np.ndarray, "h w"]:
    """Return the float32 disparity, the sum over k of rows[k, y] * columns[k, x] clamped to 0..limit_px."""
    return _sum_surface(columns, rows, limit_px)


def warp_to_right(sheet: Sheet, width: int) -> Sheet:
    """Warp the left view's sheet to the right view, clipped to columns 0..width-1."""
    field, disparity_px, left = _warp_to_right(sheet.field, sheet.disparity_px, sheet.left, width)
    return Sheet(field, disparity_px, left, sheet.top)


def cover(sheet: Sheet, nearest: Float[np.ndarray, "h w"], nearest_opaque: Float[np.ndarray, "h w"]) -> None:
    """Update both maps of the nearest disparity in place with another sheet.

    `nearest` is raised where the sheet is nearer and covers at least half of the pixel. `nearest_opaque` is
    raised where the sheet is nearer and covers the whole pixel.
    """
    _cover(sheet, nearest, nearest_opaque)


def colour(
    image: Float[np.ndarray, "h w 3"],
    sheet: Sheet,
    paint: Paint,
    nearest_opaque: Float[np.ndarray, "h w"],
    side: int,
) -> None:
    """Blend the sheet's colours into the float32 image (0..255) where no opaque sheet is nearer.

    `side` is 0 for the left view and 1 for the right view. Column x of the view shows column
    x + side * disparity_px of the left image.
    """
    _colour(image, sheet, paint, nearest_opaque, side)


def find_occluded(
    disparity_px: Float[np.ndarray, "h w"], other_px: Float[np.ndarray, "h w"], sign: int
) -> Bool[np.ndarray, "h w"]:
    """Find pixels whose match, at sign * disparity, is outside the other view or behind its surface.

    Args:
        disparity_px: This view's disparity, known everywhere.
        other_px: The other view's disparity.
        sign: -1 for the left view (matches are to the left), +1 for the right one.
    """
    return _find_occluded(disparity_px, other_px, sign)


def expose(
    image: Float[np.ndarray, "h w 3"],
    tone: Float[np.ndarray, "3 1021"],
    deviation: Float[np.ndarray, "3 1021"],
    noise: Float[np.ndarray, "h w 3"],
) -> UInt8[np.ndarray, "h w 3"]:
    """Apply a tone curve to each channel of the image, add noise, and round.

    Args:
        image: Image in float32, 0..255.
        tone: Output grey level, with four entries per input grey level.
        deviation: Standard deviation of the noise, in the same format.
        noise: Standard normal values.
    """
    return _expose(image, tone, deviation, noise)


@njit(cache=True, nogil=True)
@typing.no_type_check
def _stroke(field, points, half_width):
    # A box of pixels moves along each segment; inside it the distance to the segment is exact.
    height, width = field.shape
    hop = 4.0
    reach = half_width + REACH_PX + hop / 2
    for i in range(len(points) - 1):
        ax, ay = points[i]
        dx, dy = points[i + 1] - points[i]
        length2 = max(dx * dx + dy * dy, 1e-12)
        hops = int(math.sqrt(length2) / hop) + 1
        for k in range(hops):
            mx, my = ax + dx * (k + 0.5) / hops, ay + dy * (k + 0.5) / hops
            for y in range(max(0, math.ceil(my - reach)), min(height, int(math.floor(my + reach)) + 1)):
                for x in range(max(0, math.ceil(mx - reach)), min(width, int(math.floor(mx + reach)) + 1)):
                    t = min(1.0, max(0.0, ((x - ax) * dx + (y - ay) * dy) / length2))
                    ex, ey = x - ax - t * dx, y - ay - t * dy
                    inside = min(half_width - math.sqrt(ex * ex + ey * ey), REACH_PX)
                    if inside > field[y, x]:
                        field[y, x] = inside


@njit(cache=True, nogil=True)
@typing.no_type_check
def _cross(crossings, points):
    height, width = crossings.shape
    for i in range(len(points) - 1):
        ax, ay = points[i]
        bx, by = points[i + 1]
        if ay > by:
            ax, ay, bx, by = bx, by, ax, ay
        for y in range(max(0, math.ceil(ay)), min(height, math.ceil(by))):
            x = max(0, math.ceil(ax + (y - ay) * (bx - ax) / (by - ay)))
            if x < width:
                crossings[y, x] ^= 1


@njit(cache=True, nogil=True)
@typing.no_type_check
def _negate_inside(field, crossings):
    for y in range(field.shape[0]):
        inside = 0
        for x in range(field.shape[1]):
            inside ^= crossings[y, x]
            if inside:
                field[y, x] = -field[y, x]


@njit(cache=True, nogil=True)
@typing.no_type_check
def _sum_surface(columns, rows, limit):
    disparity = np.empty((rows.shape[1], columns.shape[1]), np.float32)
    for y in range(disparity.shape[0]):
        line = disparity[y]
        line[:] = 0
        for k in range(len(rows)):
            weight = np.float32(rows[k, y])
            for x in range(len(line)):
                line[x] += weight * columns[k, x]
        for x in range(len(line)):
            line[x] = min(max(line[x], np.float32(0)), np.float32(limit))
    return disparity


@njit(cache=True, nogil=True)
@typing.no_type_check
def _warp_to_right(field, disparity, left, width):
    height, columns = field.shape
    furthest = 0.0
    for y in range(height):
        for x in range(columns):
            furthest = max(furthest, disparity[y, x])
    start = max(0, int(math.floor(left - furthest)))
    stop = max(start, min(width, left + columns))
    field_right = np.full((height, stop - start), -REACH_PX, np.float32)
    disparity_right = np.zeros((height, stop - start), np.float32)
    for y in range(height):
        for x in range(columns - 1):
            if max(field[y, x], field[y, x + 1]) <= -REACH_PX:
                continue
            near = left + x - disparity[y, x]
            far = left + x + 1 - disparity[y, x + 1]
            first = max(start, int(math.ceil(near)))
            for column in range(first, min(stop, int(math.ceil(far)))):
                t = (column - near) / (far - near)
                field_right[y, column - start] = field[y, x] + t * (field[y, x + 1] - field[y, x])
                # The left-image column is exact; the disparity is the difference between the columns.
                disparity_right[y, column - start] = left + x + t - column
    return field_right, disparity_right, start


@njit(cache=True, nogil=True)
@typing.no_type_check
def _cover(sheet, nearest, nearest_opaque):
    field, disparity, left, top = sheet
    height, width = nearest.shape
    for y in range(max(0, -top), min(field.shape[0], height - top)):
        for x in range(max(0, -left), min(field.shape[1], width - left)):
            inside, here = field[y, x], disparity[y, x]
            if inside >= 0 and here > nearest[top + y, left + x]:
                nearest[top + y, left + x] = here
            if inside >= 0.5 and here > nearest_opaque[top + y, left + x]:
                nearest_opaque[top + y, left + x] = here


@njit(cache=True, nogil=True)
@typing.no_type_check
def _fold(position, last):
    # Mirrored tiling runs forwards and backwards over 0..last.
    position -= np.float32(2 * last) * np.floor(position * np.float32(0.5 / last))
    position = np.float32(last) - abs(position - np.float32(last))
    index = min(int(position), last - 1)
    return index, position - np.float32(index)


@njit(cache=True, nogil=True)
@typing.no_type_check
def _place(mapping, x, y, map_height, map_width):
    # Returns the column, the row, and the fractions towards the next column and row.
    u, across = _fold(mapping[0, 0] * x + mapping[0, 1] * y + mapping[0, 2], map_width - 1)
    v, down = _fold(mapping[1, 0] * x + mapping[1, 1] * y + mapping[1, 2], map_height - 1)
    return u, v, across, down


@njit(cache=True, nogil=True)
@typing.no_type_check
def _texel(texture, spot, channel):
    u, v, across, down = spot
    upper_left, lower_left = np.float32(texture[v, u, channel]), np.float32(texture[v + 1, u, channel])
    upper = upper_left + across * (np.float32(texture[v, u + 1, channel]) - upper_left)
    lower = lower_left + across * (np.float32(texture[v + 1, u + 1, channel]) - lower_left)
    return upper + down * (lower - upper)


@njit(cache=True, nogil=True)
@typing.no_type_check
def _light_at(light, spot):
    u, v, across, down = spot
    upper = light[v, u] + across * (light[v, u + 1] - light[v, u])
    lower = light[v + 1, u] + across * (light[v + 1, u + 1] - light[v + 1, u])
    return upper + down * (lower - upper)


@njit(cache=True, nogil=True)
@typing.no_type_check
def _shine(gloss, x, y, side):
    if gloss[4] == 0:
        return np.float32(0)
    across = (x - gloss[0] - side * gloss[5]) * gloss[2]
    down = (y - gloss[1]) * gloss[3]
    return gloss[4] * np.exp(-across * across - down * down)


@njit(cache=True, nogil=True)
@typing.no_type_check
def _colour(image, sheet, paint, nearest_opaque, side):
    # Single precision throughout, because it is twice as fast.
    field, disparity, left, top = sheet
    texture, to_texture, mix, light, to_light, gloss = paint
    side = np.float32(side)
    height, width = nearest_opaque.shape
    for y in range(max(0, -top), min(field.shape[0], height - top)):
        row = np.float32(top + y)
        for x in range(max(0, -left), min(field.shape[1], width - left)):
            coverage = min(field[y, x] + np.float32(0.5), np.float32(1))
            if coverage <= 0 or disparity[y, x] < nearest_opaque[top + y, left + x]:
                continue
            source = np.float32(left + x) + side * disparity[y, x]
            spot = _place(to_texture, source, row, texture.shape[0], texture.shape[1])
            r, g, b = _texel(texture, spot, 0), _texel(texture, spot, 1), _texel(texture, spot, 2)
            lit = _light_at(light, _place(to_light, source, row, light.shape[0], light.shape[1]))
            shine = _shine(gloss, source, row, side)
            for c in range(3):
                plain = max(mix[c, 0] * r + mix[c, 1] * g + mix[c, 2] * b + mix[c, 3], np.float32(0))
                shown = min(plain * lit + shine, np.float32(255))
                image[top + y, left + x, c] += coverage * (shown - image[top + y, left + x, c])


@njit(cache=True, nogil=True)
@typing.no_type_check
def _find_occluded(disparity, other, sign):
    # The tolerance is half a pixel, for rounding and for surfaces that nearly touch. On a slope, one of the
    # two columns beside the match is never nearer than the surface, so a slope does not occlude itself.
    height, width = disparity.shape
    occluded = np.empty((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            match = x + sign * disparity[y, x]
            if match < 0 or match > width - 1:
                occluded[y, x] = True
                continue
            before = int(match)
            after = min(before + 1, width - 1) if match > before else before
            occluded[y, x] = min(other[y, before], other[y, after]) > disparity[y, x] + 0.5
    return occluded


@njit(cache=True, nogil=True)
@typing.no_type_check
def _expose(image, tone, deviation, noise):
    height, width, _ = image.shape
    exposed = np.empty((height, width, 3), np.uint8)
    half, white = np.float32(0.5), np.float32(255)
    for y in range(height):
        for x in range(width):
            for c in range(3):
                level = int(image[y, x, c] * np.float32(4) + half)
                value = tone[c, level] + deviation[c, level] * noise[y, x, c] + half
                exposed[y, x, c] = int(min(max(value, np.float32(0)), white))
    return exposed
