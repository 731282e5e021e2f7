"""Equalisation of exposure and colour between the two images of a pair.

The correspondence between the levels of the two images is fitted to matched pixels, channel by channel.
Images that differ only by noise are left unchanged.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Shaped, UInt8

from stereoweave.stereo import Estimate, StereoPair

# Both images are downsampled to about this many pixels, which is enough to fit a curve and to average out
# noise.
_PIXELS = 20_000
_LEAST_CONFIDENCE = 0.5
# Grey levels are compared at every this many pixels of every this many rows.
_STEP_PX = 4
# Small matching errors do not matter where neighbours in the downsampled images differ by at most this
# disparity and at most this many grey levels.
_CALM_PX = 1.0
_CALM_LEVELS = 32
# A level this close to 0 or 255 may be clipped.
_END_LEVELS = 4
# This many pixels without a difference are added at each end, so black stays black and white stays white
# unless there is evidence to the contrary.
_END_PRIOR = 3
# A match is an outlier if its level difference deviates from the median of its bin by more than this many
# median deviations and by more than this many levels.
_BIN_LEVELS = 16
_OUTLIER_MEDIANS, _OUTLIER_LEVELS = 6, 8
_KNOT_LEVELS = 5
# Weight of the smoothness term. Any value from 0.03 to 1 gives much the same errors.
_STIFFNESS = 0.1
# Small enough to affect only what the data and the smoothness term leave undetermined.
_PULL_TO_AGREEMENT = 1e-7
# The correction fades in between these mean differences and numbers of matches, so that a video near the
# threshold does not flicker.
_DIFFERENCE_LEVELS = 0.5, 1.5
_MATCHES = 50, 200

_WINDOW = np.ones((3, 3), np.uint8)
_WHITE = (255, 255, 255)
_ENDS = np.full(256, 255, np.uint8)
_ENDS[_END_LEVELS : 256 - _END_LEVELS] = 0
# The levels that are certainly not clipped, and both ends.
_SURE = np.array([0, *range(_END_LEVELS, 256 - _END_LEVELS), 255])
_IDENTITY = np.repeat(np.arange(256, dtype=np.float32)[:, None], 3, axis=1)
# The mean of two levels is a multiple of 1/2.
_MEANS = np.arange(511) / 2
_LARGEST = 2 * np.minimum(_MEANS, 255 - _MEANS)
_KNOTS = np.arange(0, 256, _KNOT_LEVELS)
# Shares of the knot below and of the knot above, for each mean from one knot to the next.
_ABOVE = np.arange(0, 1, 0.5 / _KNOT_LEVELS)
_BELOW = 1 - _ABOVE
_BENDS = np.diff(np.eye(len(_KNOTS)), 2, axis=0)
_PRICES = _STIFFNESS * _BENDS.T @ _BENDS + _PULL_TO_AGREEMENT * np.eye(len(_KNOTS))
# First level of each channel where all levels of all channels are counted in one array.
_CHANNELS = 256 * np.arange(3, dtype=np.int16)[:, None]


class _Matches(NamedTuple):
    """The three channels of N matched pixels.

    Attributes:
        left, right: uint8 [3, N], mean level over a small window.
        cut_off: bool [3, N], whether a level in either image's window may be clipped.
    """

    left: UInt8[np.ndarray, "3 n"]
    right: UInt8[np.ndarray, "3 n"]
    cut_off: Bool[np.ndarray, "3 n"]

    def swap(self) -> "_Matches":
        """Return a copy with left and right swapped."""
        return _Matches(self.right, self.left, self.cut_off)


@dataclass(frozen=True, kw_only=True)
class Looks:
    """Correspondence between the levels of two images of the same scene, channel by channel.

    Attributes:
        right_of_left: Right image's level for each level of the left image; float32 [256, 3] in 0..255,
            non-decreasing.
        left_of_right: Left image's level for each level of the right image, in the same form.
    """

    right_of_left: Float32[np.ndarray, "256 3"]
    left_of_right: Float32[np.ndarray, "256 3"]

    def tables(self, position: float) -> tuple[Float32[np.ndarray, "256 3"], Float32[np.ndarray, "256 3"]]:
        """Return lookup tables [256, 3] that give the left and the right image the same exposure and colour.

        Args:
            position: 0 for the look of the left image, whose table is then the identity, and 1 for the look
                of the right image. Values in between interpolate linearly; values outside 0..1 are clamped.
        """
        share = np.float32(np.clip(position, 0, 1))
        return (
            (1 - share) * _IDENTITY + share * self.right_of_left,
            (1 - share) * self.left_of_right + share * _IDENTITY,
        )


def recolour(
    image: UInt8[np.ndarray, "h w 3"], table: Float32[np.ndarray, "256 3"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Apply a lookup table with values in 0..255 to each channel, and round the result."""
    return cv2.LUT(image, np.rint(table).astype(np.uint8)[None])


