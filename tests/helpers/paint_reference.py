"""Plain NumPy reference of the collage painter, layer by layer over whole views."""

import numpy as np

from stereoweave.learn.data.paint_kernels import REACH_PX, draw_outline_field
from stereoweave.learn.data.silhouettes import Patch


def rectangle(left, top, right, bottom, canvas):
    corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom]], float)
    return Patch(draw_outline_field((corners,), 0, 0, (canvas[1], canvas[0])), 0, 0)


def sampled(image, shift_px):
    """Sample the image [H, W, C] at x + shift_px by linear interpolation; the borders repeat."""
    height, width = shift_px.shape
    column = np.clip(np.arange(width) + shift_px, 0, width - 1)
    before = np.minimum(column.astype(int), width - 2)
    part = (column - before)[..., None]
    row = np.arange(height)[:, None]
    return (1 - part) * image[row, before] + part * image[row, before + 1]


def plain_view(scene, side):
    """Return image and disparity of a view; side 0 is the left view, 1 the right one."""
    layers = [plain_layer(scene, layer, side) for layer in scene.layers]
    nearest = np.max([np.where(field >= 0, d, -1) for field, d in layers], axis=0)
    opaque = np.max([np.where(field >= 0.5, d, -1) for field, d in layers], axis=0)
    image = np.zeros((scene.height, scene.width, 3))
    for layer, (field, disparity_px) in zip(scene.layers, layers, strict=True):
        coverage = np.clip(field + 0.5, 0, 1) * (disparity_px >= opaque)
        image += coverage[..., None] * (plain_colour(layer.paint, disparity_px, side) - image)
    return image, nearest


def plain_layer(scene, layer, side):
    """Return field and disparity over the whole view."""
    patch, d = layer.patch, layer.surface.over(layer.patch).astype(float)
    field = np.full((scene.height, scene.width), -REACH_PX)
    disparity_px = np.zeros((scene.height, scene.width))
    columns = np.arange(scene.width)
    if patch.field.size == 0:
        return field, disparity_px
    for y in range(patch.field.shape[0]):
        source = patch.left + np.arange(patch.field.shape[1])
        seen_at = source - side * d[y]
        field[patch.top + y] = np.interp(columns, seen_at, patch.field[y], -REACH_PX, -REACH_PX)
        disparity_px[patch.top + y] = np.interp(columns, seen_at, source) - columns if side else 0
        if not side:
            disparity_px[patch.top + y] = np.interp(columns, seen_at, d[y])
    return field, disparity_px


def plain_colour(paint, disparity_px, side):
    height, width = disparity_px.shape
    y = np.arange(height)[:, None] + np.zeros(width)
    x = np.arange(width) + side * disparity_px
    texel = mirrored(paint.texture.astype(float), *mapped(paint.to_texture, x, y))
    light = mirrored(paint.light[..., None].astype(float), *mapped(paint.to_light, x, y))
    centre_x, centre_y, inverse_x, inverse_y, strength, shift = paint.gloss.astype(float)
    across, down = (x - centre_x - side * shift) * inverse_x, (y - centre_y) * inverse_y
    shine = strength * np.exp(-(across**2) - down**2)
    colour = np.maximum(texel @ paint.to_colour[:, :3].T + paint.to_colour[:, 3], 0) * light
    return np.minimum(colour + shine[..., None], 255)


def mapped(mapping, x, y):
    return [row[0] * x + row[1] * y + row[2] for row in mapping.astype(float)]


def mirrored(image, u, v):
    """Sample the image bilinearly; beyond its borders it is reflected."""
    there_and_back = [np.r_[0:n, n - 2 : 0 : -1] for n in image.shape[:2]]
    result = 0
    for dv in (0, 1):
        for du in (0, 1):
            i, j = np.floor(v).astype(int) + dv, np.floor(u).astype(int) + du
            weight = (1 - np.abs(v - i)) * (1 - np.abs(u - j))
            rows = there_and_back[0][i % len(there_and_back[0])]
            columns = there_and_back[1][j % len(there_and_back[1])]
            result = result + weight[..., None] * image[rows, columns]
    return result
