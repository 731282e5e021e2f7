"""Two photographs that differ in exposure or colour are brought to one look.

What shows the same place in both says which level of one corresponds to which level of the other, channel by
channel. Where the photographs agree up to noise, there is nothing to bring together.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Shaped, UInt8

from stereoweave.stereo import Estimate

# Both photographs are shrunk to about so many pixels: enough for a curve, and their noise averages out.
_PIXELS = 20_000
_LEAST_CONFIDENCE = 0.5
# A match may be a little off where its neighbours, in the shrunk photographs, differ by no more than this.
_CALM_PX = 1.0
_CALM_LEVELS = 32
# A level this near to 0 or 255 may stand for darker or brighter ones that were cut off.
_END_LEVELS = 4
# So many pixels that agree are added to those seen at an end: black stays black, and white white, unless the
# photographs say otherwise.
_END_PRIOR = 3
# Wrong matches are those that miss what is usual among equal levels, in such bins, by more than so many times
# the median, and so many levels.
_BIN_LEVELS = 16
_OUTLIER_MEDIANS, _OUTLIER_LEVELS = 6, 8
_KNOT_LEVELS = 5
# The price of bending, beside that of missing the pixels. The errors are alike from 0.03 to 1.
_STIFFNESS = 0.1
# So little that it decides only what pixels and smoothness leave open.
_PULL_TO_AGREEMENT = 1e-7
# From the first to the second the correction sets in, by the mean difference and by the number of matches: a
# film that hovers about there must not flicker.
_DIFFERENCE_LEVELS = 0.5, 1.5
_MATCHES = 50, 200

_WINDOW = np.ones((3, 3), np.uint8)
_WHITE = (255, 255, 255)
_ENDS = np.full(256, 255, np.uint8)
_ENDS[_END_LEVELS : 256 - _END_LEVELS] = 0
_IDENTITY = np.repeat(np.arange(256, dtype=np.float32)[:, None], 3, axis=1)
# Means of two levels go in halves.
_MEANS = np.arange(511) / 2
_KNOTS = np.arange(0, 256, _KNOT_LEVELS)
_HATS = np.maximum(1 - np.abs(_MEANS[:, None] - _KNOTS) / _KNOT_LEVELS, 0)
_BENDS = np.diff(np.eye(len(_KNOTS)), 2, axis=0)
_PRICES = _STIFFNESS * _BENDS.T @ _BENDS + _PULL_TO_AGREEMENT * np.eye(len(_KNOTS))


class _Channel(NamedTuple):
    """One channel of N matched places: what each photograph shows there, as a mean over a small window.

    Attributes:
        left, right: uint8 [N].
        cut_off: bool [N], whether a level in either window is so near to 0 or 255 that it may be cut off.
    """

    left: UInt8[np.ndarray, " n"]
    right: UInt8[np.ndarray, " n"]
    cut_off: Bool[np.ndarray, " n"]

    def swapped(self) -> "_Channel":
        """The same with the sides exchanged."""
        return _Channel(self.right, self.left, self.cut_off)


@dataclass(frozen=True, kw_only=True)
class Looks:
    """How the levels of two photographs of one scene correspond, channel by channel.

    Attributes:
        right_of_left: float32 [256, 3], 0..255 and never falling: the right photograph's level for each level
            of the left one.
        left_of_right: The same the other way round.
    """

    right_of_left: Float32[np.ndarray, "256 3"]
    left_of_right: Float32[np.ndarray, "256 3"]

    def tables(self, position: float) -> tuple[Float32[np.ndarray, "256 3"], Float32[np.ndarray, "256 3"]]:
        """What becomes of each level of the left and of the right photograph for one look, [256, 3] each.

        Args:
            position: At 0 the look is the left photograph's, whose table then changes nothing; at 1 it is the
                right one's. In between it changes in a straight line; beyond, it stays the nearer one's.
        """
        share = np.float32(np.clip(position, 0, 1))
        return (
            (1 - share) * _IDENTITY + share * self.right_of_left,
            (1 - share) * self.left_of_right + share * _IDENTITY,
        )


def recoloured(
    photo: UInt8[np.ndarray, "h w 3"], table: Float32[np.ndarray, "256 3"]
) -> UInt8[np.ndarray, "h w 3"]:
    """The photograph with each level replaced by the table's for it, rounded; the table is within 0..255."""
    return cv2.LUT(photo, np.rint(table).astype(np.uint8)[None])


