"""Numba kernel of `smooth_streaks`; the plain reference is in tests/matching/test_streaks.py."""

import typing

import numpy as np

from stereoweave.matching.median_kernels import make_median
from stereoweave.system.jit import kernel

ROWS = 11
"""Number of pixels of a column whose median a pixel becomes.

Streaks are a few rows high, and depth edges there rarely follow the rows.
"""
# Columns whose medians are found at once, so that the compiler can vectorise.
_ABREAST = 16
_move_medians_first = make_median(ROWS, _ABREAST)


@kernel
@typing.no_type_check
def smooth(disparity_px, flat, smoothed_px):
    """Write the medians of the columns around some pixels.

    The rows beyond the image are those of its border.

    Args:
        disparity_px: float32 [H, W].
        flat: int64 [N], the pixels' indices in row-major order, ascending.
        smoothed_px: float32 [H, W]; its other pixels stay.
    """
    height, width = disparity_px.shape
    values = np.zeros(ROWS * _ABREAST, np.float32)
    done = 0
    while done < len(flat):
        y, first = flat[done] // width, flat[done] % width
        count = min(_ABREAST, width - first)
        for i in range(ROWS):
            row = min(max(y - ROWS // 2 + i, 0), height - 1)
            for k in range(count):
                values[i * _ABREAST + k] = disparity_px[row, first + k]
        _move_medians_first(values)
        while done < len(flat) and flat[done] < y * width + first + count:
            x = flat[done] - y * width
            smoothed_px[y, x] = values[x - first]
            done += 1
