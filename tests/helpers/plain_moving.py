"""Plain NumPy reference of `camera_motion_kernels` and `hole_filling_kernels.lay`."""

import numpy as np
from plain_rendering import SAME_SURFACE_PX, cubic, linear, tap

from stereoweave.rendering.canvas_kernels import NOTHING


def plain_move(view, targets, disparity_px, before):
    """Return the canvas after `camera_motion_kernels.move`, given the canvas before it."""
    lines = zip(view.surface_px, targets, disparity_px, strict=True)
    landed_px, source = np.swapaxes([plain_landing(*line) for line in lines], 0, 1)
    pure = np.isfinite(landed_px)
    x, width = np.floor(source).astype(int), source.shape[1]
    around_px = np.array([tap(view.surface_px, np.clip(x + k, 0, width - 1)) for k in (-1, 0, 1, 2)])
    smooth = np.ptp(around_px, axis=0) <= SAME_SURFACE_PX
    photo = view.image.astype(float)
    colours = np.where(smooth[..., None], cubic(photo, source), linear(photo, source))
    return type(view)(
        image=np.where(pure[..., None], np.floor(np.clip(colours, 0, 255) + 0.5), before.image),
        surface_px=np.where(pure, landed_px, before.surface_px),
        pure=pure,
        drawn=np.where(pure, tap(view.drawn, np.floor(source + 0.5).astype(int)), before.drawn),
    )


def plain_landing(surface_px, targets, disparity_px):
    """Return the nearest disparity on each column of a row (NaN: none), and its fractional source column."""
    columns = np.arange(len(targets))
    joined = np.abs(np.diff(surface_px)) <= SAME_SURFACE_PX
    landed_px, source = np.full(len(targets), np.nan), np.zeros(len(targets))

    def land(begin, end, start, d, length, rise_px):
        for u in columns[(columns >= begin) & (columns < end)]:
            part = np.clip((u - targets[start]) / length, 0, 1)
            if not d + part * rise_px <= landed_px[u]:
                landed_px[u], source[u] = d + part * rise_px, start + part

    for x, (at, d) in enumerate(zip(targets.astype(float), disparity_px.astype(float), strict=True)):
        begin = at if x > 0 and joined[x - 1] else at - 0.5
        if x == len(columns) - 1 or not joined[x]:
            land(begin, at + 0.5, x, d, np.inf, 0.0)
        elif targets[x + 1] > at:
            land(begin, targets[x + 1], x, d, targets[x + 1] - at, disparity_px[x + 1] - d)
    return landed_px, source


def plain_lay(hidden_px, colours, shift, offset_px, canvas):
    """Return the canvas after `hole_filling_kernels.paint_background` painted the nearest background."""
    result = type(canvas)(*(values.copy() for values in canvas))
    height, width = hidden_px.shape
    at = np.arange(width) + shift * hidden_px.astype(float) + offset_px
    for y in range(height):
        for u in np.flatnonzero(~canvas.pure[y]):
            own_px = canvas.surface_px[y, u]
            lands = np.flatnonzero((at[y] >= u - 0.5) & (at[y] < u + 0.5))
            lands = [x for x in lands if own_px == NOTHING or hidden_px[y, x] <= own_px + SAME_SURFACE_PX]
            if lands:
                x = max(lands, key=lambda column: hidden_px[y, column])
                result.image[y, u] = plain_mix(hidden_px[y], colours[y].astype(float), x, u - at[y, x])
                result.surface_px[y, u], result.pure[y, u], result.drawn[y, u] = hidden_px[y, x], True, False
    return result


def plain_mix(hidden_px, colours, x, beyond):
    """Return the colour beside hidden pixel x, interpolated towards its neighbour on the same surface."""
    beside = x + (1 if beyond > 0 else -1)
    if not (0 <= beside < len(hidden_px) and abs(hidden_px[beside] - hidden_px[x]) <= SAME_SURFACE_PX):
        return colours[x]
    return np.floor(colours[x] + abs(beyond) * (colours[beside] - colours[x]) + 0.5)
