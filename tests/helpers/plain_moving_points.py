"""Plain versions of the kernels that move the points of a frame by the camera's motion."""

import numpy as np

from stereoweave.video.splat_kernels import CRACK_PX, IN_FRONT_PX, NOWHERE_PX


def plain_splat(matrix, right, disparity_px, offset_px):
    """Return nearest disparity, source and offsets; see `splat_kernels.splat`."""
    height, width = disparity_px.shape
    nearest_px = np.full((height, width), NOWHERE_PX, np.float32)
    source, offsets_px = np.full((height, width), -1, np.int32), np.zeros((height, width, 2), np.float32)
    for y, x in np.ndindex(height, width):
        d = float(disparity_px[y, x])
        column, row = np.array([x, y]) + offset_px[y, x].astype(float)
        moved = matrix @ [column + right * d, row, 1, d]
        column, row, _, there_px = moved / moved[2]
        place = np.array([column - right * there_px, row])
        j, i = np.rint(place).astype(int)
        if not (0 <= j < width and 0 <= i < height):
            continue
        apart_px = there_px - nearest_px[i, j]
        closer = np.hypot(*(place - [j, i])) < np.hypot(*offsets_px[i, j])
        if apart_px > IN_FRONT_PX or (apart_px >= -IN_FRONT_PX and closer):
            source[i, j], nearest_px[i, j], offsets_px[i, j] = y * width + x, there_px, place - [j, i]
    return nearest_px, source, offsets_px


def plain_fill_cracks(nearest_px, source, offset_px):
    """Fill cracks in place; see `splat_kernels.fill_cracks`."""
    height, width = nearest_px.shape
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            for before, after in (((y, x - 1), (y, x + 1)), ((y - 1, x), (y + 1, x))):
                both_px = nearest_px[before], nearest_px[after]
                if both_px[0] > nearest_px[y, x] + CRACK_PX and abs(both_px[0] - both_px[1]) <= CRACK_PX:
                    source[y, x], nearest_px[y, x], offset_px[y, x] = source[before], both_px[0], 0
                    break


def plain_find_places(source, offset_px, new_offset_px):
    """Return offsets to the places of every second pixel and whether there are any; see `find_places`."""
    there = np.stack(np.divmod(source, source.shape[1])[::-1], axis=-1) + offset_px.reshape(-1, 2)[source]
    here = np.stack(np.indices(source.shape)[::-1], axis=-1) + new_offset_px
    known = source >= 0
    return np.where(known[..., None], there - here, 0)[::2, ::2], known[::2, ::2]
