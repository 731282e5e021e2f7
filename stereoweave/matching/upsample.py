"""Upsampling of a downscaled pair's estimate to full size, with edges aligned to the full-size images.

Each level is at most twice as large as the previous level, whose disparities serve as the prior. Semi-global
matching (Hirschmueller 2008), with candidates only near the prior's surfaces (as in Rothermel et al. 2012),
locates the surfaces' edges and refines their disparity to a fraction of a pixel. Images are processed in
strips of rows. The state of the vertical paths is passed from strip to strip, so the result does not depend
on the strips' height.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int16, Shaped, UInt8, UInt16, UInt32

from stereoweave.matching.left_right_check import find_occluded
from stereoweave.matching.step_penalties import penalise_large_steps
from stereoweave.stereo import Estimate
from stereoweave.system.steps import step
from stereoweave.system.threads import in_bands, thread_count

# Memory limit for the cost volumes of a strip.
_STRIP_BYTES = 150_000_000
_LEAST_ROWS = 32
_CENSUS_PX = 2
# A pixel may belong to any surface within a window of this size in the smaller images.
_SURFACES_PX = 5
# There is an edge where these surfaces differ by this much, in pixels of the smaller images.
_EDGE_PX = 1.5
# Cost per px of a candidate's distance to its surface. Only distances from _FREE_PX to _FARTHEST_PX count,
# because disparities of the smaller images are accurate to about half a pixel of those images.
_PULL, _FREE_PX, _FARTHEST_PX = 2, 1, 8
# A prior that is off by at most this is corrected by the mean difference in a window of this size.
_FOLLOWED_PX = 2.0
_MEAN_PX = 9
_LEAST_SHARE, _LEAST_SHARE_AROUND = 0.3, 0.02
_SETTLED_ROWS = 256
# Factor on the prior's confidence, and upper limit of the result. On collages, disparities that follow the
# prior are right as often as its confidence claims, disparities on which the views disagree are right 85 % as
# often, and changed disparities are right half the time.
_FOLLOWS, _UNSEEN, _CHANGED = 0, 1, 2
_LEFT_OF_CONFIDENCE = np.array([1, 0.85, 1], np.float32)
_MOST_CONFIDENCE = np.array([1, 1, 0.5], np.float32)


class _StripCues(NamedTuple):
    """Inputs to a strip's matching cost: census codes, uint32 [H, W], and grey levels, uint8 [H, W]."""

    codes: UInt32[np.ndarray, "h w"]
    levels: UInt8[np.ndarray, "h w"]


class _Paths(NamedTuple):
    """State of the vertical paths after a row, for `upsample_kernels.along_columns`."""

    costs: UInt16[np.ndarray, "w path"]
    least: UInt16[np.ndarray, " w"]
    first: Int16[np.ndarray, "w 2"]


