"""Detection of negative disparities, and of the depth order at occlusions.

Parallel cameras give disparities of 0 or more. Converged cameras and swapped pictures also give negative
disparities.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

# A disparity below this is negative.
_NEGATIVE_PX = -1.5
# At most this many points are tested, and at least this many of them must be certain.
_MOST_TRIED, _LEAST_SURE = 150, 4
# A point is certain if its window correlates at least this well with its match, and much less with any window
# at a disparity of 0 or more.
_LEAST_LIKENESS, _MOST_AMBIGUOUS = 0.9, 0.7
# Difference between identical windows caused by the rounding of grey levels.
_ROUNDING = 0.003
# Search range for the best window, as a share of the width.
_REACH = 0.45
_RADIUS_PX = 7

# Areas without corners are matched densely at this width and over this range. Points with larger disparities
# have either corners or no texture at all.
_DENSE_WIDTH_PX, _DENSE_RANGE_PX = 160, (-5.0, 53.0)
_DENSE_NEGATIVE_PX, _DENSE_RADIUS_PX = -0.5, 4
_LEAST_TEXTURE_LEVELS = 1.0

# Occlusion is examined at this width, by semi-global matching with OpenCV's usual penalties.
_OCCLUSION_WIDTH_PX = 320
_BLOCK_PX, _MARGIN_PX = 5, 3
_LEAST_JUMP_PX, _LEAST_COLOUR_STEP, _BESIDE_PX = 2.0, 10.0, 3
# Number of neutral votes added for regularisation.
_VOTES_OF_DOUBT = 20


def find_negative_disparities(
    left: UInt8[np.ndarray, "h w 3"],
    right: UInt8[np.ndarray, "h w 3"],
    places_px: Float[np.ndarray, "n 2"],
    disparity_px: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " m"]:
    """Return the negative disparities in px for which no positive match is plausible.

    Returns an empty array if there are too few. On repeated structures, such as a truss, matches can be off
    by one period. A positive candidate that fits about as well is then preferred, because parallel pairs are
    far more common than converged ones.

    Args:
        left: Left image of a rectified pair, uint8 RGB [H, W, 3].
        right: Right image of the same size.
        places_px: Columns and rows of points in the left image.
        disparity_px: Disparities in px at these points. If too few are certain, areas without corners are
            matched densely as well.
    """
    negative = disparity_px < _NEGATIVE_PX
    greys = cv2.cvtColor(left, cv2.COLOR_RGB2GRAY), cv2.cvtColor(right, cv2.COLOR_RGB2GRAY)
    sure_px = _select_certain(*greys, places_px[negative], disparity_px[negative], _RADIUS_PX)
    if len(sure_px) >= _LEAST_SURE:
        return sure_px
    factor = min(1.0, _DENSE_WIDTH_PX / left.shape[1])
    left, right = (_shrink(image, factor) for image in (left, right))
    places_px, disparity_px = _find_dense_negative(left, right)
    greys = cv2.cvtColor(left, cv2.COLOR_RGB2GRAY), cv2.cvtColor(right, cv2.COLOR_RGB2GRAY)
    sure_px = _select_certain(*greys, places_px, disparity_px, _DENSE_RADIUS_PX)
    return sure_px / factor if len(sure_px) >= _LEAST_SURE else sure_px[:0]


def _find_dense_negative(
    left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Return the left picture's points with negative semi-global disparities, and these disparities."""
    disparity_px, seen = _match_densely(left, right, *_DENSE_RANGE_PX)
    slope = cv2.Sobel(cv2.cvtColor(left, cv2.COLOR_RGB2GRAY), cv2.CV_32F, 1, 0, scale=1 / 8)
    textured = cv2.blur(np.abs(slope), (_BLOCK_PX, _BLOCK_PX)) > _LEAST_TEXTURE_LEVELS
    rows, columns = np.nonzero(seen & textured & (disparity_px < _DENSE_NEGATIVE_PX))
    return np.stack([columns, rows], axis=1).astype(float), disparity_px[rows, columns].astype(float)


