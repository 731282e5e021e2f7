"""An estimate of smaller photographs, brought to the full size of the photographs and to their edges.

Each level is at most twice as large as the one before, whose disparities are its prior. Semi-global matching
(Hirschmueller 2008), with candidates only near the prior's surfaces (as Rothermel et al. 2012), finds where
these meet, and where they are to a fraction of a pixel. It works on strips of rows: what its paths know is
handed from strip to strip, so that the strips' height changes nothing.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int16, Shaped, UInt8, UInt16, UInt32

from stereoweave.matching.left_right_check import find_occluded
from stereoweave.stereo import Estimate
from stereoweave.system.threads import in_bands, thread_count

# What the candidates of a strip and their costs may take.
_STRIP_BYTES = 150_000_000
_LEAST_ROWS = 32
_CENSUS_PX = 2
# A pixel may be of any surface that the smaller pictures show within a window of so many of their pixels.
_SURFACES_PX = 5
# Where these surfaces are so many of their pixels apart, there is an edge.
_EDGE_PX = 1.5
# What a candidate costs by each px that it is away from its surface, beyond the first of these and up to
# the second: the smaller pictures show disparity to about half a pixel of theirs.
_PULL, _FREE_PX, _FARTHEST_PX = 2, 1, 8
# A jump between two pixels costs most where they are equally bright, half of it at this difference.
_LARGEST_STEP, _LEAST_LARGE_STEP = 125, 30
_HALVING_LEVELS = 30
# Where the prior is off by no more, it is moved by what is found in such a window on average.
_FOLLOWED_PX = 2.0
_MEAN_PX = 9
_LEAST_SHARE, _LEAST_SHARE_AROUND = 0.3, 0.02
_SETTLED_ROWS = 256
# What is left of the prior's confidence, and the most that it can be. On painted pairs what follows the prior
# is right as often as that claimed, what the views see not alike 85 % as often, and what is changed every
# other time.
_FOLLOWS, _UNSEEN, _CHANGED = 0, 1, 2
_LEFT_OF_CONFIDENCE = np.array([1, 0.85, 1], np.float32)
_MOST_CONFIDENCE = np.array([1, 1, 0.5], np.float32)


class _Cues(NamedTuple):
    """What the costs of a strip are made of: census codes and grey levels, uint32 and uint8 [H, W]."""

    codes: UInt32[np.ndarray, "h w"]
    levels: UInt8[np.ndarray, "h w"]


class _Paths(NamedTuple):
    """What vertical paths know at a row, as `enlarging_kernels.along_columns` takes it."""

    costs: UInt16[np.ndarray, "w path"]
    least: UInt16[np.ndarray, " w"]
    first: Int16[np.ndarray, "w 2"]


class _View:
    """A left picture, the right one and the prior: what is seen of it in strips of rows.

    Args:
        grey: The left picture.
        other: The right one.
        smaller_px: The left one's disparities in a smaller copy, in pixels of that.
    """

    def __init__(
        self,
        grey: UInt8[np.ndarray, "h w"],
        other: UInt8[np.ndarray, "h w"],
        smaller_px: Float32[np.ndarray, "h2 w2"],
    ) -> None:
        self.grey, self.other = grey, other
        self._scale = scale = np.float32(grey.shape[1] / smaller_px.shape[1])
        self._columns_px = _resized(smaller_px, (len(smaller_px), grey.shape[1])) * scale
        window = np.ones((_SURFACES_PX, _SURFACES_PX), np.uint8)
        self._surfaces_px = cv2.erode(smaller_px, window) * scale, cv2.dilate(smaller_px, window) * scale
        self.parallel = smaller_px.min() >= 0
        self._rows, self._columns = (
            _places(size, smaller) for size, smaller in zip(grey.shape, smaller_px.shape, strict=True)
        )

    def prior_px(self, rows: slice) -> Float32[np.ndarray, "h w"]:
        """The disparity of the smaller copy at each pixel of some rows."""
        height, smaller = len(self.grey), len(self._columns_px)
        places = np.clip((np.arange(height)[rows] + 0.5) * smaller / height - 0.5, 0, smaller - 1)
        above = np.minimum(places.astype(int), smaller - 2)
        share = (places - above).astype(np.float32)[:, None]
        return (1 - share) * self._columns_px[above] + share * self._columns_px[above + 1]

    def surfaces_px(self, rows: slice) -> list[Float32[np.ndarray, "h w"]]:
        """The farthest and the nearest surface around each pixel of some rows."""
        return [surface[self._rows[rows]][:, self._columns] for surface in self._surfaces_px]

    def cues(self, rows: slice, threads: int) -> tuple[_Cues, _Cues]:
        """Those of both pictures as `enlarging_kernels.match` takes them."""
        from stereoweave.matching import upsample_kernels as kernels  # Numba takes half a second to import

        with ThreadPoolExecutor(threads) as pool:
            own, other = pool.map(lambda grey: _cues(grey, rows), (self.grey, self.other))
        more = ((0, 0), (kernels.BAND, kernels.BAND))
        return own, _Cues(*(np.pad(cue[:, ::-1], more, mode="edge") for cue in other))

    def first_candidates(self, rows: slice) -> Int16[np.ndarray, "h w 2"]:
        """The least disparity of each band."""
        from stereoweave.matching import upsample_kernels as kernels

        farthest_px, nearest_px = self.surfaces_px(rows)
        at_edge = self.at_edge(farthest_px, nearest_px)
        prior_px = self.prior_px(rows)
        bands_px = [np.where(at_edge, surface, prior_px) for surface in (farthest_px, nearest_px)]
        return np.rint(np.stack(bands_px, 2)).astype(np.int16) - np.int16(kernels.MIDDLE)

    def at_edge(
        self, farthest_px: Float32[np.ndarray, "h w"], nearest_px: Float32[np.ndarray, "h w"]
    ) -> Bool[np.ndarray, "h w"]:
        """Where the surfaces around a pixel are not one."""
        return nearest_px - farthest_px > _EDGE_PX * self._scale

    def steps_along(self, rows: slice) -> UInt16[np.ndarray, "h w1"]:
        """What a jump between a column and the one before it costs."""
        grey = self.grey[rows]
        return np.pad(_large_steps(grey[:, 1:], grey[:, :-1]), ((0, 0), (1, 1)))

    def steps_down(self, rows: slice) -> UInt16[np.ndarray, "h1 w"]:
        """What a jump between a row and the one before it costs, that behind the last row included."""
        grey = self.grey[max(rows.start - 1, 0) : rows.stop + 1]
        ends = rows.start == 0, rows.stop == len(self.grey)
        return np.pad(_large_steps(grey[1:], grey[:-1]), (ends, (0, 0)))


def enlarge(
    left: UInt8[np.ndarray, "h w 3"],
    right: UInt8[np.ndarray, "h w 3"],
    estimate: Estimate,
    threads: int | None = None,
) -> Estimate:
    """The estimate of smaller copies of two photographs, at the size of these.

    Disparities are px of the full size. Confidence is lowered where the photographs do not bear out what the
    smaller ones showed; what is occluded is found anew.

    Args:
        left: The left photograph, uint8 RGB [H, W, 3].
        right: The right one, of the same size.
        estimate: Of these two made smaller, alike in both directions.
        threads: How many threads may be used; all cores if left out.
    """
    height, width = left.shape[:2]
    for divisor in _divisors(width, estimate.disparity_px.shape[1]):
        size = round(width / divisor), round(height / divisor)
        estimate = _level(_grey(left, size), _grey(right, size), estimate, thread_count(threads))
    return estimate


def _divisors(width: int, smaller: int) -> list[int]:
    """How many times smaller than the full size the levels are: the last one is of the full size."""
    divisor = 1
    while width / (2 * divisor) > smaller:
        divisor *= 2
    return [divisor // 2**level for level in range(divisor.bit_length())]


def _grey(photo: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]) -> UInt8[np.ndarray, "h2 w2"]:
    """The photograph's grey levels at a size."""
    grey = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY)
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA)


