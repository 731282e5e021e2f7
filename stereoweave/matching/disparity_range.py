"""The range of disparities of a pair, whatever it is: from sparse matches along the rows.

Both photographs are made small, and on some of their rows what stands out in the left one is looked for along
the whole row of the right one, in either direction.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from stereoweave.stereo import StereoPair

_WIDTH_PX = 384
_ROWS = 32
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
# What the matches did not meet is nearer by so much of their range, and so many px of the small ones.
_MARGIN_SHARE, _MARGIN_PX = 0.06, 2.0
# Of the matches in a part of the picture, so many and such a share have to lie beyond a range.
_LEAST_BEYOND, _LEAST_SHARE_BEYOND = 6, 0.1
_SLACK_PX = 0.6


class _Texture(NamedTuple):
    """The windows of a small grey picture, freed of brightness.

    Attributes:
        windows: Grey levels less their mean around, in the window that has a pixel of column x in its middle;
            by its first row and x.
        scale: What makes the window around a pixel one of length 1; 0 where it is plain, and matches nothing.
    """

    windows: Float32[np.ndarray, "h2 w r c"]
    scale: Float32[np.ndarray, "h w"]


def find_range(pair: StereoPair) -> tuple[float, float] | None:
    """The least and the greatest disparity of the left view in px, negative ones included.

    The greatest has a margin, for what the matches did not meet. The least has none: a network takes a plain
    sky for what is at the lower end of its range (5 px lower doubles the wrong pixels of a rendered ship).

    None where too little of one picture is found in the other, as in plain pictures, or in two that are no
    pair. What the pictures do not show is not looked at.
    """
    disparity_px = _disparities(pair, None)
    if len(disparity_px) < _LEAST_MATCHES:
        return None
    low_px, high_px = np.percentile(disparity_px, [_ENDS_PERCENT, 100 - _ENDS_PERCENT])
    margin_px = _MARGIN_SHARE * (high_px - low_px) + _MARGIN_PX * _scale(pair.left)
    return float(low_px), float(high_px + margin_px)


def goes_beyond(pair: StereoPair, where: Bool[np.ndarray, "h w"], range_px: tuple[float, float]) -> bool:
    """Whether something in a part of the left picture has a disparity outside of a range."""
    slack_px = _SLACK_PX * _scale(pair.left)
    disparity_px = _disparities(pair, where)
    beyond = (disparity_px < range_px[0] - slack_px) | (disparity_px > range_px[1] + slack_px)
    return bool(beyond.sum() >= max(_LEAST_BEYOND, _LEAST_SHARE_BEYOND * len(beyond)))


def _scale(photo: UInt8[np.ndarray, "h w 3"]) -> float:
    """How many times smaller the picture is made."""
    width = photo.shape[1]
    return width / min(width, _WIDTH_PX)


def _disparities(pair: StereoPair, where: Bool[np.ndarray, "h w"] | None) -> Float[np.ndarray, " n"]:
    """The disparities in px of places that stand out, `where` that is wished if given."""
    left, right = _small_grey(pair.left), _small_grey(pair.right)
    wanted = _inner(pair.left_seen, left)
    if where is not None:
        wanted &= _small_mask(where, left)
    matches = _supported(_row_matches(left, right, wanted, _inner(pair.right_seen, right)))
    return matches[:, 2] * _scale(pair.left)


def _small_grey(photo: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h2 w2"]:
    height, width = photo.shape[:2]
    size = min(width, _WIDTH_PX), max(round(height / _scale(photo)), 2 * _WINDOW_ROWS)
    grey = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY)
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)


def _small_mask(
    mask: Bool[np.ndarray, "h w"], small: Float32[np.ndarray, "h2 w2"]
) -> Bool[np.ndarray, "h2 w2"]:
    return cv2.resize(mask.astype(np.uint8), small.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0


def _inner(
    seen: Bool[np.ndarray, "h w"] | None, small: Float32[np.ndarray, "h2 w2"]
) -> Bool[np.ndarray, "h2 w2"]:
    """Where a small picture shows something in all of the window: what begins beside it is no texture."""
    if seen is None:
        return np.ones(small.shape, bool)
    window = np.ones((_WINDOW_ROWS + 2, _WINDOW_COLUMNS + 2), np.uint8)
    return cv2.erode(_small_mask(seen, small).astype(np.uint8), window) > 0


def _row_matches(
    left: Float32[np.ndarray, "h w"],
    right: Float32[np.ndarray, "h w"],
    wanted: Bool[np.ndarray, "h w"],
    seen: Bool[np.ndarray, "h w"],
) -> Float[np.ndarray, "n 3"]:
    """Column, row and disparity in px of what both grey pictures show on a row, and nothing else is like.

    Args:
        left: The left picture, in grey levels.
        right: The right one.
        wanted: Where the left one is looked at.
        seen: Where the right one is.
    """
    height = left.shape[0]
    rows = np.linspace(_WINDOW_ROWS // 2, height - 1 - _WINDOW_ROWS // 2, min(_ROWS, height // 4))
    rows = rows.round().astype(int)
    own, other = _texture(left), _texture(right)
    other.scale[~seen] = 0
    rows, columns = _outstanding(left, rows, wanted & (own.scale > 0))
    likeness = _likeness(own, rows, columns, other)
    best, offsets_px, sure = _peaks(likeness)
    back = _likeness(other, rows[sure], best[sure], own).argmax(1)
    sure[sure] = np.abs(back - columns[sure]) <= 1
    return np.stack([columns, rows, columns - best - offsets_px], axis=1)[sure]


def _peaks(
    likeness: Float32[np.ndarray, "n w"],
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """The column that is most like, how far from it the peak is, and whether it is like and nothing else is.

    What is near a peak is overwritten.
    """
    width = likeness.shape[1]
    each, best = np.arange(len(likeness)), likeness.argmax(1)
    before, highest, behind = (likeness[each, np.clip(best + step, 0, width - 1)] for step in (-1, 0, 1))
    near = np.clip(best[:, None] + np.arange(-_PEAK_PX, _PEAK_PX + 1), 0, width - 1)
    np.put_along_axis(likeness, near, -1, 1)
    sure = (highest >= _LEAST_LIKENESS) & (1 - highest <= _MOST_AMBIGUOUS * (1 - likeness.max(1)))
    # The top of the parabola through the highest likeness and those beside it.
    bend = np.maximum(2 * highest - before - behind, 1e-6)
    return best, np.clip((behind - before) / (2 * bend), -0.5, 0.5), sure


def _outstanding(
    grey: Float32[np.ndarray, "h w"], rows: Int[np.ndarray, " r"], wanted: Bool[np.ndarray, "h w"]
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Rows and columns of the places of most contrast in every _SPACING_PX of the rows, where wanted."""
    steps = np.abs(cv2.Sobel(grey, cv2.CV_32F, 1, 0))[rows]
    count = grey.shape[1] // _SPACING_PX
    cells = steps[:, : count * _SPACING_PX].reshape(len(rows), count, _SPACING_PX)
    columns = cells.argmax(2) + _SPACING_PX * np.arange(count)
    places = np.repeat(rows, count), columns.ravel()
    ok = wanted[places]
    return places[0][ok], places[1][ok]