def _select_certain(
    left: UInt8[np.ndarray, "h w"],
    right: UInt8[np.ndarray, "h w"],
    places_px: Float[np.ndarray, "n 2"],
    disparity_px: Float[np.ndarray, " n"],
    radius_px: int,
) -> Float[np.ndarray, " m"]:
    """Sample the given disparities, and return those that are unambiguous in both directions."""
    step = max(1, -(-len(places_px) // _MOST_TRIED))
    disparity_px = disparity_px[::step]
    columns, rows = np.rint(places_px[::step]).astype(int).T
    partners = np.clip(np.rint(columns - disparity_px).astype(int), 0, left.shape[1] - 1)
    rim = radius_px + 1
    reach_px = round(_REACH * left.shape[1])
    left, right = (
        cv2.copyMakeBorder(grey, rim, rim, rim, rim, cv2.BORDER_REPLICATE) for grey in (left, right)
    )
    sure = [
        _is_unambiguous(left, right, (row, column, partner), -reach_px, radius_px)
        and _is_unambiguous(right, left, (row, partner, column), reach_px, radius_px)
        for row, column, partner in np.stack([rows, columns, partners], axis=1).tolist()
    ]
    return disparity_px[np.array(sure, bool)]


def _is_unambiguous(
    own: UInt8[np.ndarray, "h w"],
    other: UInt8[np.ndarray, "h w"],
    place: tuple[int, int, int],
    reach_px: int,
    radius_px: int,
) -> bool:
    """Return whether a window correlates with its match but with no window at a positive disparity.

    Args:
        own: The picture with the window, padded by a border of `radius_px` + 1.
        other: The other picture, padded by the same border.
        place: Row and column of the window, and column of its match, not counting the border.
        reach_px: Search range for positive disparities; negative, to the left, if `other` is the right
            picture, and positive if it is the left one.
        radius_px: Radius of the window.
    """
    row, column, partner = place
    last_column = own.shape[1] - 2 * radius_px - 3
    end = min(max(column + reach_px, 0), last_column)
    window = _cut_strip(own, row, column, column, radius_px)[1:-1]
    found = _cut_strip(other, row, partner - 1, partner + 1, radius_px)
    likeness = cv2.matchTemplate(found, window, cv2.TM_CCOEFF_NORMED).max()
    if likeness < _LEAST_LIKENESS:
        return False
    positive = _cut_strip(other, row, min(column, end), max(column, end), radius_px)
    second = cv2.matchTemplate(positive, window, cv2.TM_CCOEFF_NORMED).max()
    return bool(max(1 - likeness, _ROUNDING) <= _MOST_AMBIGUOUS * (1 - second))


def _cut_strip(
    bordered: UInt8[np.ndarray, "h w"], row: int, first: int, last: int, radius_px: int
) -> UInt8[np.ndarray, "h2 w2"]:
    """Return the strip that the windows around columns first..last cover, plus one row above and below."""
    return bordered[row : row + 2 * radius_px + 3, first + 1 : last + 2 * radius_px + 2]


def estimate_depth_order(
    left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"], range_px: tuple[float, float]
) -> float:
    """Return the depth order in -1..1: positive if greater disparities occlude smaller ones, else negative.

    In the left picture, an area that is occluded in the right one lies between a surface of smaller
    disparity and a surface of greater disparity. The area belongs to the farther surface and shares its
    colour.
    """
    factor = min(1.0, _OCCLUSION_WIDTH_PX / left.shape[1])
    small_left, small_right = (_shrink(image, factor) for image in (left, right))
    disparity_px, seen = _match_densely(small_left, small_right, range_px[0] * factor, range_px[1] * factor)
    colours = cv2.cvtColor(cv2.GaussianBlur(small_left, (0, 0), 0.7), cv2.COLOR_RGB2LAB).astype(np.float32)
    votes = [
        vote for row in range(len(seen)) for vote in _vote_in_row(disparity_px[row], seen[row], colours[row])
    ]
    return sum(votes) / (len(votes) + _VOTES_OF_DOUBT)


def _vote_in_row(
    disparity_px: Float32[np.ndarray, " w"], seen: Bool[np.ndarray, " w"], colours: Float32[np.ndarray, "w 3"]
) -> list[float]:
    """Return a vote in -1..1 for each occluded run in a row: positive if it resembles pixels on its left."""
    votes = []
    changes = np.diff(seen.astype(np.int8))
    ends = np.flatnonzero(changes == 1) + 1
    for start in np.flatnonzero(changes == -1) + 1:
        end = next(iter(ends[ends > start]), len(seen))
        if start < _BESIDE_PX or end + _BESIDE_PX > len(seen):
            continue
        jump_px = disparity_px[end + 1] - disparity_px[start - 2]
        before, after = colours[start - _BESIDE_PX : start], colours[end : end + _BESIDE_PX]
        occluded, before, after = (part.mean(0) for part in (colours[start:end], before, after))
        plain = np.linalg.norm(before - after) < _LEAST_COLOUR_STEP
        if plain or jump_px < _LEAST_JUMP_PX or abs(end - start - jump_px) > 0.5 * jump_px + 1:
            continue
        unlike_before, unlike_after = np.linalg.norm(occluded - before), np.linalg.norm(occluded - after)
        votes.append(float((unlike_after - unlike_before) / (unlike_after + unlike_before)))
    return votes


def _match_densely(
    left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"], least_px: float, greatest_px: float
) -> tuple[Float32[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Return the semi-global left disparity and the mask of pixels that pass the left-right check."""
    first_px = int(np.floor(least_px)) - _MARGIN_PX
    count = int(np.ceil((greatest_px + _MARGIN_PX - first_px) / 16)) * 16
    penalty = _BLOCK_PX**2
    matcher = cv2.StereoSGBM.create(first_px, count, _BLOCK_PX, P1=8 * penalty, P2=32 * penalty)
    beside = max(first_px + count, -first_px, 0)
    # Histograms are equalised because exposures may differ.
    greys = [cv2.equalizeHist(cv2.cvtColor(x, cv2.COLOR_RGB2GRAY)) for x in (left, right)]
    greys = [cv2.copyMakeBorder(x, 0, 0, beside, beside, cv2.BORDER_REPLICATE) for x in greys]
    mirrored = [np.ascontiguousarray(x[:, ::-1]) for x in reversed(greys)]
    here = slice(beside, beside + left.shape[1])
    left_px = matcher.compute(*greys)[:, here].astype(np.float32) / 16
    right_px = matcher.compute(*mirrored)[:, ::-1][:, here].astype(np.float32) / 16
    columns = np.rint(np.arange(left.shape[1]) - left_px).astype(int)
    inside = (columns >= 0) & (columns < left.shape[1])
    back_px = np.take_along_axis(right_px, np.clip(columns, 0, left.shape[1] - 1), axis=1)
    return left_px, inside & (np.abs(back_px - left_px) <= 1) & (left_px > first_px)


def _shrink(image: UInt8[np.ndarray, "h w 3"], factor: float) -> UInt8[np.ndarray, "h2 w2 3"]:
    size = round(image.shape[1] * factor), max(round(image.shape[0] * factor), 1)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