class _StripView:
    """A left view with its prior, processed in strips of rows.

    Args:
        grey: Left image.
        other: Right image.
        smaller_px: Disparities of the left view at the smaller size, in pixels of the smaller images.
    """

    def __init__(
        self,
        grey: UInt8[np.ndarray, "h w"],
        other: UInt8[np.ndarray, "h w"],
        smaller_px: Float32[np.ndarray, "h2 w2"],
    ) -> None:
        self.grey, self.other = grey, other
        self._scale = scale = np.float32(grey.shape[1] / smaller_px.shape[1])
        self._columns_px = _resize(smaller_px, (len(smaller_px), grey.shape[1])) * scale
        window = np.ones((_SURFACES_PX, _SURFACES_PX), np.uint8)
        self._surfaces_px = cv2.erode(smaller_px, window) * scale, cv2.dilate(smaller_px, window) * scale
        self.parallel = smaller_px.min() >= 0
        self._rows, self._columns = (
            _places(size, smaller) for size, smaller in zip(grey.shape, smaller_px.shape, strict=True)
        )

    def prior_px(self, rows: slice) -> Float32[np.ndarray, "h w"]:
        """Return the smaller images' disparity, interpolated at each pixel in the rows."""
        height, smaller = len(self.grey), len(self._columns_px)
        places = np.clip((np.arange(height)[rows] + 0.5) * smaller / height - 0.5, 0, smaller - 1)
        above = np.minimum(places.astype(int), smaller - 2)
        share = (places - above).astype(np.float32)[:, None]
        return (1 - share) * self._columns_px[above] + share * self._columns_px[above + 1]

    def surfaces_px(self, rows: slice) -> list[Float32[np.ndarray, "h w"]]:
        """Return the disparities of the farthest and the nearest surface around each pixel."""
        return [surface[self._rows[rows]][:, self._columns] for surface in self._surfaces_px]

    def cues(self, rows: slice, threads: int) -> tuple[_StripCues, _StripCues]:
        """Return the cues of both images for `upsample_kernels.match`."""
        from stereoweave.matching import upsample_kernels as kernels  # it loads LLVM

        with ThreadPoolExecutor(threads) as pool:
            own, other = pool.map(lambda grey: _cues(grey, rows), (self.grey, self.other))
        more = ((0, 0), (kernels.BAND, kernels.BAND))
        return own, _StripCues(*(np.pad(cue[:, ::-1], more, mode="edge") for cue in other))

    def first_candidates(self, rows: slice) -> Int16[np.ndarray, "h w 2"]:
        """Return the least disparity in each pixel's two bands of candidates."""
        from stereoweave.matching import upsample_kernels as kernels

        farthest_px, nearest_px = self.surfaces_px(rows)
        at_edge = self.at_edge(farthest_px, nearest_px)
        prior_px = self.prior_px(rows)
        bands_px = [np.where(at_edge, surface, prior_px) for surface in (farthest_px, nearest_px)]
        return np.rint(np.stack(bands_px, 2)).astype(np.int16) - np.int16(kernels.MIDDLE)

    def at_edge(
        self, farthest_px: Float32[np.ndarray, "h w"], nearest_px: Float32[np.ndarray, "h w"]
    ) -> Bool[np.ndarray, "h w"]:
        """Return the mask of pixels with more than one surface around them."""
        return nearest_px - farthest_px > _EDGE_PX * self._scale

    def steps_along(self, rows: slice) -> UInt16[np.ndarray, "h w1"]:
        """Return the penalty for a large step from the previous column to each column."""
        grey = self.grey[rows]
        return np.pad(penalise_large_steps(grey[:, 1:], grey[:, :-1]), ((0, 0), (1, 1))).astype(np.uint16)

    def steps_down(self, rows: slice) -> UInt16[np.ndarray, "h1 w"]:
        """Return the penalty for a large step before each row and after the last row."""
        grey = self.grey[max(rows.start - 1, 0) : rows.stop + 1]
        ends = rows.start == 0, rows.stop == len(self.grey)
        return np.pad(penalise_large_steps(grey[1:], grey[:-1]), (ends, (0, 0))).astype(np.uint16)


def enlarge(
    left: UInt8[np.ndarray, "h w 3"],
    right: UInt8[np.ndarray, "h w 3"],
    estimate: Estimate,
    threads: int | None = None,
) -> Estimate:
    """Upsample the estimate of a downscaled pair to full size.

    The resulting disparities are in px of the full-size images. Confidence is lowered where the full-size
    images contradict the smaller images, and occlusion is recomputed.

    Args:
        left: Left image, uint8 RGB [H, W, 3].
        right: Right image of the same size.
        estimate: Estimate of the pair after downscaling by the same factor in both directions.
        threads: Maximum number of threads; default: all cores.
    """
    height, width = left.shape[:2]
    divisors, threads = _divisors(width, estimate.disparity_px.shape[1]), thread_count(threads)
    sizes = [(round(width / divisor), round(height / divisor)) for divisor in divisors]
    # Both views are matched strip by strip, once upwards and once downwards.
    pixels = sum(2 * 2 * columns * rows for columns, rows in sizes)
    with step("upsampling", total=pixels) as advance:
        for size in sizes:
            estimate = _upsample_level(_grey(left, size), _grey(right, size), estimate, threads, advance)
    return estimate


def rehearse_upsampling() -> None:
    """Upsample a small estimate, to compile all kernels (`compiling_ahead.compile_ahead`)."""
    image, px = np.zeros((64, 64, 3), np.uint8), np.zeros((32, 32), np.float32)
    enlarge(image, image, Estimate(disparity_px=px, right_disparity_px=px, confidence=px, occluded=px > 0), 1)


def _divisors(width: int, smaller: int) -> list[int]:
    """Return the downscaling factor of each level; the last factor is 1."""
    divisor = 1
    while width / (2 * divisor) > smaller:
        divisor *= 2
    return [divisor // 2**level for level in range(divisor.bit_length())]


def _grey(image: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]) -> UInt8[np.ndarray, "h2 w2"]:
    """Convert an image to grey and resize it."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA)


def _upsample_level(
    left: UInt8[np.ndarray, "h w"],
    right: UInt8[np.ndarray, "h w"],
    smaller: Estimate,
    threads: int,
    advance: Callable[[int], None],
) -> Estimate:
    """Upsample an estimate to the size of the given grey images; `advance` is told each strip's pixels."""
    view = _StripView(left, right, smaller.disparity_px)
    right_view = _StripView(_mirror(right), _mirror(left), _mirror(smaller.right_disparity_px))
    found_px, right_found_px = (_match_view(each, threads, advance) for each in (view, right_view))
    disparity_px, doubt = _settle(view, found_px, _mirror(right_found_px), threads)
    right_disparity_px = _mirror(_settle(right_view, right_found_px, _mirror(found_px), threads)[0])
    del view, right_view, found_px, right_found_px  # as large as the result: 1 GB for 50 megapixels
    return Estimate(
        disparity_px=disparity_px,
        right_disparity_px=right_disparity_px,
        confidence=_confidence(smaller.confidence, doubt),
        occluded=find_occluded(disparity_px, right_disparity_px),
    )