def _texture(grey: Float32[np.ndarray, "h w"]) -> _Texture:
    size = (_WINDOW_COLUMNS, _WINDOW_ROWS)
    uneven = grey - cv2.blur(grey, size)
    # Its running sums may end a little below 0.
    contrast = np.sqrt(np.maximum(cv2.blur(uneven * uneven, size), 0))
    length = np.sqrt(np.float32(_WINDOW_ROWS * _WINDOW_COLUMNS)) * contrast
    scale = np.zeros_like(length)
    np.divide(1, length, out=scale, where=contrast >= _LEAST_CONTRAST_LEVELS)
    beside = _WINDOW_COLUMNS // 2
    around = cv2.copyMakeBorder(uneven, 0, 0, beside, beside, cv2.BORDER_REPLICATE)
    return _Texture(np.lib.stride_tricks.sliding_window_view(around, size[::-1]), scale)


def _likeness(
    own: _Texture, rows: Int[np.ndarray, " n"], columns: Int[np.ndarray, " n"], other: _Texture
) -> Float32[np.ndarray, "n w"]:
    """How like the window around each of these places is to each of the other picture's on its row."""
    width, pixels = other.scale.shape[1], _WINDOW_ROWS * _WINDOW_COLUMNS
    likeness = np.empty((len(rows), width), np.float32)
    # A row at a time: its windows, a matrix [77, W], stay in the processor's cache.
    for row in np.unique(rows):
        here, first = rows == row, row - _WINDOW_ROWS // 2
        within = own.windows[first, columns[here]].reshape(-1, pixels)
        along = other.windows[first].transpose(1, 2, 0).reshape(pixels, width)
        # Not a product of matrices: NumPy would use all cores, which may be more than the caller allows.
        likeness[here] = np.einsum("nk,kw->nw", within, along)
    return likeness * own.scale[rows, columns, None] * other.scale[rows]


def _supported(matches: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """The matches that enough others beside them have a like disparity."""
    if not len(matches):
        return matches
    cells = (matches // _CELL_PX).astype(int)
    cells = cells - cells.min(0) + 1
    counts = np.zeros(cells.max(0) + 2, int)
    np.add.at(counts, tuple(cells.T), 1)
    around = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3), -1).reshape(-1, 1, 3)
    return matches[counts[tuple(np.moveaxis(cells + around, 2, 0))].sum(0) >= _SUPPORT]