def match_exposure(
    left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"], estimate: Estimate
) -> Looks | None:
    """How the looks of two photographs correspond; None where they agree, or too little of them is matched.

    Smooth curves make the histograms of reliably matched pixels equal: small errors of disparity mix up
    neighbouring pixels, and leave histograms as they are. The correction fades to none as the mean difference
    falls to what noise and lenses make of equal looks.

    Args:
        left: The left photograph, uint8 RGB [H, W, 3].
        right: The right one, of the same size.
        estimate: Of these two photographs.
    """
    channels = _matched_channels(left, right, estimate)
    differences = [_difference(channel) for channel in channels]
    largest = max(_mean_size(*both) for both in zip(differences, channels, strict=True))
    strength = _ramp(largest, *_DIFFERENCE_LEVELS)
    if strength == 0:
        return None
    return Looks(
        right_of_left=_tables([strength * values for values in differences], channels, strength),
        left_of_right=_tables(
            [-strength * values for values in differences],
            [channel.swapped() for channel in channels],
            strength,
        ),
    )


def _matched_channels(
    left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"], estimate: Estimate
) -> list[_Channel]:
    """The three channels of the places that both photographs show for sure."""
    step = max(round((left.shape[0] * left.shape[1] / _PIXELS) ** 0.5), 1)
    disparity_px = _sampled(estimate.disparity_px, step) / step
    rows, columns = np.indices(disparity_px.shape, np.float32)
    columns -= disparity_px

    def of_both(left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return left, cv2.remap(right, columns, rows, cv2.INTER_LINEAR)

    photos = of_both(_shrunk(left, step), _shrunk(right, step))
    certain = _sampled(estimate.confidence, step) >= _LEAST_CONFIDENCE
    # A sky that is cut off to white is plain, and of no confidence; but nor is a match needed that is exact.
    certain |= cv2.inRange(cv2.max(*photos), _WHITE, _WHITE) > 0
    certain &= ~_sampled(estimate.occluded, step)
    certain &= (columns >= 0) & (columns <= columns.shape[1] - 1)
    certain = cv2.erode(certain.astype(np.uint8), _WINDOW) > 0
    certain &= _range(disparity_px) <= _CALM_PX
    for photo in photos:
        certain &= _range(cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY)) <= _CALM_LEVELS
    ends = of_both(*(cv2.LUT(_sampled(photo, step), _ENDS) for photo in (left, right)))
    cut_off = cv2.dilate(cv2.max(*ends), _WINDOW) > 0
    values = [image[certain].T.copy() for image in (*(cv2.blur(photo, (3, 3)) for photo in photos), cut_off)]
    return [_Channel(*channel) for channel in zip(*values, strict=True)]


def _shrunk(values: Shaped[np.ndarray, "h w *c"], step: int) -> Shaped[np.ndarray, "h2 w2 *c"]:
    """Means over squares of `step` pixels; what is left over at the right and at the bottom is left out."""
    height, width = (side // step for side in values.shape[:2])
    whole = values[: height * step, : width * step]
    return cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)