def equalise_right(pair: StereoPair, estimate: Estimate) -> UInt8[np.ndarray, "h w 3"]:
    """Return the right image with the exposure and the colours of the left one."""
    looks = match_exposure(pair.left, pair.right, estimate)
    return recolour(pair.right, looks.tables(0)[1]) if looks else pair.right


def equalise_grey(
    pair: StereoPair, estimate: Estimate
) -> tuple[UInt8[np.ndarray, "h w"], UInt8[np.ndarray, "h w"]]:
    """Return both grey images, the right one with the left one's mean and contrast.

    This takes an eighth of the time of `equalise_right`.
    """
    left, right = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (pair.left, pair.right))
    gain, offset = fit_grey(left, right, estimate)
    table = np.clip(gain * np.arange(256) + offset, 0, 255)
    return left, cv2.LUT(right, np.rint(table).astype(np.uint8))


def fit_grey(
    left: UInt8[np.ndarray, "h w"], right: UInt8[np.ndarray, "h w"], estimate: Estimate
) -> tuple[float, float]:
    """Return the gain and the offset that give the right grey levels the left ones' contrast and mean.

    They are measured on a sample of the visible pixels; 1 and 0 if there are none.
    """
    some = np.s_[::_STEP_PX, ::_STEP_PX]
    visible = ~estimate.occluded[some]
    if not visible.any():
        return 1.0, 0.0
    columns = np.arange(0, left.shape[1], _STEP_PX, dtype=np.float32)
    matches = np.rint(columns - estimate.disparity_px[some]).clip(0, left.shape[1] - 1)
    seen = left[some], np.take_along_axis(right[::_STEP_PX], matches.astype(np.intp), 1)
    (mean, deviation), (right_mean, right_deviation) = (
        map(np.ndarray.item, cv2.meanStdDev(values, mask=visible.view(np.uint8))) for values in seen
    )
    # At least 1, for images without contrast.
    gain = max(deviation, 1.0) / max(right_deviation, 1.0)
    return gain, mean - gain * right_mean


def match_exposure(
    left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"], estimate: Estimate
) -> Looks | None:
    """Fit the level correspondence; return None if the images agree or too few pixels match.

    Smooth curves equalise the histograms of reliably matched pixels, because small disparity errors swap
    neighbouring pixels but hardly change histograms. The correction fades out as the mean difference
    approaches what noise and lenses alone would cause.

    Args:
        left: Left image, uint8 RGB [H, W, 3].
        right: Right image of the same size.
        estimate: The pair's estimate.
    """
    matches = _collect_matches(left, right, estimate)
    differences = _fit_differences(matches)
    strength = float(_ramp(_mean_sizes(differences, matches), *_DIFFERENCE_LEVELS).max())
    if strength == 0:
        return None
    return Looks(
        right_of_left=_tables(strength * differences, matches, strength),
        left_of_right=_tables(-strength * differences, matches.swap(), strength),
    )


def _collect_matches(
    left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"], estimate: Estimate
) -> _Matches:
    """Return the three channels of the reliably matched pixels."""
    step = max(round((left.shape[0] * left.shape[1] / _PIXELS) ** 0.5), 1)
    disparity_px = _subsample(estimate.disparity_px, step) / step
    rows, columns = np.indices(disparity_px.shape, np.float32)
    columns -= disparity_px

    def of_both(left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return left, cv2.remap(right, columns, rows, cv2.INTER_LINEAR)

    images = of_both(_downsample(left, step), _downsample(right, step))
    certain = _subsample(estimate.confidence, step) >= _LEAST_CONFIDENCE
    # A clipped white sky is plain and has confidence 0, but it needs no exact match.
    certain |= cv2.inRange(cv2.max(*images), _WHITE, _WHITE) > 0
    certain &= _subsample(estimate.occluded.view(np.uint8), step) == 0
    certain &= (columns >= 0) & (columns <= columns.shape[1] - 1)
    certain = cv2.erode(certain.astype(np.uint8), _WINDOW) > 0
    certain &= _range(disparity_px) <= _CALM_PX
    for image in images:
        certain &= _range(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)) <= _CALM_LEVELS
    ends = of_both(*(cv2.LUT(_subsample(image, step), _ENDS) for image in (left, right)))
    cut_off = cv2.dilate(cv2.max(*ends), _WINDOW)
    pixels = np.flatnonzero(certain)

    def pick(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "3 n"]:
        return np.ascontiguousarray(image.reshape(-1, 3).take(pixels, axis=0).T)

    left, right = (pick(cv2.blur(image, (3, 3))) for image in images)
    return _Matches(left, right, pick(cut_off) > 0)


