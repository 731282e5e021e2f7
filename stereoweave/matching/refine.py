"""Refinement of an estimate by matching once more at full resolution, with the network's disparity as prior.

The method is semi-global matching (Hirschmueller 2008) at and around pixels of low confidence, and right
pixels that match newly found left disparities, over all disparities from the network's least one nearby to
its greatest one. A candidate's cost is the difference in colour (in grey levels, if few pixels are searched)
and census, plus the confidence-weighted distance to the network's disparity. Where both views agree, the
found disparities replace the network's. This recovers edges, as well as thin structures that are below the
network's resolution.
"""

import math
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8

from stereoweave.matching.contrast import measure_contrast
from stereoweave.matching.exposure import equalise_grey, equalise_right
from stereoweave.matching.left_right_check import at_match, is_occluded, measure_disagreement
from stereoweave.matching.step_penalties import penalise_large_steps
from stereoweave.stereo import Estimate, StereoPair, check_fits
from stereoweave.system.steps import step
from stereoweave.system.threads import in_even_bands, run_together, thread_count

if TYPE_CHECKING:
    from stereoweave.matching.refine_kernels import Cues, Search

# Candidates extend this far beyond the estimate's disparities; their number is a multiple of the vector
# length.
_MARGIN_PX = 4
_CANDIDATES_MULTIPLE = 16
# Each candidate of a searched pixel takes 3 bytes, so larger images are refined in strips, which overlap by
# this many rows on each side.
_CANDIDATES_AT_ONCE = 100_000_000
_OVERLAP_PX = 64  # two tiles
_BESIDE = np.ones((1, 3), np.uint8)
# Pixels whose match, by the network's disparity, lies farther than this outside the other image are not
# searched. Most have no match; where the network errs, one inside may be missed (lab notebook, 2026-11-29).
_OUTSIDE_PX = 2
# A tile's first candidate is the least disparity in it and in the eight tiles around it. Nearer surfaces are
# searched everywhere, because what the network misses is nearer than what is around it.
_TILES_AROUND = np.ones((3, 3), np.uint8)
# Factor on a pixel's confidence where the network's disparities for the two views disagree.
_DOUBTED = 0.2
_SAME_PX = 1.0
# Factor on the confidence of the right view's disparities, because those of the shipped networks lack the
# last refinement (decision 0035). None then reaches CERTAIN, so any of them that is searched may be replaced.
_COARSE = np.float32(0.7)
# Least confidence where the refined views agree on a textured surface. Of disparities of lower confidence, 60
# to 88 % are there within 1 px of the truth (rendered pairs). On plain walls 20 to 50 % are, because false
# matches agree there too.
_CONFIRMED = np.float32(0.7)
_TEXTURE_MEAN_PX, _TEXTURE_PX, _TEXTURE_LEVELS = 3, 5, 8
# ... and where the pictures differ by no more than this share of the contrast; in noise, and between pictures
# of two scenes, that is rare, although their views may agree.
_LITTLE_DIFFERENCE = np.float32(0.4)
# Factor on the confidence where they differ by more than this share.
_MUCH_DIFFERENCE, _UNLIKE = np.float32(0.8), np.float32(0.7)
_MOST_THREADS = 4


class Extent(NamedTuple):
    """What is searched. Disparities of at least `refine_kernels.CERTAIN` are kept in any case.

    Attributes:
        confidence: Left pixels of lower confidence are searched.
        reach_px: So are the pixels up to this far around them.
        both_views: Whether right pixels of low confidence are searched, too. The matches of newly found left
            disparities always are.
        in_colour: Whether colours are compared instead of grey levels.
    """

    confidence: float
    reach_px: int
    both_views: bool
    in_colour: bool


# These are 32 % of the left pixels of real pairs with `base`. New views gain 0.1 dB from a search everywhere,
# and lose 0.3 dB without the pixels around.
WIDE = Extent(confidence=0.85, reach_px=4, both_views=True, in_colour=True)
# These are 16 % of the left and 18 % of the right pixels, and bring two thirds of what a wide search does.
NARROW = Extent(confidence=0.45, reach_px=2, both_views=False, in_colour=False)