def _sampled(values: Shaped[np.ndarray, "h w *c"], step: int) -> Shaped[np.ndarray, "h2 w2 *c"]:
    """The values in the middle of these squares."""
    height, width = (side // step for side in values.shape[:2])
    return np.ascontiguousarray(values[step // 2 :: step, step // 2 :: step][:height, :width])


def _range(values: Shaped[np.ndarray, "h w"]) -> Shaped[np.ndarray, "h w"]:
    """The largest less the smallest value around each pixel."""
    return cv2.morphologyEx(values, cv2.MORPH_GRADIENT, _WINDOW)


def _difference(channel: _Channel) -> Float[np.ndarray, " 511"]:
    """The right level less the left one, by the mean of the two in halves: so both sides count alike.

    Of too few places, it fades to none.
    """
    kept = ~channel.cut_off
    known = _ramp(int(kept.sum()), *_MATCHES)
    if known == 0:
        return np.zeros(len(_MEANS))
    left, right = channel.left[kept], channel.right[kept]
    missed = _missed(left, right)
    kept = missed <= max(_OUTLIER_MEDIANS * float(np.median(missed)), _OUTLIER_LEVELS)
    return known * _fitted(left[kept], right[kept])


def _missed(left: UInt8[np.ndarray, " n"], right: UInt8[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """How far each difference of levels is from the median of those with nearly the same left level."""
    differences = right.astype(int) - left
    bins = left // _BIN_LEVELS
    medians = [
        np.median(differences[bins == one]) if (bins == one).any() else 0 for one in range(bins.max() + 1)
    ]
    return np.abs(differences - np.asarray(medians)[bins])


def _fitted(left: UInt8[np.ndarray, " n"], right: UInt8[np.ndarray, " n"]) -> Float[np.ndarray, " 511"]:
    """The difference as a smooth curve, of levels at N >= 1 places.

    The darkest left one corresponds to the darkest right one, and so on. Near these points goes a curve that
    is straight between knots, and whose bends have their price (Eilers and Marx 1996, P-splines); where no
    point is, it goes on straight. Neither level leaves 0..255.
    """
    # Stable, because NumPy then sorts bytes 40 times as fast, by counting them.
    left, right = (np.sort(side, kind="stable").astype(int) for side in (left, right))
    weights = np.bincount(left + right, minlength=511) / len(left)
    sums = np.bincount(left + right, right - left, minlength=511) / len(left)
    # Sums and OpenCV's solver, because the threads of NumPy's library go on waiting busily after a matrix
    # product, on a core that the renderer needs.
    weighted = weights[:, None] * _HATS
    beside = np.diag((weighted[:, 1:] * _HATS[:, :-1]).sum(0), 1)
    normal = np.diag((weighted * _HATS).sum(0)) + beside + beside.T + _PRICES
    right_side = (sums[:, None] * _HATS).sum(0)[:, None]
    _, at_knots = cv2.solve(normal, right_side, flags=cv2.DECOMP_CHOLESKY)
    largest = 2 * np.minimum(_MEANS, 255 - _MEANS)
    return np.clip(np.interp(_MEANS, _KNOTS, at_knots[:, 0]), -largest, largest)


def _mean_size(difference: Float[np.ndarray, " 511"], channel: _Channel) -> float:
    """Mean absolute difference over the matched places; 0 of none."""
    means = channel.left.astype(int) + channel.right
    return float(np.abs(difference[means]).sum()) / max(len(means), 1)


def _tables(
    differences: list[Float[np.ndarray, " 511"]], channels: list[_Channel], strength: float
) -> Float32[np.ndarray, "256 3"]:
    """The right photograph's level for each of the left one's, of the three channels."""
    tables = [
        _with_ends(_table(difference), channel, strength)
        for difference, channel in zip(differences, channels, strict=True)
    ]
    return np.stack(tables, axis=1).astype(np.float32)


def _table(difference: Float[np.ndarray, " 511"]) -> Float[np.ndarray, " 256"]:
    """The right level for each left one, of a curve of their difference by their mean."""
    left, right = (np.maximum.accumulate(_MEANS + sign * difference / 2) for sign in (-1, 1))
    return np.interp(np.arange(256), left, right)


def _with_ends(
    table: Float[np.ndarray, " 256"], channel: _Channel, strength: float
) -> Float[np.ndarray, " 256"]:
    """The table with new ends: what was cut off becomes the mean of what the other photograph shows of it.

    The curve cannot tell, because many levels of one correspond to one of the other there. From the last
    level that surely was not cut off, the table goes straight to its end.
    """
    differences = channel.right.astype(int) - channel.left

    def shown(end: int) -> float:
        seen = differences[np.abs(channel.left.astype(int) - end) <= _END_LEVELS]
        return end + strength * float(seen.sum()) / (len(seen) + _END_PRIOR)

    sure = np.arange(_END_LEVELS, 256 - _END_LEVELS)
    black = np.clip(shown(0), 0, table[sure[0]])
    white = np.clip(shown(255), table[sure[-1]], 255)
    return np.interp(np.arange(256), [0, *sure, 255], [black, *table[sure], white])


def _ramp(value: float, low: float, high: float) -> float:
    """0 up to low, 1 from high on, and a straight line in between."""
    return float(np.clip((value - low) / (high - low), 0, 1))
