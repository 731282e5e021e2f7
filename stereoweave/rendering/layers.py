"""A scene as two images with depth: what the left camera sees, and the background behind it.

A program that shows the scene from near the cameras draws the front layer, cut at its depth edges, over the
layer behind it, which continues the background behind every edge and beyond the picture's borders.
"""

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from stereoweave.matching.exposure import equalise_right
from stereoweave.matching.left_right_check import OCCLUSION_STEP_PX
from stereoweave.rendering.canvas_kernels import NOTHING, SAME_SURFACE_PX
from stereoweave.rendering.speckles import find_nearer_px, find_nearest, find_speckles, remove_speckles
from stereoweave.stereo import Estimate, StereoPair
from stereoweave.system.threads import in_bands, thread_count

# Added to the reach of every side, so that a rim that carries the foreground's colour is replaced too.
_FURTHER = 0.25
_BAND_ROWS = 60
_MEDIAN_PX = 5
_PASSES = 3
# Widths of windows: a narrow part of the layer behind; what is seen together with replaced pixels; the rim of
# an edge in the right image; the surroundings of an edge in the left one; a gap beyond the borders.
_NARROW_PX, _NEAR_PX, _RIM_PX, _BESIDE_PX, _GAP_PX = 5, 7, 3, 15, 25


@dataclass(frozen=True, kw_only=True)
class Reach:
    """The viewpoints from which layers are seen, in baselines.

    Attributes:
        first, last: Least and greatest position; 0 is the left camera and 1 the right one.
        up: Greatest distance above or below the line through the cameras.
    """

    first: float
    last: float
    up: float


@dataclass(frozen=True, kw_only=True)
class Layers:
    """Two images with disparity on the left image's grid.

    Attributes:
        front: Left image, uint8 RGB [H, W, 3].
        front_px: Its disparity, float32 [H, W].
        behind: uint8 RGB [H + 2 * rows, W + 2 * columns, 3]: the left image with the background in place of
            the foreground along the foreground's edges, continued beyond the borders.
        behind_px: Disparity of `behind`, float32.
        margin_px: The columns and rows that `behind` adds on each side.
        drawn: bool, of the size of `behind`: whether the colour comes from an input image.
    """

    front: UInt8[np.ndarray, "h w 3"]
    front_px: Float32[np.ndarray, "h w"]
    behind: UInt8[np.ndarray, "h2 w2 3"]
    behind_px: Float32[np.ndarray, "h2 w2"]
    margin_px: tuple[int, int]
    drawn: Bool[np.ndarray, "h2 w2"]


def make_layers(
    pair: StereoPair,
    estimate: Estimate,
    reach: Reach,
    margin_px: tuple[int, int],
    threads: int | None = None,
) -> Layers:
    """Return the layers of a pair.

    The layer behind shows what the right image shows there; where neither image shows it, it continues the
    texture of the farther side.

    Args:
        pair: The pair.
        estimate: The pair's estimate.
        reach: The viewpoints from which the layers are to be seen.
        margin_px: The columns and rows that `behind` adds on each side.
        threads: Number of threads; default: all cores.
    """
    front = pair.left
    # Speckles would fly about, and ragged outlines would tear.
    front_px = remove_speckles(estimate.disparity_px)
    behind, behind_px, invented = _replace_foreground(front, front_px, reach, thread_count(threads))
    columns, rows = margin_px
    sides = (rows, rows, columns, columns)
    behind = cv2.copyMakeBorder(behind, *sides, cv2.BORDER_REFLECT_101)
    behind_px = cv2.copyMakeBorder(behind_px, *sides, cv2.BORDER_REPLICATE)
    invented = cv2.copyMakeBorder(invented.view(np.uint8), *sides, cv2.BORDER_CONSTANT, value=[1]).view(bool)
    nearest_px = cv2.copyMakeBorder(front_px, *sides, cv2.BORDER_CONSTANT, value=[-float(NOTHING)])
    seen_px, seen_colours = _look_behind(pair, estimate, nearest_px, margin_px)
    by_right = seen_px > NOTHING
    behind[by_right], behind_px[by_right] = seen_colours[by_right], seen_px[by_right]
    invented &= ~by_right
    gaps = (nearest_px == -NOTHING) & ~by_right & _close(by_right)
    invented |= _mend(behind, behind_px, by_right | invented, gaps)
    # The rows are continued one by one; their median joins them.
    for _ in range(_PASSES):
        for values in (behind, behind_px):
            values[invented] = cv2.medianBlur(values, _MEDIAN_PX)[invented]
    return Layers(
        front=front,
        front_px=front_px,
        behind=behind,
        behind_px=behind_px,
        margin_px=margin_px,
        drawn=~invented,
    )


def _mend(
    behind: UInt8[np.ndarray, "h2 w2 3"],
    behind_px: Float32[np.ndarray, "h2 w2"],
    replaced: Bool[np.ndarray, "h2 w2"],
    gaps: Bool[np.ndarray, "h2 w2"],
) -> Bool[np.ndarray, "h2 w2"]:
    """Replace what would fly before the background or mar it, and return the mask of where.

    That is the gaps, speckles and narrow parts of the foreground between replaced pixels, and colours beside
    an edge, which may be the nearer surface's. All get the nearest value that is free of these.
    """
    near = cv2.dilate(replaced.view(np.uint8), np.ones((_NEAR_PX, _NEAR_PX), np.uint8)).view(bool)
    window = np.ones((_NARROW_PX, _NARROW_PX), np.uint8)
    open_px = cv2.morphologyEx(behind_px, cv2.MORPH_OPEN, window)
    wrong = gaps | near & (find_speckles(behind_px) | (behind_px - open_px > SAME_SURFACE_PX))
    rim = near & ~replaced & (find_nearer_px(behind_px) > 0)
    inner = cv2.morphologyEx(open_px, cv2.MORPH_GRADIENT, window) <= SAME_SURFACE_PX
    places = find_nearest(inner & ~wrong & ~rim)
    behind_px[wrong] = behind_px[places][wrong]
    wrong |= rim
    behind[wrong] = behind[places][wrong]
    return wrong


