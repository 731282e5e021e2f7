"""The range of disparities of a pair, whatever it is: from sparse matches along the rows.

Both photographs are made small, and on some of their rows what stands out in the left one is looked for along
the whole row of the right one, in either direction.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8

_WIDTH_PX = 384
_ROWS, _ROWS_OF_A_PART = 32, 12
# What is compared: so many rows by so many columns.
_WINDOW_ROWS, _WINDOW_COLUMNS = 7, 11
# At most one place in so many columns is looked for, where grey levels vary by so much.
_SPACING_PX = 6
_LEAST_CONTRAST_LEVELS = 3.0
# A match is so like (1 is equal), and what else is like it in the row is less so.
_LEAST_LIKENESS = 0.8
_MOST_AMBIGUOUS = 0.7
_PEAK_PX = 2
# A match counts if so many are near it, in the cells of a grid in columns, rows and disparity and next to it.
_SUPPORT = 4
_CELL_PX = (32, 32, 3)
_LEAST_MATCHES = 30
_ENDS_PERCENT = 0.5
# What the matches did not meet lies beyond them by so much of their range, and so many px of the small ones.
_MARGIN_SHARE, _MARGIN_PX = 0.06, 2.0
# Of the matches in a part of the picture, so many and such a share have to lie beyond a range.
_LEAST_BEYOND, _LEAST_SHARE_BEYOND = 6, 0.1
_SLACK_PX = 1.5


def find_range(
    left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"]
) -> tuple[float, float] | None:
    """The least and the greatest disparity of the left view in px, with a margin, negative ones included.

    None where too little of one picture is found in the other, as in plain pictures, or in two that are no
    pair.

    Args:
        left: The left photograph of a rectified pair, uint8 RGB [H, W, 3].
        right: The right one, of the same size.
    """
    scale = _scale(left)
    disparity_px = _disparities(left, right, None)
    if len(disparity_px) < _LEAST_MATCHES:
        return None
    low_px, high_px = np.percentile(disparity_px, [_ENDS_PERCENT, 100 - _ENDS_PERCENT])
    margin_px = _MARGIN_SHARE * (high_px - low_px) + _MARGIN_PX * scale
    return float(low_px - margin_px), float(high_px + margin_px)


def goes_beyond(
    left: UInt8[np.ndarray, "h w 3"],
    right: UInt8[np.ndarray, "h w 3"],
    where: Bool[np.ndarray, "h w"],
    range_px: tuple[float, float],
) -> bool:
    """Whether something in a part of the left picture has a disparity outside of a range."""
    slack_px = _SLACK_PX * _scale(left)
    disparity_px = _disparities(left, right, where)
    beyond = (disparity_px < range_px[0] - slack_px) | (disparity_px > range_px[1] + slack_px)
    return bool(beyond.sum() >= max(_LEAST_BEYOND, _LEAST_SHARE_BEYOND * len(beyond)))


def _scale(photo: UInt8[np.ndarray, "h w 3"]) -> float:
    """How many times smaller the picture is made."""
    width = photo.shape[1]
    return width / min(width, _WIDTH_PX)


def _disparities(
    left: UInt8[np.ndarray, "h w 3"],
    right: UInt8[np.ndarray, "h w 3"],
    where: Bool[np.ndarray, "h w"] | None,
) -> Float32[np.ndarray, " n"]:
    """The disparities in px of places that stand out, `where` that is wished if given."""
    small_left, small_right = _small_grey(left), _small_grey(right)
    wanted = np.ones(small_left.shape, bool)
    if where is not None:
        size = small_left.shape[::-1]
        wanted = cv2.resize(where.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    matches = _supported(row_matches(small_left, small_right, wanted))
    return (matches[:, 2] * _scale(left)).astype(np.float32)


def row_matches(
    left: Float32[np.ndarray, "h w"], right: Float32[np.ndarray, "h w"], wanted: Bool[np.ndarray, "h w"]
) -> Int[np.ndarray, "n 3"]:
    """Column, row and disparity in px of what both grey pictures show on a row, and nothing else is like."""
    height, width = left.shape
    rows = np.linspace(_WINDOW_ROWS // 2, height - 1 - _WINDOW_ROWS // 2, min(_ROWS, height // 4))
    rows = rows.round().astype(int)
    if not wanted.all():
        most = np.argsort(wanted[rows].sum(1))[-_ROWS_OF_A_PART:]
        rows = rows[np.sort(most)]
    at, columns = _outstanding(left, rows, wanted)
    own, other = _windows(left, rows), _windows(right, rows)
    found = np.full(columns.shape, -width)
    for i in range(len(rows)):
        places = columns[at == i]
        likeness = own[i, places] @ other[i].T
        best = likeness.argmax(1)
        highest = likeness.max(1)
        near = np.abs(np.arange(width) - best[:, None]) <= _PEAK_PX
        second = np.where(near, -1, likeness).max(1)
        back = (other[i, best] @ own[i].T).argmax(1)
        alone = 1 - highest <= _MOST_AMBIGUOUS * (1 - second)
        sure = (highest >= _LEAST_LIKENESS) & alone & (np.abs(back - places) <= 1)
        found[at == i] = np.where(sure, best, -width)
    sure = found >= 0
    return np.stack([columns[sure], rows[at[sure]], (columns - found)[sure]], axis=1)


def _small_grey(photo: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h2 w2"]:
    height, width = photo.shape[:2]
    size = min(width, _WIDTH_PX), max(round(height / _scale(photo)), 2 * _WINDOW_ROWS)
    grey = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY)
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)


def _outstanding(
    grey: Float32[np.ndarray, "h w"], rows: Int[np.ndarray, " r"], wanted: Bool[np.ndarray, "h w"]
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """The column of most contrast in every _SPACING_PX of the rows, where wanted: its row's index, and it."""
    steps = np.abs(cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=1 / 8))[rows]
    count = grey.shape[1] // _SPACING_PX
    cells = steps[:, : count * _SPACING_PX].reshape(len(rows), count, _SPACING_PX)
    columns = cells.argmax(2) + _SPACING_PX * np.arange(count)
    chosen = np.take_along_axis(wanted[rows], columns, 1)
    return np.nonzero(chosen)[0], columns[chosen]


