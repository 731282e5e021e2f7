"""Equalisation of exposure and colour between the two images of a pair.

The correspondence between the levels of the two images is fitted to matched pixels, channel by channel.
Images that differ only by noise are left unchanged.
"""

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
_IDENTITY = np.repeat(np.arange(256, dtype=np.float32)[:, None], 3, axis=1)
# The mean of two levels is a multiple of 1/2.
_MEANS = np.arange(511) / 2
_KNOTS = np.arange(0, 256, _KNOT_LEVELS)
_HATS = np.maximum(1 - np.abs(_MEANS[:, None] - _KNOTS) / _KNOT_LEVELS, 0)
_BENDS = np.diff(np.eye(len(_KNOTS)), 2, axis=0)
_PRICES = _STIFFNESS * _BENDS.T @ _BENDS + _PULL_TO_AGREEMENT * np.eye(len(_KNOTS))


class _Channel(NamedTuple):
    """One channel of N matched pixels.

    Attributes:
        left, right: uint8 [N], mean level over a small window.
        cut_off: bool [N], whether a level in either image's window may be clipped.
    """

    left: UInt8[np.ndarray, " n"]
    right: UInt8[np.ndarray, " n"]
    cut_off: Bool[np.ndarray, " n"]

    def swap(self) -> "_Channel":
        """Return a copy with left and right swapped."""
        return _Channel(self.right, self.left, self.cut_off)


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
    channels = _collect_channels(left, right, estimate)
    differences = [_difference(channel) for channel in channels]
    largest = max(_mean_size(*both) for both in zip(differences, channels, strict=True))
    strength = _ramp(largest, *_DIFFERENCE_LEVELS)
    if strength == 0:
        return None
    return Looks(
        right_of_left=_tables([strength * values for values in differences], channels, strength),
        left_of_right=_tables(
            [-strength * values for values in differences],
            [channel.swap() for channel in channels],
            strength,
        ),
    )


def _collect_channels(
    left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"], estimate: Estimate
) -> list[_Channel]:
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
    certain &= ~_subsample(estimate.occluded, step)
    certain &= (columns >= 0) & (columns <= columns.shape[1] - 1)
    certain = cv2.erode(certain.astype(np.uint8), _WINDOW) > 0
    certain &= _range(disparity_px) <= _CALM_PX
    for image in images:
        certain &= _range(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)) <= _CALM_LEVELS
    ends = of_both(*(cv2.LUT(_subsample(image, step), _ENDS) for image in (left, right)))
    cut_off = cv2.dilate(cv2.max(*ends), _WINDOW) > 0
    values = [
        levels[certain].T.copy() for levels in (*(cv2.blur(image, (3, 3)) for image in images), cut_off)
    ]
    return [_Channel(*channel) for channel in zip(*values, strict=True)]


def _downsample(values: Shaped[np.ndarray, "h w *c"], step: int) -> Shaped[np.ndarray, "h2 w2 *c"]:
    """Average over squares of `step` x `step` pixels, cropping the remainder at the right and bottom."""
    height, width = (side // step for side in values.shape[:2])
    whole = values[: height * step, : width * step]
    return cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)