def _replace_foreground(
    image: UInt8[np.ndarray, "h w 3"], disparity_px: Float32[np.ndarray, "h w"], reach: Reach, threads: int
) -> tuple[UInt8[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Return image and disparity with the background continued behind the edges, and a mask of where."""
    colours, behind_px = image.copy(), disparity_px.copy()
    invented = np.zeros(disparity_px.shape, bool)
    # Views from the right uncover the right side of the foreground, views from above its upper side.
    directions = (
        (False, 1, reach.last),
        (False, -1, -reach.first),
        (True, -1, reach.up),
        (True, 1, reach.up),
    )
    for turned, side, far in directions:
        hidden_px, texture = _uncover_side(image, disparity_px, side, far + _FURTHER, turned, threads)
        new = (hidden_px > NOTHING) & ~invented
        colours[new], behind_px[new] = texture[new], hidden_px[new]
        invented |= new
    return colours, behind_px, invented


def _uncover_side(  # noqa: PLR0913 - two images, and a direction in four parts
    image: UInt8[np.ndarray, "h w 3"],
    disparity_px: Float32[np.ndarray, "h w"],
    side: int,
    far: float,
    turned: bool,
    threads: int,
) -> tuple[Float[np.ndarray, "h w"], UInt8[np.ndarray, "h w 3"]]:
    """Return disparity (or NOTHING) and colour of the background that one side of the foreground hides."""
    from stereoweave.rendering.background_kernels import uncover

    if far <= 0:
        return np.full(disparity_px.shape, NOTHING), image
    order = (1, 0) if turned else (0, 1)
    # The kernel uncovers as much as a camera one baseline away sees.
    moved_px = np.ascontiguousarray(disparity_px.transpose(order) * np.float32(far))
    known = np.ascontiguousarray(image.transpose(*order, 2))
    nearer_px = cv2.dilate(moved_px, np.ones((3, 3), np.uint8)) - moved_px
    unseen_px = np.full_like(moved_px, NOTHING)
    hidden_px, colours = np.empty_like(moved_px), np.empty_like(known)
    work = partial(uncover, known, moved_px, nearer_px, unseen_px, side, hidden_px, colours)
    in_bands(work, len(known), -(-len(known) // _BAND_ROWS), threads)
    hidden_px = np.where(hidden_px > NOTHING, hidden_px / np.float32(far), NOTHING)
    return hidden_px.transpose(order), colours.transpose(*order, 2)


def _look_behind(
    pair: StereoPair,
    estimate: Estimate,
    front_px: Float32[np.ndarray, "h2 w2"],
    margin_px: tuple[int, int],
) -> tuple[Float32[np.ndarray, "h2 w2"], UInt8[np.ndarray, "h2 w2 3"]]:
    """Return disparity (or NOTHING) and colour of what the right image shows behind the front layer.

    Beside the front layer's edges, also where the right image shows the front layer itself: the left image's
    colours there may be the nearer surface's.
    """
    columns, rows = margin_px
    right_px = remove_speckles(estimate.right_disparity_px)
    # A right pixel near a nearer surface may carry that surface's colour.
    pure = cv2.dilate(right_px, np.ones((_RIM_PX, _RIM_PX), np.uint8)) - right_px <= SAME_SURFACE_PX
    y, x = np.nonzero(pure)
    order = np.argsort(right_px[y, x], kind="stable")  # the nearest is written last
    y, x = y[order], x[order]
    found_px = right_px[y, x]
    at = x + found_px + columns
    behind_px = np.full(front_px.shape, NOTHING, np.float32)
    for column in (np.floor(at).astype(int), np.ceil(at).astype(int)):
        kept = (column >= 0) & (column < front_px.shape[1])
        kept[kept] &= found_px[kept] < front_px[y[kept] + rows, column[kept]] - SAME_SURFACE_PX
        landed = y[kept] + rows, column[kept]
        behind_px[landed] = np.maximum(behind_px[landed], found_px[kept])
    behind_px[find_speckles(behind_px)] = NOTHING
    places = np.indices(front_px.shape, np.float32)
    v, u = places[0] - rows, places[1] - columns
    inside = front_px < -NOTHING
    step_px = _measure_step_px(np.where(inside, front_px, NOTHING))
    beside = inside & (behind_px == NOTHING) & (step_px > SAME_SURFACE_PX)
    met_px = np.where(pure, right_px, NOTHING)
    met_px = cv2.remap(met_px, u - front_px, v, cv2.INTER_NEAREST, borderValue=[float(NOTHING)])
    beside &= abs(met_px - front_px) <= OCCLUSION_STEP_PX
    behind_px[beside] = front_px[beside]
    right = equalise_right(pair, estimate)
    return behind_px, cv2.remap(right, u - behind_px, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _measure_step_px(disparity_px: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Return how much nearer the nearest surface beside a pixel is."""
    return cv2.dilate(disparity_px, np.ones((_BESIDE_PX, _BESIDE_PX), np.uint8)) - disparity_px


def _close(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the mask with its gaps filled."""
    window = np.ones((_GAP_PX, _GAP_PX), np.uint8)
    return cv2.morphologyEx(mask.view(np.uint8), cv2.MORPH_CLOSE, window).view(bool)