def _windows(grey: Float32[np.ndarray, "h w"], rows: Int[np.ndarray, " r"]) -> Float32[np.ndarray, "r w k"]:
    """The window around each pixel of the rows, its mean taken off, of length 1; 0 where it is plain."""
    beside = _WINDOW_COLUMNS // 2
    around = cv2.copyMakeBorder(grey, 0, 0, beside, beside, cv2.BORDER_REPLICATE)
    views = np.lib.stride_tricks.sliding_window_view(around, (_WINDOW_ROWS, _WINDOW_COLUMNS))
    windows = views[rows - _WINDOW_ROWS // 2].reshape(
        len(rows), grey.shape[1], _WINDOW_ROWS * _WINDOW_COLUMNS
    )
    windows = windows - windows.mean(2, keepdims=True)
    length = np.sqrt(np.einsum("rwk,rwk->rw", windows, windows))
    plain = length < _LEAST_CONTRAST_LEVELS * np.sqrt(windows.shape[2])
    return windows * np.where(plain, 0, 1 / np.maximum(length, 1e-6))[..., None].astype(np.float32)


def _supported(matches: Int[np.ndarray, "n 3"]) -> Int[np.ndarray, "m 3"]:
    """The matches that enough others beside them have a like disparity."""
    if not len(matches):
        return matches
    cells = matches // _CELL_PX
    cells = cells - cells.min(0) + 1
    counts = np.zeros(cells.max(0) + 2, int)
    np.add.at(counts, tuple(cells.T), 1)
    around = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3), -1).reshape(-1, 1, 3)
    return matches[counts[tuple(np.moveaxis(cells + around, 2, 0))].sum(0) >= _SUPPORT]