class _View(NamedTuple):
    """A view to match.

    Attributes:
        own: Cues of the view.
        other: Cues of the other image, aligned for the kernels.
        searched: Pixels whose disparity is searched; elsewhere the network's is kept.
        towards: -1 for the left view, whose matches are to the left, and 1 for the right view.
    """

    own: "Cues"
    other: "Cues"
    searched: Bool[np.ndarray, "h w"]
    towards: int

    def take(self, rows: slice) -> "_View":
        """Return a strip of rows of the view."""
        own, other = (type(cues)(*(cue[rows] for cue in cues)) for cues in self[:2])
        return _View(own, other, self.searched[rows], self.towards)


@step("refining")
def refine(
    left: UInt8[np.ndarray, "h w 3"],
    right: UInt8[np.ndarray, "h w 3"],
    estimate: Estimate,
    threads: int | None = None,
    extent: Extent = WIDE,
) -> Estimate:
    """Correct the disparities of both views by semi-global matching at full resolution.

    The network's disparity is kept where matching confirms it to within 1 px (the network is then more
    precise), where the left view's confidence is high, and where the two views disagree. The confidence is at
    least 0.7 where the refined views agree on texture and the pictures are alike there, but 0 stays 0; it is
    lowered where they are unlike. Different exposures are equalised first.

    Args:
        left: Left image, uint8 RGB [H, W, 3].
        right: Right image of the same size.
        estimate: The pair's estimate (`stereoweave.estimate`).
        threads: Maximum number of threads; default: all cores. At most four are used.
        extent: What is searched: by default all that is not certain, in colour; by NARROW, what is around
            pixels of a confidence below 0.45, by grey levels, in half of the time.
    """
    pair = StereoPair(left=left, right=right)
    check_fits(estimate, pair)
    count = min(_MOST_THREADS, thread_count(threads))
    trust = np.asarray(estimate.confidence, np.float32, order="C")
    images, right_trust = run_together(
        [partial(_equalise, pair, estimate, extent), partial(right_confidence, estimate)], count
    )
    found_px, right_found_px = _match_views(images, estimate, extent, right_trust, count)
    right_px = estimate.right_disparity_px
    disparity_px, right_disparity_px = run_together(
        [
            partial(_settle, estimate.disparity_px, found_px, right_found_px, trust, -1),
            partial(_settle, right_px, right_found_px, found_px, _COARSE * right_trust, 1),
        ],
        count,
    )
    (disagreement_px, inside), (alike, unlike) = run_together(
        [
            partial(measure_disagreement, disparity_px, right_disparity_px),
            partial(_compare_at_match, left, images, disparity_px),
        ],
        count,
    )
    agreed = inside & (np.abs(disagreement_px) <= _SAME_PX)
    occluded = is_occluded(disagreement_px, inside)
    confidence = np.where(unlike & ~occluded, _UNLIKE * trust, trust)
    # A confidence of 0 marks pixels without content or texture.
    confirmed = agreed & (trust > 0) & alike
    return Estimate(
        disparity_px=disparity_px,
        right_disparity_px=right_disparity_px,
        confidence=np.where(confirmed, np.maximum(confidence, _CONFIRMED), confidence),
        occluded=occluded,
    )


def _equalise(
    pair: StereoPair, estimate: Estimate, extent: Extent
) -> tuple[UInt8[np.ndarray, "h w *c"], UInt8[np.ndarray, "h w *c"]]:
    """Return both images to compare, the right one with the left one's exposure."""
    return (pair.left, equalise_right(pair, estimate)) if extent.in_colour else equalise_grey(pair, estimate)


