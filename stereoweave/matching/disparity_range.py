"""Detection of a pair's disparity range from sparse matches, with no limit on the disparity.

Each high-contrast pixel in sampled rows of the downsampled left image is searched for along the entire
corresponding row of the right image.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from stereoweave.stereo import StereoPair

_WIDTH_PX = 384
_ROWS = 32
# Size of the windows that are compared.
_WINDOW_ROWS, _WINDOW_COLUMNS = 7, 11
# At most one pixel per this many columns is matched, and only if its window has at least this contrast.
_SPACING_PX = 6
_LEAST_CONTRAST_LEVELS = 3.0
# Least correlation of a match (1 means identical), and the limit of the ratio test against the second-best
# peak in the row.
_LEAST_LIKENESS = 0.8
_MOST_AMBIGUOUS = 0.7
_PEAK_PX = 2
# A match counts if its cell in a grid of column, row and disparity, together with the adjacent cells,
# contains at least this many matches.
_SUPPORT = 4
_CELL_PX = (32, 32, 3)
_LEAST_MATCHES = 30
_ENDS_PERCENT = 0.5
# Margin for nearer surfaces without matches: a share of the range, plus pixels of the downsampled pair.
_MARGIN_SHARE, _MARGIN_PX = 0.06, 2.0
# A region exceeds a range if at least this number and at least this share of its matches lie outside.
_LEAST_BEYOND, _LEAST_SHARE_BEYOND = 6, 0.1
_SLACK_PX = 0.6


class _Texture(NamedTuple):
    """Windows around the pixels of some rows of a small grey image, with the local mean removed.

    Attributes:
        windows: Grey levels minus their local mean, in windows [row, centre column, rows, columns].
        scale: Factor that normalises the window around each pixel to length 1; 0 for plain windows.
    """

    windows: Float32[np.ndarray, "n w r c"]
    scale: Float32[np.ndarray, "n w"]


def find_range(pair: StereoPair) -> tuple[float, float] | None:
    """Return the least and the greatest disparity of the left view in px; either may be negative.

    The greatest disparity includes a margin for nearer surfaces without matches. The least disparity has no
    margin, because a network assigns the lower end of its range to a plain sky. In a rendered scene with a
    ship, a least disparity 5 px too low doubled the number of wrong pixels.

    Pixels without content are ignored. Returns None if there are too few matches, as in plain images or
    images of different scenes.
    """
    disparity_px = _find_disparities(pair, None, _LEAST_MATCHES)
    if len(disparity_px) < _LEAST_MATCHES:
        return None
    low_px, high_px = np.percentile(disparity_px, [_ENDS_PERCENT, 100 - _ENDS_PERCENT])
    margin_px = _MARGIN_SHARE * (high_px - low_px) + _MARGIN_PX * _scale(pair.left)
    return float(low_px), float(high_px + margin_px)


def goes_beyond(pair: StereoPair, where: Bool[np.ndarray, "h w"], range_px: tuple[float, float]) -> bool:
    """Return whether the region `where` of the left image contains disparities outside `range_px`."""
    slack_px = _SLACK_PX * _scale(pair.left)
    disparity_px = _find_disparities(pair, where, _LEAST_BEYOND)
    beyond = (disparity_px < range_px[0] - slack_px) | (disparity_px > range_px[1] + slack_px)
    return bool(beyond.sum() >= max(_LEAST_BEYOND, _LEAST_SHARE_BEYOND * len(beyond)))


def _scale(image: UInt8[np.ndarray, "h w 3"]) -> float:
    """Return the factor by which the image is downsampled."""
    width = image.shape[1]
    return width / min(width, _WIDTH_PX)


def _find_disparities(
    pair: StereoPair, where: Bool[np.ndarray, "h w"] | None, least_matches: int
) -> Float[np.ndarray, " n"]:
    """Return the disparities in px of the matched left pixels, restricted to the mask `where` if given.

    May return none if there are fewer than `least_matches`.
    """
    left = _small_grey(pair.left)
    wanted = _find_inner(pair.left_seen, left)
    if where is not None:
        wanted &= _small_mask(where, left)
    rows = _sample_rows(wanted)
    if not len(rows):
        return np.empty(0)
    own = _texture(left, rows)
    places, columns = _find_salient(left, rows, wanted[rows] & (own.scale > 0))
    if len(places) < least_matches:
        return np.empty(0)
    right = _small_grey(pair.right)
    other = _texture(right, rows)
    other.scale[~_find_inner(pair.right_seen, right)[rows]] = 0
    found, disparity_px = _match_rows(own, places, columns, other)
    matches = np.stack([columns[found], rows[places[found]], disparity_px], axis=1)
    return _keep_supported(matches)[:, 2] * _scale(pair.left)


def _sample_rows(wanted: Bool[np.ndarray, "h w"]) -> Int[np.ndarray, " n"]:
    """Return the rows in which to match pixels: those of an even sample that have a wanted pixel."""
    height = len(wanted)
    rows = np.linspace(_WINDOW_ROWS // 2, height - 1 - _WINDOW_ROWS // 2, min(_ROWS, height // 4))
    rows = rows.round().astype(int)
    return rows[wanted[rows].any(1)]


def _small_grey(image: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h2 w2"]:
    height, width = image.shape[:2]
    size = min(width, _WIDTH_PX), max(round(height / _scale(image)), 2 * _WINDOW_ROWS)
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)


def _small_mask(
    mask: Bool[np.ndarray, "h w"], small: Float32[np.ndarray, "h2 w2"]
) -> Bool[np.ndarray, "h2 w2"]:
    return cv2.resize(mask.astype(np.uint8), small.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0


def _find_inner(
    seen: Bool[np.ndarray, "h w"] | None, small: Float32[np.ndarray, "h2 w2"]
) -> Bool[np.ndarray, "h2 w2"]:
    """Return the mask of pixels whose entire window has content and lies between the picture's sides.

    Other windows contain a border, which is not texture.
    """
    inner = np.ones(small.shape, bool)
    if seen is not None:
        window = np.ones((_WINDOW_ROWS + 2, _WINDOW_COLUMNS + 2), np.uint8)
        inner = cv2.erode(_small_mask(seen, small).astype(np.uint8), window) > 0
    beside = _WINDOW_COLUMNS // 2
    inner[:, :beside] = inner[:, -beside:] = False
    return inner


def _match_rows(
    own: _Texture, places: Int[np.ndarray, " n"], columns: Int[np.ndarray, " n"], other: _Texture
) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, " m"]]:
    """Return the mask of pixels with a match that is unambiguous in both directions, and its disparity in px.

    Args:
        own: Rows of the left image.
        places: Which of these rows each pixel to match is in.
        columns: Columns of the pixels.
        other: The same rows of the right image.
    """
    likeness = _likeness(own, places, columns, other)
    best, offsets_px, sure = _peaks(likeness)
    back = _likeness(other, places[sure], best[sure], own).argmax(1)
    sure[sure] = np.abs(back - columns[sure]) <= 1
    return sure, (columns - best - offsets_px)[sure]


def _peaks(
    likeness: Float32[np.ndarray, "n w"],
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Return each row's best column, the subpixel offset of its peak, and whether the peak is unambiguous.

    Overwrites the values of `likeness` near the peaks.
    """
    width = likeness.shape[1]
    each, best = np.arange(len(likeness)), likeness.argmax(1)
    before, highest, behind = (likeness[each, np.clip(best + step, 0, width - 1)] for step in (-1, 0, 1))
    near = np.clip(best[:, None] + np.arange(-_PEAK_PX, _PEAK_PX + 1), 0, width - 1)
    np.put_along_axis(likeness, near, -1, 1)
    sure = (highest >= _LEAST_LIKENESS) & (1 - highest <= _MOST_AMBIGUOUS * (1 - likeness.max(1)))
    # Vertex of the parabola through the maximum and its two neighbours.
    bend = np.maximum(2 * highest - before - behind, 1e-6)
    return best, np.clip((behind - before) / (2 * bend), -0.5, 0.5), sure