def _subsample(values: Shaped[np.ndarray, "h w *c"], step: int) -> Shaped[np.ndarray, "h2 w2 *c"]:
    """Return the values at the centres of the squares of `step` x `step` pixels."""
    height, width = (side // step for side in values.shape[:2])
    return np.ascontiguousarray(values[step // 2 :: step, step // 2 :: step][:height, :width])


def _range(values: Shaped[np.ndarray, "h w"]) -> Shaped[np.ndarray, "h w"]:
    """Return the maximum minus the minimum in the window around each pixel."""
    return cv2.morphologyEx(values, cv2.MORPH_GRADIENT, _WINDOW)


def _difference(channel: _Channel) -> Float[np.ndarray, " 511"]:
    """Return the right level minus the left level as a function of their mean.

    Using the mean treats both images alike. The difference fades to 0 if there are too few pixels.
    """
    kept = ~channel.cut_off
    known = _ramp(int(kept.sum()), *_MATCHES)
    if known == 0:
        return np.zeros(len(_MEANS))
    left, right = channel.left[kept], channel.right[kept]
    deviations = _measure_deviation(left, right)
    kept = deviations <= max(_OUTLIER_MEDIANS * float(np.median(deviations)), _OUTLIER_LEVELS)
    return known * _fit_curve(left[kept], right[kept])


def _measure_deviation(
    left: UInt8[np.ndarray, " n"], right: UInt8[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Return the deviation of each level difference from the median difference in its bin of left levels."""
    differences = right.astype(int) - left
    bins = left // _BIN_LEVELS
    counts = np.bincount(511 * bins.astype(int) + differences + 255, minlength=511 * (int(bins.max()) + 1))
    return np.abs(differences - _find_medians(counts.reshape(-1, 511))[bins])


def _find_medians(counts: Int[np.ndarray, "bins 511"]) -> Float[np.ndarray, " bins"]:
    """Return each bin's median of the differences -255..255, given their counts; arbitrary if it is empty."""
    below = counts.cumsum(axis=1)
    total = below[:, -1:]
    # Of an even number, the mean of the two in the middle.
    middle = [(below >= rank).argmax(axis=1) for rank in ((total + 1) // 2, total // 2 + 1)]
    return (middle[0] + middle[1]) / 2 - 255


def _fit_curve(left: UInt8[np.ndarray, " n"], right: UInt8[np.ndarray, " n"]) -> Float[np.ndarray, " 511"]:
    """Fit a smooth curve over the mean level to the level differences of N >= 1 pixels.

    The n-th smallest left level corresponds to the n-th smallest right level, as in histogram matching. The
    curve is linear between knots with a penalty on bends (Eilers and Marx 1996, P-splines) and extrapolates
    linearly. It keeps both levels in 0..255.
    """
    # NumPy's stable sort of bytes is a counting sort, 40 times as fast as its default sort.
    left, right = (np.sort(side, kind="stable").astype(int) for side in (left, right))
    weights = np.bincount(left + right, minlength=511) / len(left)
    sums = np.bincount(left + right, right - left, minlength=511) / len(left)
    # Uses no NumPy matrix product or solver, because their BLAS threads would keep spinning afterwards, on
    # cores that the renderer needs.
    weighted = weights[:, None] * _HATS
    beside = np.diag((weighted[:, 1:] * _HATS[:, :-1]).sum(0), 1)
    normal = np.diag((weighted * _HATS).sum(0)) + beside + beside.T + _PRICES
    right_side = (sums[:, None] * _HATS).sum(0)[:, None]
    _, at_knots = cv2.solve(normal, right_side, flags=cv2.DECOMP_CHOLESKY)
    largest = 2 * np.minimum(_MEANS, 255 - _MEANS)
    return np.clip(np.interp(_MEANS, _KNOTS, at_knots[:, 0]), -largest, largest)


def _mean_size(difference: Float[np.ndarray, " 511"], channel: _Channel) -> float:
    """Return the mean absolute difference over the matched pixels; 0 if there are none."""
    means = channel.left.astype(int) + channel.right
    return float(np.abs(difference[means]).sum()) / max(len(means), 1)


def _tables(
    differences: list[Float[np.ndarray, " 511"]], channels: list[_Channel], strength: float
) -> Float32[np.ndarray, "256 3"]:
    """Tabulate the right level for each left level in all three channels."""
    tables = [
        _replace_ends(_table(difference), channel, strength)
        for difference, channel in zip(differences, channels, strict=True)
    ]
    return np.stack(tables, axis=1).astype(np.float32)


def _table(difference: Float[np.ndarray, " 511"]) -> Float[np.ndarray, " 256"]:
    """Tabulate the right level for each left level, given their difference as a function of their mean."""
    left, right = (np.maximum.accumulate(_MEANS + sign * difference / 2) for sign in (-1, 1))
    return np.interp(np.arange(256), left, right)


def _replace_ends(
    table: Float[np.ndarray, " 256"], channel: _Channel, strength: float
) -> Float[np.ndarray, " 256"]:
    """Replace both ends of the table so that clipped levels map to the mean level of their matches.

    The curve cannot represent clipping, where many levels of one image correspond to a single level of the
    other. The table is linear between the last level that is certainly not clipped and the end.
    """
    differences = channel.right.astype(int) - channel.left

    def find_end(end: int) -> float:
        seen = differences[np.abs(channel.left.astype(int) - end) <= _END_LEVELS]
        return end + strength * float(seen.sum()) / (len(seen) + _END_PRIOR)

    sure = np.arange(_END_LEVELS, 256 - _END_LEVELS)
    black = np.clip(find_end(0), 0, table[sure[0]])
    white = np.clip(find_end(255), table[sure[-1]], 255)
    return np.interp(np.arange(256), [0, *sure, 255], [black, *table[sure], white])


def _ramp(value: float, low: float, high: float) -> float:
    """Return 0 up to `low`, 1 from `high` on, and a linear ramp in between."""
    return float(np.clip((value - low) / (high - low), 0, 1))