def _level(
    left: UInt8[np.ndarray, "h w"], right: UInt8[np.ndarray, "h w"], smaller: Estimate, threads: int
) -> Estimate:
    """The estimate at the size of these grey pictures."""
    view = _View(left, right, smaller.disparity_px)
    right_view = _View(_mirrored(right), _mirrored(left), _mirrored(smaller.right_disparity_px))
    found_px, right_found_px = _found(view, threads), _found(right_view, threads)
    disparity_px, doubt = _settled(view, found_px, _mirrored(right_found_px), threads)
    right_disparity_px = _mirrored(_settled(right_view, right_found_px, _mirrored(found_px), threads)[0])
    del view, right_view, found_px, right_found_px  # as large as the result: 1 GB of 50 megapixels
    return Estimate(
        disparity_px=disparity_px,
        right_disparity_px=right_disparity_px,
        confidence=_confidence(smaller.confidence, doubt),
        occluded=find_occluded(disparity_px, right_disparity_px),
    )


def _found(view: _View, threads: int) -> Float32[np.ndarray, "h w"]:
    """The disparities of least cost of a left view."""
    from stereoweave.matching import upsample_kernels as kernels

    height, width = view.grey.shape
    count = 2 * kernels.BAND
    strips = _strips(height, max(_STRIP_BYTES // (3 * width * count), _LEAST_ROWS))
    # Memory that is new takes as long to get as a path: all strips work in the same.
    volumes = (np.empty((strips[0].stop, width, count), dtype) for dtype in (np.uint8, np.uint16))
    costs, sums = volumes
    found_px = np.empty((height, width), np.float32)
    from_below, paths = {}, _no_paths(width)
    for rows in reversed(strips):
        from_below[rows.start] = _Paths(*(values.copy() for values in paths))
        if rows.start > 0:
            _Strip(view, rows, costs, sums, threads).run_down(paths, backwards=1)
    paths = _no_paths(width)
    for rows in strips:
        strip = _Strip(view, rows, costs, sums, threads)
        strip.run_along()
        strip.run_down(paths, backwards=0)
        strip.run_down(from_below[rows.start], backwards=1)
        strip.pick(found_px[rows])
    return found_px


class _Strip:
    """Some rows of a left view, whose candidates' costs are written into `costs`."""

    def __init__(
        self,
        view: _View,
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
        """Write the sums of the paths along the rows."""
        self._in_bands(
            lambda *band: self._kernels.along_rows(self._costs, self._first, self._along, band, self._sums), 0
        )

    def run_down(self, paths: _Paths, backwards: int) -> None:
        """Add the path from above, or below; `paths` are those of the strip there, and become this one's."""
        volumes = self._costs, self._first, self._down
        self._in_bands(
            lambda *band: self._kernels.along_columns(*volumes, backwards, band, *paths, self._sums), 1
        )

    def pick(self, found_px: Float32[np.ndarray, "h w"]) -> None:
        """Write the disparities of least cost."""
        self._in_bands(lambda *band: self._kernels.pick(self._sums, self._first, band, found_px), 0)

    def _in_bands(self, work: Callable[[int, int], None], axis: int) -> None:
        in_bands(work, self._costs.shape[axis], self._threads, self._threads)


def _settled(
    view: _View,
    found_px: Float32[np.ndarray, "h w"],
    other_px: Float32[np.ndarray, "h w"],
    threads: int,
) -> tuple[Float32[np.ndarray, "h w"], UInt8[np.ndarray, "h w"]]:
    """A left view's disparity, from both views' and the prior; its doubt: _FOLLOWS, _UNSEEN or _CHANGED."""
    settled_px, doubt = np.empty(found_px.shape, np.float32), np.empty(found_px.shape, np.uint8)
    halo = _MEAN_PX // 2

    def settle(rows: slice) -> None:
        around = slice(max(rows.start - halo, 0), rows.stop + halo)
        strip = _settled_strip(view, around, found_px[around], other_px[around])
        inner = slice(rows.start - around.start, rows.stop - around.start)
        settled_px[rows], doubt[rows] = (values[inner] for values in strip)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(settle, _strips(len(found_px), _SETTLED_ROWS)))
    if view.parallel:
        # Parallel cameras give none below 0: a plain sky would take them.
        np.maximum(settled_px, 0, out=settled_px)
    return settled_px, doubt


def _settled_strip(
    view: _View,
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
    """What is left of the smaller copy's confidence."""
    confidence = _resized(smaller, doubt.shape)
    for rows in _strips(len(doubt), _SETTLED_ROWS):
        kept = confidence[rows] * _LEFT_OF_CONFIDENCE[doubt[rows]]
        np.minimum(kept, _MOST_CONFIDENCE[doubt[rows]], out=confidence[rows])
    return confidence


def _no_paths(width: int) -> _Paths:
    """Those before the first row."""
    from stereoweave.matching import upsample_kernels as kernels

    return _Paths(
        np.full((width, kernels.PATH), kernels.NEVER),
        np.zeros(width, np.uint16),
        np.zeros((width, 2), np.int16),
    )


def _strips(height: int, rows: int) -> list[slice]:
    return [slice(top, min(top + rows, height)) for top in range(0, height, rows)]


def _cues(grey: UInt8[np.ndarray, "h w"], rows: slice) -> _Cues:
    """Those of some rows, with what their neighbours beyond the rows say."""
    from stereoweave.matching import refine_kernels as kernels

    above = min(_CENSUS_PX, rows.start)
    around = grey[rows.start - above : rows.stop + _CENSUS_PX]
    codes = np.empty(around.shape, np.uint32)
    kernels.census(around, codes)
    return _Cues(codes[above:][: rows.stop - rows.start], grey[rows])


def _pull() -> UInt8[np.ndarray, " d"]:
    """What a candidate costs by its place in a band."""
    from stereoweave.matching import upsample_kernels as kernels

    away_px = np.abs(np.arange(kernels.BAND) - kernels.MIDDLE)
    return (_PULL * (np.clip(away_px, _FREE_PX, _FARTHEST_PX) - _FREE_PX)).astype(np.uint8)


def _places(size: int, smaller: int) -> Int[np.ndarray, " n"]:
    """The pixel of a smaller copy that shows each of `size` pixels."""
    return np.minimum(((np.arange(size) + 0.5) * smaller / size).astype(int), smaller - 1)


def _large_steps(
    grey: UInt8[np.ndarray, "h w"], before: UInt8[np.ndarray, "h w"]
) -> UInt16[np.ndarray, "h w"]:
    """What a jump between two pixels costs: less where their grey levels differ more."""
    costs = _LARGEST_STEP / (1 + cv2.absdiff(grey, before).astype(np.float32) / _HALVING_LEVELS)
    return np.maximum(costs, _LEAST_LARGE_STEP).astype(np.uint16)


def _resized(values: Float[np.ndarray, "h w"], shape: tuple[int, int]) -> Float32[np.ndarray, "h2 w2"]:
    return cv2.resize(values.astype(np.float32), shape[::-1], interpolation=cv2.INTER_LINEAR)


def _mirrored(values: Shaped[np.ndarray, "h w"]) -> Shaped[np.ndarray, "h w"]:
    return np.ascontiguousarray(values[:, ::-1])
