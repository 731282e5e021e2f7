"""Numba kernels that find wrong disparities by the left-right check, and replace them (section 4.3.1).

The plain reference implementation is tests/helpers/plain_mc_cnn.py. Disparities are int32 [H, W].
"""

import typing

import numpy as np

from stereoweave.system.jit import inlined, kernel

CORRECT, OCCLUDED, MISMATCHED = 0, 1, 2
"""Labels of a pixel: both views agree; no candidate makes them agree; another candidate does."""
# The 16 directions in which a mismatched pixel looks for correct ones, in half pixels: columns, then rows.
_COLUMNS = np.array([0, -1, -2, -2, -2, -2, -2, -1, 0, 1, 2, 2, 2, 2, 2, 1])
_ROWS = np.array([2, 2, 2, 1, 0, -1, -2, -2, -2, -2, -2, -1, 0, 1, 2, 2])


@kernel
@typing.no_type_check
def label(left_px, right_px, count, labels):
    """Write the label of each pixel of the left view; disparities are below count."""
    height, width = left_px.shape
    for y in range(height):
        for x in range(width):
            own = left_px[y, x]
            labels[y, x] = OCCLUDED
            if abs(own - right_px[y, x - own]) <= 1:
                labels[y, x] = CORRECT
                continue
            for d in range(min(x + 1, count)):
                if abs(d - right_px[y, x - d]) <= 1:
                    labels[y, x] = MISMATCHED
                    break


@inlined
@typing.no_type_check
def _find_background(left_px, labels, y, x):
    """Return the disparity of the next correct pixel to the left; else to the right; else the pixel's."""
    for column in range(x - 1, -1, -1):
        if labels[y, column] == CORRECT:
            return left_px[y, column]
    for column in range(x + 1, labels.shape[1]):
        if labels[y, column] == CORRECT:
            return left_px[y, column]
    return left_px[y, x]


@inlined
@typing.no_type_check
def _insert(found, count, value):
    """Insert a value into the first count ones, which are sorted."""
    place = count
    while place > 0 and found[place - 1] > value:
        found[place] = found[place - 1]
        place -= 1
    found[place] = value


@inlined
@typing.no_type_check
def _find_median(left_px, labels, y, x, found):
    """Return the upper median of the next correct disparities in 16 directions; else the pixel's."""
    height, width = labels.shape
    count = 0
    for i in range(len(_COLUMNS)):
        step = 1
        row, column = y + (_ROWS[i] + 1) // 2, x + (_COLUMNS[i] + 1) // 2
        while 0 <= row < height and 0 <= column < width:
            if labels[row, column] == CORRECT:
                _insert(found, count, left_px[row, column])
                count += 1
                break
            step += 1
            row, column = y + (step * _ROWS[i] + 1) // 2, x + (step * _COLUMNS[i] + 1) // 2
    return found[count // 2] if count else left_px[y, x]


@kernel
@typing.no_type_check
def replace(left_px, labels, filled_px):
    """Write the disparities, with those of occluded and mismatched pixels taken from correct ones."""
    height, width = left_px.shape
    found = np.empty(len(_COLUMNS), np.int32)
    for y in range(height):
        for x in range(width):
            if labels[y, x] == OCCLUDED:
                filled_px[y, x] = _find_background(left_px, labels, y, x)
            elif labels[y, x] == MISMATCHED:
                filled_px[y, x] = _find_median(left_px, labels, y, x, found)
            else:
                filled_px[y, x] = left_px[y, x]