def _match_view(view: _StripView, threads: int, advance: Callable[[int], None]) -> Float32[np.ndarray, "h w"]:
    """Match a left view strip by strip, and return its disparities of least cost."""
    from stereoweave.matching import upsample_kernels as kernels

    height, width = view.grey.shape
    count = 2 * kernels.BAND
    strips = _strips(height, max(_STRIP_BYTES // (3 * width * count), _LEAST_ROWS))
    # All strips share the buffers, because allocating new memory takes as long as aggregating one path.
    volumes = (np.empty((strips[0].stop, width, count), dtype) for dtype in (np.uint8, np.uint16))
    costs, sums = volumes
    found_px = np.empty((height, width), np.float32)
    from_below, paths = {}, _no_paths(width)
    for rows in reversed(strips):
        from_below[rows.start] = _Paths(*(values.copy() for values in paths))
        if rows.start > 0:
            _Strip(view, rows, costs, sums, threads).run_down(paths, backwards=1)
        advance(width * (rows.stop - rows.start))
    paths = _no_paths(width)
    for rows in strips:
        strip = _Strip(view, rows, costs, sums, threads)
        strip.run_along()
        strip.run_down(paths, backwards=0)
        strip.run_down(from_below[rows.start], backwards=1)
        strip.pick(found_px[rows])
        advance(width * (rows.stop - rows.start))
    return found_px


class _Strip:
    """A strip of rows of a left view, with buffers for its costs and their sums."""

    def __init__(
        self,
        view: _StripView,
        rows: slice,
        costs: UInt8[np.ndarray, "h w d"],
        sums: UInt16[np.ndarray, "h w d"],
        threads: int,
    ) -> None:
        from stereoweave.matching import upsample_kernels as kernels

        self._kernels, self._threads = kernels, threads
        self._first = view.first_candidates(rows)
        self._along, self._down = view.steps_along(rows), view.steps_down(rows)
        self._costs, self._sums = (volume[: len(self._first)] for volume in (costs, sums))
        own, other = (tuple(cues) for cues in view.cues(rows, threads))
        pull = _pull()
        self._in_bands(lambda *band: kernels.match(own, other, self._first, pull, band, self._costs), 0)

    def run_along(self) -> None:
        """Write the sum of the costs of both horizontal paths into the buffer of sums."""
        self._in_bands(
            lambda *band: self._kernels.along_rows(self._costs, self._first, self._along, band, self._sums), 0
        )

    def run_down(self, paths: _Paths, backwards: int) -> None:
        """Add the costs of the path from above, or from below if `backwards` is 1, and update `paths`."""
        volumes = self._costs, self._first, self._down
        self._in_bands(
            lambda *band: self._kernels.along_columns(*volumes, backwards, band, *paths, self._sums), 1
        )

    def pick(self, found_px: Float32[np.ndarray, "h w"]) -> None:
        """Write the disparities of least cost into `found_px`."""
        self._in_bands(lambda *band: self._kernels.pick(self._sums, self._first, band, found_px), 0)

    def _in_bands(self, work: Callable[[int, int], None], axis: int) -> None:
        in_bands(work, self._costs.shape[axis], self._threads, self._threads)


def _settle(
    view: _StripView,
    found_px: Float32[np.ndarray, "h w"],
    other_px: Float32[np.ndarray, "h w"],
    threads: int,
) -> tuple[Float32[np.ndarray, "h w"], UInt8[np.ndarray, "h w"]]:
    """Combine both views' disparities with the prior; return the disparity and the doubt of each pixel.

    Doubt is _FOLLOWS, _UNSEEN or _CHANGED.
    """
    settled_px, doubt = np.empty(found_px.shape, np.float32), np.empty(found_px.shape, np.uint8)
    halo = _MEAN_PX // 2

    def settle(rows: slice) -> None:
        around = slice(max(rows.start - halo, 0), rows.stop + halo)
        strip = _settle_strip(view, around, found_px[around], other_px[around])
        inner = slice(rows.start - around.start, rows.stop - around.start)
        settled_px[rows], doubt[rows] = (values[inner] for values in strip)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(settle, _strips(len(found_px), _SETTLED_ROWS)))
    if view.parallel:
        # Parallel cameras have no disparities below 0; this prevents negative disparities in a plain sky.
        np.maximum(settled_px, 0, out=settled_px)
    return settled_px, doubt


def _settle_strip(
    view: _StripView,
    rows: slice,
    found_px: Float32[np.ndarray, "h w"],
    other_px: Float32[np.ndarray, "h w"],
) -> tuple[Float32[np.ndarray, "h w"], UInt8[np.ndarray, "h w"]]:
    from stereoweave.matching import upsample_kernels as kernels

    farthest_px, nearest_px = view.surfaces_px(rows)
    at_edge, prior_px = view.at_edge(farthest_px, nearest_px), view.prior_px(rows)
    agreed = np.empty(found_px.shape, bool)
    kernels.agree(found_px, other_px, agreed)
    off_px = found_px - prior_px
    follows = agreed & (np.abs(off_px) <= _FOLLOWED_PX)
    share, mean_px = (
        cv2.blur(values, (_MEAN_PX, _MEAN_PX)) for values in (follows.astype(np.float32), off_px * follows)
    )
    around = share > _LEAST_SHARE_AROUND
    np.divide(mean_px, share, out=mean_px, where=around)
    followed_px = np.where(around, prior_px + mean_px, prior_px)
    smooth = (follows & (share > _LEAST_SHARE)) | ~(agreed | at_edge)
    settled_px = np.where(smooth, followed_px, np.where(agreed, found_px, prior_px))
    kernels.fill(agreed, at_edge, farthest_px, nearest_px, settled_px)
    doubt = np.where(follows, _FOLLOWS, np.where(agreed | at_edge, _CHANGED, _UNSEEN))
    return settled_px, doubt.astype(np.uint8)


def _confidence(
    smaller: Float[np.ndarray, "h2 w2"], doubt: UInt8[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Resize the smaller pair's confidence and reduce it according to the doubt."""
    confidence = _resize(smaller, doubt.shape)
    for rows in _strips(len(doubt), _SETTLED_ROWS):
        kept = confidence[rows] * _LEFT_OF_CONFIDENCE[doubt[rows]]
        np.minimum(kept, _MOST_CONFIDENCE[doubt[rows]], out=confidence[rows])
    return confidence


def _no_paths(width: int) -> _Paths:
    """Return the initial state of the vertical paths."""
    from stereoweave.matching import upsample_kernels as kernels

    return _Paths(
        np.full((width, kernels.PATH), kernels.NEVER),
        np.zeros(width, np.uint16),
        np.zeros((width, 2), np.int16),
    )


def _strips(height: int, rows: int) -> list[slice]:
    return [slice(top, min(top + rows, height)) for top in range(0, height, rows)]


def _cues(grey: UInt8[np.ndarray, "h w"], rows: slice) -> _StripCues:
    """Return the cues of a strip of rows; the census codes also use the rows next to the strip."""
    from stereoweave.matching import refine_kernels as kernels

    above = min(_CENSUS_PX, rows.start)
    around = grey[rows.start - above : rows.stop + _CENSUS_PX]
    codes = np.empty(around.shape, np.uint32)
    kernels.census(around, codes)
    return _StripCues(codes[above:][: rows.stop - rows.start], grey[rows])


def _pull() -> UInt8[np.ndarray, " d"]:
    """Return the cost of each candidate's position in its band."""
    from stereoweave.matching import upsample_kernels as kernels

    away_px = np.abs(np.arange(kernels.BAND) - kernels.MIDDLE)
    return (_PULL * (np.clip(away_px, _FREE_PX, _FARTHEST_PX) - _FREE_PX)).astype(np.uint8)


def _places(size: int, smaller: int) -> Int[np.ndarray, " n"]:
    """Return, for each of `size` pixels, the index of the smaller image's pixel that covers it."""
    return np.minimum(((np.arange(size) + 0.5) * smaller / size).astype(int), smaller - 1)


def _resize(values: Float[np.ndarray, "h w"], shape: tuple[int, int]) -> Float32[np.ndarray, "h2 w2"]:
    return cv2.resize(values.astype(np.float32), shape[::-1], interpolation=cv2.INTER_LINEAR)


def _mirror(values: Shaped[np.ndarray, "h w"]) -> Shaped[np.ndarray, "h w"]:
    return np.ascontiguousarray(values[:, ::-1])