def _compare_at_match(
    left: UInt8[np.ndarray, "h w 3"],
    images: tuple[UInt8[np.ndarray, "h w *c"], UInt8[np.ndarray, "h w *c"]],
    disparity_px: Float32[np.ndarray, "h w"],
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Return the masks of textured pixels that differ little and much from their match in `images`."""
    contrast = measure_contrast(left, _TEXTURE_MEAN_PX, _TEXTURE_PX)
    here, there = (x if x.ndim == 2 else cv2.cvtColor(x, cv2.COLOR_RGB2GRAY) for x in images)
    columns = np.arange(here.shape[1], dtype=np.float32) - disparity_px
    rows = np.broadcast_to(np.arange(len(here), dtype=np.float32)[:, None], columns.shape)
    seen = cv2.remap(there, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    difference = cv2.blur(cv2.absdiff(here, seen), (_TEXTURE_PX, _TEXTURE_PX))
    textured = contrast >= _TEXTURE_LEVELS
    return (
        textured & (difference <= _LITTLE_DIFFERENCE * contrast),
        textured & (difference > _MUCH_DIFFERENCE * contrast),
    )


def find_matching_costs(pair: StereoPair, count: int) -> UInt8[np.ndarray, "h w d"]:
    """Return the left view's matching costs without a network's disparity, 0..108 [H, W, count].

    Candidate i is a disparity of i px. Matches outside the right image are compared with its border column.
    """
    from stereoweave.matching import refine_kernels as kernels  # it loads LLVM

    nothing = np.zeros(pair.left.shape[:2], np.float32)
    own, other = (_cues(image, nothing, 0, nothing) for image in (pair.left, pair.right))
    search, size = _lay_out(np.zeros(_tiles(nothing.shape), np.int32), nothing == 0, count)
    costs = np.empty(size, np.uint8)
    kernels.match(own, _align(other, 0, count, -1, 1), search, -1, count, 0, len(nothing), costs)
    return costs.reshape(*nothing.shape, count)


def rehearse_refining() -> None:
    """Refine a small estimate, to compile all kernels (`compiling_ahead.compile_ahead`)."""
    image, px = np.zeros((32, 32, 3), np.uint8), np.zeros((32, 32), np.float32)
    refine(image, image, Estimate(disparity_px=px, right_disparity_px=px, confidence=px, occluded=px > 0), 1)


def _settle(
    disparity_px: Float[np.ndarray, "h w"],
    found_px: Float32[np.ndarray, "h w"],
    other_px: Float32[np.ndarray, "h w"],
    trust: Float32[np.ndarray, "h w"],
    towards: int,
) -> Float32[np.ndarray, "h w"]:
    """Replace a view's disparities with the matched disparities at which both views agree."""
    from stereoweave.matching import refine_kernels as kernels  # it loads LLVM

    settled_px = np.array(disparity_px, np.float32, order="C")
    agreed = np.empty(settled_px.shape, bool)
    kernels.settle(found_px, other_px, trust, towards, settled_px, agreed)
    kernels.extend(agreed, trust, towards, settled_px)
    return settled_px


def _match_views(
    images: tuple[UInt8[np.ndarray, "h w *c"], UInt8[np.ndarray, "h w *c"]],
    estimate: Estimate,
    extent: Extent,
    right_trust: Float32[np.ndarray, "h w"],
    threads: int,
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Match both views, and return the disparities of least cost in each view."""
    left_px, right_px = estimate.disparity_px, estimate.right_disparity_px
    first_px, count = _candidates(left_px, right_px)
    left, right, searched = run_together(
        [
            partial(_cues, images[0], left_px, first_px, estimate.confidence),
            partial(_cues, images[1], right_px, first_px, _COARSE * right_trust),
            partial(find_searched, left_px, estimate.confidence, -1, extent),
        ],
        threads,
    )
    left_view = _View(left, _align(right, first_px, count, -1, threads), searched, -1)
    found_px = _match_view(left_view, first_px, count, threads)
    right_searched = find_matches_of_found(estimate.disparity_px, found_px, extent.reach_px)
    if extent.both_views:
        right_searched |= find_searched(right_px, right_trust, 1, extent)
    right_view = _View(right, _align(left, first_px, count, 1, threads), right_searched, 1)
    return found_px, _match_view(right_view, first_px, count, threads)


def _match_view(view: _View, first_px: int, count: int, threads: int) -> Float32[np.ndarray, "h w"]:
    """Match a view, a large one in strips of rows."""
    height, width = view.searched.shape
    found_px = np.empty((height, width), np.float32)
    kept_rows = max(_CANDIDATES_AT_ONCE // (width * count), 4 * _OVERLAP_PX) - 2 * _OVERLAP_PX
    for top in range(0, height, kept_rows):
        rows = slice(max(top - _OVERLAP_PX, 0), min(top + kept_rows + _OVERLAP_PX, height))
        strip_px = _match_strip(view.take(rows), first_px, count, threads)
        found_px[top : top + kept_rows] = strip_px[top - rows.start :][:kept_rows]
    return found_px


def _match_strip(strip: _View, first_px: int, count: int, threads: int) -> Float32[np.ndarray, "h w"]:
    """Match a strip of rows of a view."""
    from stereoweave.matching import refine_kernels as kernels

    own, other, _, towards = strip
    searched = strip.searched.view(np.uint8)
    (search, size), steps_along, steps_down = run_together(
        [
            partial(_choose_candidates, strip, count),
            partial(_penalise_steps, own.grey, 1),
            partial(_penalise_steps, own.grey, 0),
        ],
        threads,
    )
    costs, sums = np.empty(size, np.uint8), np.empty(size, np.uint16)
    found_px = np.empty(own.grey.shape, np.float32)

    def match(first: int, last: int) -> None:
        found_px[first:last] = first_px + own.prior[first:last] / np.float32(kernels.SUBSTEPS)
        kernels.match(own, other, search, towards, count, first, last, costs)
        kernels.along_rows(costs, own, search, steps_along, count, first, last, sums)

    def pick(first: int, last: int) -> None:
        kernels.along_columns(costs, own, search, steps_down, count, first_px, first, last, sums, found_px)

    per_column, per_row = (cv2.reduce(searched, axis, cv2.REDUCE_SUM, dtype=cv2.CV_32S) for axis in (0, 1))
    in_even_bands(match, per_row.ravel().tolist(), threads)
    in_even_bands(pick, per_column.ravel().tolist(), threads)
    return found_px


def _penalise_steps(grey: UInt8[np.ndarray, "h w"], axis: int) -> UInt8[np.ndarray, "h w"]:
    """Return each pixel's penalty for a large step from the one before along an axis."""
    return penalise_large_steps(grey, grey.take([0, *range(grey.shape[axis] - 1)], axis))


def _candidates(*both: Float[np.ndarray, "h w"]) -> tuple[int, int]:
    """Return the first candidate in px and the number of candidates, given both views' disparities.

    Beyond the width nothing matches, and an outlier would take the time of all candidates up to it.
    """
    width = both[0].shape[1]
    ends_px = min(view.min() for view in both), max(view.max() for view in both)
    least_px, greatest_px = (min(max(end_px, -width), width) for end_px in ends_px)
    least_px = math.floor(least_px)
    # Parallel cameras have no disparities below 0, and candidates below 0 would attract a plain sky.
    first_px = least_px - _MARGIN_PX if least_px < 0 else max(least_px - _MARGIN_PX, 0)
    last_px = math.ceil(greatest_px) + _MARGIN_PX
    count = last_px - first_px + 1
    return first_px, count + -count % _CANDIDATES_MULTIPLE


def find_searched(
    disparity_px: Float[np.ndarray, "h w"], trust: Float[np.ndarray, "h w"], towards: int, extent: Extent
) -> Bool[np.ndarray, "h w"]:
    """Return the mask of the pixels of low confidence, and around, whose disparity is searched.

    Args:
        disparity_px: The network's disparity of the view.
        trust: Its confidence.
        towards: -1 for the left view, whose matches are to the left, and 1 for the right view.
        extent: What is searched.
    """
    width = trust.shape[1]
    columns = np.arange(width, dtype=np.float32) + towards * disparity_px
    seen = (columns >= -_OUTSIDE_PX) & (columns <= width - 1 + _OUTSIDE_PX)
    return _with_around((trust < extent.confidence) & seen, extent.reach_px)


def _with_around(where: Bool[np.ndarray, "h w"], reach_px: int) -> Bool[np.ndarray, "h w"]:
    size = 2 * reach_px + 1
    return cv2.dilate(where.astype(np.uint8), np.ones((size, size), np.uint8)) > 0


def find_matches_of_found(
    disparity_px: Float[np.ndarray, "h w"], found_px: Float32[np.ndarray, "h w"], reach_px: int
) -> Bool[np.ndarray, "h w"]:
    """Return the mask of right pixels that match left ones for which the search found another disparity.

    Pixels around them are included. There the network may be certain, in the right view, of the background of
    a thin structure that the left view's search has found. New views gain 0.3 dB, as much as from a search of
    the whole right view.

    Args:
        disparity_px: The network's disparity of the left view.
        found_px: The disparity that the search found.
        reach_px: How far around them, in px.
    """
    from stereoweave.matching import refine_kernels as kernels  # it loads LLVM

    matched = np.zeros(found_px.shape, bool)
    kernels.mark_matches(np.asarray(disparity_px, np.float32, order="C"), found_px, matched)
    return _with_around(matched, reach_px)


def _choose_candidates(view: _View, count: int) -> tuple["Search", int]:
    """Choose each tile's candidates among `count` ones; also return their number, summed over all pixels."""
    from stereoweave.matching import refine_kernels as kernels

    least = np.empty(_tiles(view.searched.shape), np.uint16)
    kernels.find_least_priors(view.own.prior, least)
    firsts = cv2.erode(least, _TILES_AROUND).astype(np.int32) // kernels.SUBSTEPS - _MARGIN_PX
    firsts = np.maximum(firsts, 0)
    return _lay_out(firsts - firsts % _CANDIDATES_MULTIPLE, view.searched, count)


def _tiles(size: tuple[int, ...]) -> tuple[int, ...]:
    """Return the number of tiles in each column and row of an image."""
    from stereoweave.matching import refine_kernels as kernels

    return tuple(math.ceil(length / kernels.TILE_PX) for length in size)


def _lay_out(
    firsts: Int32[np.ndarray, "h w"], searched: Bool[np.ndarray, "h2 w2"], count: int
) -> tuple["Search", int]:
    """Place the candidates of the searched pixels one after the other; also return their total number."""
    from stereoweave.matching import refine_kernels as kernels

    search = kernels.Search(np.empty(searched.shape, np.int64), firsts)
    total = np.empty(1, np.int64)
    kernels.lay_out(searched, count, search, total)
    return search, int(total[0])


def _cues(
    image: UInt8[np.ndarray, "h w *c"], disparity_px: np.ndarray, first_px: int, trust: np.ndarray
) -> "Cues":
    """Return what the kernels read of a colour or grey image."""
    from stereoweave.matching import refine_kernels as kernels

    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    codes = np.empty(grey.shape, np.uint32)
    kernels.census(grey, codes)
    levels = np.stack(cv2.split(image), 1)
    rows = levels.reshape(-1, grey.shape[1])
    width = grey.shape[1]
    above_first_px = np.clip(disparity_px, -width, width) - first_px  # as `_candidates` limits them
    return kernels.Cues(
        grey=grey,
        census=codes,
        levels=levels,
        darkest=_halfway(levels, cv2.erode(rows, _BESIDE).reshape(levels.shape)),
        brightest=_halfway(levels, cv2.dilate(rows, _BESIDE).reshape(levels.shape)),
        prior=np.rint(above_first_px * kernels.SUBSTEPS).astype(np.uint16),
        trust=np.rint(trust * kernels.MOST_TRUST).astype(np.uint16),
    )


def _halfway(levels: UInt8[np.ndarray, "*size"], others: UInt8[np.ndarray, "*size"]) -> np.ndarray:
    """Return the mean of both levels, rounded down."""
    return (levels & others) + ((levels ^ others) >> 1)


def _align(cues: "Cues", first_px: int, count: int, towards: int, threads: int) -> "Cues":
    """Place the other image's columns as the kernels read them, between copies of the border columns.

    Only what the kernels read of the other image is placed: `grey` stays as it is.
    """
    width = cues.grey.shape[1]
    columns = first_px + np.arange(width + count - 1)
    inside = slice(*np.searchsorted(columns, [0, width]))

    def align(name: str) -> np.ndarray:
        cue = getattr(cues, name)
        return _place(cue if towards > 0 else _mirror(cue), columns, inside)

    names = [name for name in cues._fields if name != "grey"]
    placed = run_together([partial(align, name) for name in names], threads)
    return cues._replace(**dict(zip(names, placed, strict=True)))


def _mirror(cue: np.ndarray) -> np.ndarray:
    """Return the cue with its columns reversed; three times as fast as NumPy's copy of a reversed view."""
    # OpenCV has no uint32.
    rows = cue.reshape(-1, cue.shape[-1]).view(f"i{cue.itemsize}")
    return cv2.flip(rows, 1).view(cue.dtype).reshape(cue.shape)


def _place(cue: np.ndarray, columns: np.ndarray, inside: slice) -> np.ndarray:
    """Take these columns, of which those `inside` exist; the others are copies of the border columns."""
    placed = np.empty((*cue.shape[:-1], len(columns)), cue.dtype)
    placed[..., : inside.start], placed[..., inside.stop :] = cue[..., :1], cue[..., -1:]
    placed[..., inside] = cue[..., columns[0] + inside.start : columns[0] + inside.stop]
    return placed


def right_confidence(estimate: Estimate) -> Float32[np.ndarray, "h w"]:
    """Return the confidence of the right view's disparities, taken from the left view at their matches."""
    seen_px, inside = at_match(estimate.disparity_px, estimate.right_disparity_px, 1)
    confidence, _ = at_match(np.asarray(estimate.confidence, np.float32), estimate.right_disparity_px, 1)
    agreed = inside & (np.abs(seen_px - estimate.right_disparity_px) <= _SAME_PX)
    return np.where(agreed, confidence, np.float32(_DOUBTED) * confidence)