def _find_salient(
    grey: Float32[np.ndarray, "h w"], rows: Int[np.ndarray, " r"], wanted: Bool[np.ndarray, "r w"]
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Return the pixels of the highest gradient in every _SPACING_PX columns of some rows, within `wanted`.

    Returns:
        Which of the rows each pixel is in, and its column.
    """
    count = grey.shape[1] // _SPACING_PX
    smooth = grey[rows - 1] + 2 * grey[rows] + grey[rows + 1]
    steps = np.zeros_like(smooth)
    steps[:, 1:-1] = np.abs(smooth[:, 2:] - smooth[:, :-2])
    cells = steps[:, : count * _SPACING_PX].reshape(len(rows), count, _SPACING_PX)
    columns = cells.argmax(2) + _SPACING_PX * np.arange(count)
    ok = np.take_along_axis(wanted, columns, 1)
    return ok.nonzero()[0], columns[ok]


def _texture(grey: Float32[np.ndarray, "h w"], rows: Int[np.ndarray, " r"]) -> _Texture:
    """Return the windows around the pixels of the given rows, and their scale."""
    size, width = (_WINDOW_COLUMNS, _WINDOW_ROWS), grey.shape[1]
    above, beside = _WINDOW_ROWS // 2, _WINDOW_COLUMNS // 2
    # Of each row, the rows of its windows and of the windows whose means these need.
    padded = cv2.copyMakeBorder(grey, above, above, 0, 0, cv2.BORDER_REFLECT_101)
    strips = padded[rows[:, None] + np.arange(-above, _WINDOW_ROWS + above)].reshape(-1, width)
    uneven = (
        (strips - cv2.blur(strips, size)).reshape(len(rows), -1, width)[:, above:-above].reshape(-1, width)
    )
    # Rounding in cv2.blur may produce values slightly below 0.
    contrast = np.sqrt(np.maximum(cv2.blur(uneven * uneven, size)[above::_WINDOW_ROWS], 0))
    length = np.sqrt(np.float32(_WINDOW_ROWS * _WINDOW_COLUMNS)) * contrast
    scale = np.divide(1, length, out=np.zeros_like(length), where=contrast >= _LEAST_CONTRAST_LEVELS)
    around = cv2.copyMakeBorder(uneven, 0, 0, beside, beside, cv2.BORDER_REPLICATE)
    around = around.reshape(len(rows), _WINDOW_ROWS, -1)
    return _Texture(np.lib.stride_tricks.sliding_window_view(around, size[::-1], (1, 2))[:, 0], scale)


def _likeness(
    own: _Texture, rows: Int[np.ndarray, " n"], columns: Int[np.ndarray, " n"], other: _Texture
) -> Float32[np.ndarray, "n w"]:
    """Return the correlation of each pixel's window with every window in the same row of the other image."""
    width, pixels = other.scale.shape[1], _WINDOW_ROWS * _WINDOW_COLUMNS
    likeness = np.empty((len(rows), width), np.float32)
    # Works row by row, because the windows of one row, a matrix [77, W], fit in the CPU cache.
    for row in np.unique(rows):
        here = rows == row
        within = own.windows[row, columns[here]].reshape(-1, pixels)
        along = other.windows[row].transpose(1, 2, 0).reshape(pixels, width)
        # Uses einsum, because NumPy's matrix product would use all cores regardless of the caller's limit.
        likeness[here] = np.einsum("nk,kw->nw", within, along)
    return likeness * own.scale[rows, columns, None] * other.scale[rows]


def _keep_supported(matches: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Return the matches that have enough neighbours of similar disparity."""
    if not len(matches):
        return matches
    cells = (matches // _CELL_PX).astype(int)
    cells = cells - cells.min(0) + 1
    counts = np.zeros(cells.max(0) + 2, int)
    np.add.at(counts, tuple(cells.T), 1)
    around = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3), -1).reshape(-1, 1, 3)
    return matches[counts[tuple(np.moveaxis(cells + around, 2, 0))].sum(0) >= _SUPPORT]