def _downsample(values: Shaped[np.ndarray, "h w *c"], step: int) -> Shaped[np.ndarray, "h2 w2 *c"]:
    """Average over squares of `step` x `step` pixels, cropping the remainder at the right and bottom."""
    if step == 3:  # Gives the same in less than half the time.
        return _subsample(cv2.blur(values, (3, 3)), step)
    return _resize(values, step, cv2.INTER_AREA)


def _subsample(values: Shaped[np.ndarray, "h w *c"], step: int) -> Shaped[np.ndarray, "h2 w2 *c"]:
    """Return the values at the centres of the squares of `step` x `step` pixels."""
    return _resize(values, step, cv2.INTER_NEAREST_EXACT)


def _resize(values: Shaped[np.ndarray, "h w *c"], step: int, way: int) -> Shaped[np.ndarray, "h2 w2 *c"]:
    height, width = (side // step for side in values.shape[:2])
    return cv2.resize(values[: height * step, : width * step], (width, height), interpolation=way)


def _range(values: Shaped[np.ndarray, "h w"]) -> Shaped[np.ndarray, "h w"]:
    """Return the maximum minus the minimum in the window around each pixel."""
    return cv2.morphologyEx(values, cv2.MORPH_GRADIENT, _WINDOW)


def _fit_differences(matches: _Matches) -> Float[np.ndarray, "3 511"]:
    """Return the right level minus the left level as a function of their mean, channel by channel.

    Using the mean treats both images alike. The difference fades to 0 if there are too few pixels.
    """
    kept = ~matches.cut_off
    known = _ramp(kept.sum(1), *_MATCHES)
    left, right = ((side + _CHANNELS)[kept] for side in (matches.left, matches.right))
    near = _find_inliers(left, right)
    return known[:, None] * _fit_curves(left[near], right[near])


def _find_inliers(left: Int[np.ndarray, " n"], right: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Return the mask of matches whose difference is close to the median in their bin of left levels."""
    bins, channels = left // _BIN_LEVELS, left // 256
    differences = right - left
    medians = _find_medians(511 * bins + differences + 255, 3 * 256 // _BIN_LEVELS, 511) - 255
    # Twice the values, because these are integers.
    deviations = np.abs(2 * differences - (2 * medians).astype(np.int32).take(bins))
    limits = _OUTLIER_MEDIANS * _find_medians(1021 * channels + deviations, 3, 1021)
    return deviations <= np.maximum(limits, 2 * _OUTLIER_LEVELS).astype(np.int16).take(channels)


def _find_medians(
    values: Int[np.ndarray, " n"], group_count: int, value_count: int
) -> Float[np.ndarray, " groups"]:
    """Return the median of each group of integers in 0..value_count - 1; arbitrary if a group is empty.

    Args:
        values: The integers, plus value_count times the number of their group.
        group_count: Number of groups.
        value_count: Number of possible integers.
    """
    below = np.bincount(values, minlength=group_count * value_count).cumsum()
    last = below[value_count - 1 :: value_count]
    total = np.diff(last, prepend=0)
    # Of an even number, the mean of the two in the middle.
    ranks = last - total + np.stack([(total + 1) // 2, total // 2 + 1])
    return below.searchsorted(ranks).mean(0) - value_count * np.arange(group_count)


def _fit_curves(left: Int[np.ndarray, " n"], right: Int[np.ndarray, " n"]) -> Float[np.ndarray, "3 511"]:
    """Fit smooth curves over the mean level to the level differences of N pixels, 0 if a channel has none.

    The n-th smallest left level corresponds to the n-th smallest right level, as in histogram matching. The
    curves are linear between knots with a penalty on bends (Eilers and Marx 1996, P-splines) and extrapolate
    linearly. They keep both levels in 0..255.
    """
    weights, sums = _match_histograms(left, right)
    own = _sum_at_knots(weights, _BELOW**2, _ABOVE**2)
    beside = (weights * _BELOW * _ABOVE).sum(2)
    right_sides = _sum_at_knots(sums, _BELOW, _ABOVE)
    curves = [
        np.interp(_MEANS, _KNOTS, _solve(*channel)) for channel in zip(own, beside, right_sides, strict=True)
    ]
    return np.clip(curves, -_LARGEST, _LARGEST)


def _match_histograms(
    left: Int[np.ndarray, " n"], right: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "3 k m"], Float[np.ndarray, "3 k m"]]:
    """Return the share of pixels and the sum of their level differences for each mean of matched levels.

    The means are in rows that start at a knot.
    """
    left_below, right_below = (np.bincount(side, minlength=3 * 256).cumsum() for side in (left, right))
    # From one of these ranks to the next, neither image's level changes.
    ranks = np.sort(np.concatenate([left_below, right_below]))
    left, right = left_below.searchsorted(ranks), right_below.searchsorted(ranks)
    pixels = np.diff(ranks, prepend=0)
    shape = 3, len(_KNOTS), len(_ABOVE)
    means = left + right + left // 256 * (shape[1] * shape[2] - 2 * 256)
    weights, sums = (
        np.bincount(means, values, minlength=math.prod(shape)).reshape(shape)
        for values in (pixels, pixels * (right - left))
    )
    counts = np.maximum(weights.sum((1, 2), keepdims=True), 1)
    return weights / counts, sums / counts


def _sum_at_knots(
    values: Float[np.ndarray, "3 k m"], below: Float[np.ndarray, " m"], above: Float[np.ndarray, " m"]
) -> Float[np.ndarray, "3 k"]:
    """Return the sum of the values on both sides of each knot, multiplied by their shares of it."""
    sums = (values * below).sum(2)
    sums[:, 1:] += (values * above).sum(2)[:, :-1]
    return sums


def _solve(
    own: Float[np.ndarray, " k"], beside: Float[np.ndarray, " k"], right_side: Float[np.ndarray, " k"]
) -> Float[np.ndarray, " k"]:
    """Return the curve at its knots from the normal equations of its fit.

    Uses no NumPy solver, because its BLAS threads would keep spinning afterwards, on cores that the renderer
    needs.
    """
    next_to = np.diag(beside[:-1], 1)
    normal = np.diag(own) + next_to + next_to.T + _PRICES
    return cv2.solve(normal, right_side[:, None], flags=cv2.DECOMP_CHOLESKY)[1][:, 0]


def _mean_sizes(differences: Float[np.ndarray, "3 511"], matches: _Matches) -> Float[np.ndarray, " 3"]:
    """Return the mean absolute differences over the matched pixels; 0 if there are none."""
    means = matches.left.astype(np.intp) + matches.right
    sums = [
        float(np.abs(values)[of_channel].sum()) for values, of_channel in zip(differences, means, strict=True)
    ]
    return np.array(sums) / max(means.shape[1], 1)


def _tables(
    differences: Float[np.ndarray, "3 511"], matches: _Matches, strength: float
) -> Float32[np.ndarray, "256 3"]:
    """Tabulate the right level for each left level in all three channels."""
    left = (matches.left + _CHANNELS).ravel()
    counts = np.bincount(left, minlength=3 * 256).reshape(3, 256)
    sums = np.bincount(left, (matches.right + _CHANNELS).ravel() - left, minlength=3 * 256).reshape(3, 256)
    tables = [
        _replace_ends(_table(difference), strength * seen, count)
        for difference, seen, count in zip(differences, sums, counts, strict=True)
    ]
    return np.stack(tables, axis=1).astype(np.float32)


def _table(difference: Float[np.ndarray, " 511"]) -> Float[np.ndarray, " 256"]:
    """Tabulate the right level for each left level, given their difference as a function of their mean."""
    left, right = (np.maximum.accumulate(_MEANS + sign * difference / 2) for sign in (-1, 1))
    return np.interp(np.arange(256), left, right)


def _replace_ends(
    table: Float[np.ndarray, " 256"], sums: Float[np.ndarray, " 256"], counts: Int[np.ndarray, " 256"]
) -> Float[np.ndarray, " 256"]:
    """Replace both ends of the table so that clipped levels map to the mean level of their matches.

    The curve cannot represent clipping, where many levels of one image correspond to a single level of the
    other. The table is linear between the last level that is certainly not clipped and the end.

    Args:
        table: The right level for each left level.
        sums: Sum of the level differences of the pixels of each left level.
        counts: Number of these pixels.
    """

    def find_shift(end: slice) -> float:
        return float(sums[end].sum()) / (int(counts[end].sum()) + _END_PRIOR)

    sure = table[_SURE]
    sure[0] = np.clip(find_shift(np.s_[: _END_LEVELS + 1]), 0, sure[1])
    sure[-1] = np.clip(255 + find_shift(np.s_[-_END_LEVELS - 1 :]), sure[-2], 255)
    return np.interp(np.arange(256), _SURE, sure)


def _ramp(values: Shaped[np.ndarray, " n"], low: float, high: float) -> Float[np.ndarray, " n"]:
    """Return 0 for values up to `low`, 1 from `high` on, and a linear ramp in between."""
    return np.clip((values - low) / (high - low), 0, 1)
