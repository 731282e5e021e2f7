"""New views from an estimate: what a camera elsewhere on the line through the two would have seen."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from stereoweave.errors import StereoweaveError
from stereoweave.stereo import Estimate, StereoPair, View
from stereoweave.threads import thread_count

if TYPE_CHECKING:
    from stereoweave.rendering_kernels import Canvas, Side

FIRST_POSITION, LAST_POSITION = -1.0, 2.0
# A nearer neighbour's colour is out of place once the new view parts the two by more than this.
_PARTED_PX = 1.0
# The photographs are aligned over windows of this many pixels, and a disparity is moved by one pixel at most.
_WINDOW_PX = 5
_LARGEST_STEP_PX = 1.0
# Where the squared slope of the grey values is less than this, on average, there is nothing to align.
_FLAT_LEVELS2 = 30.0
_MOST_THREADS = 4


class Renderer:
    """Views of one pair from one estimate, as many as wanted: what they share is made once.

    Attributes:
        pair: The two photographs, with their camera where it is known.
        estimate: Of these two photographs.
        strength: Multiplies the baseline about the middle: p is seen from 0.5 + strength * (p - 0.5).
        convergence_px: The disparity of the plane that stays in place from view to view.
    """

    def __init__(
        self,
        pair: StereoPair,
        estimate: Estimate,
        *,
        strength: float = 1.0,
        convergence_px: float = 0.0,
        threads: int | None = None,
    ) -> None:
        _check_size(pair, estimate)
        self.pair, self.estimate = pair, estimate
        self.strength, self.convergence_px = strength, convergence_px
        self._threads = min(_MOST_THREADS, thread_count(threads))

    def view(self, position: float) -> View:
        """The view from a position: 0 is the left camera, 1 the right one; see `render`."""
        position = 0.5 + self.strength * (position - 0.5)
        check_position(position)
        left, right = self.pair.left, self.pair.right
        if position in (0, 1):
            photo = right if position else left
            return View(image=photo.copy(), drawn=np.ones(photo.shape[:2], bool))
        return _rendered(left, right, self.estimate, float(position), self._threads)


def render(
    left: UInt8[np.ndarray, "h w 3"],
    right: UInt8[np.ndarray, "h w 3"],
    estimate: Estimate,
    position: float,
    threads: int | None = None,
) -> View:
    """The view from a position on the line through the two cameras, made of both photographs.

    Both disparity maps are splatted to the new view, where the nearer surface wins. Each pixel takes its
    colour from the place of its surface in both photographs, weighted by how near their cameras are, and by
    whether their own disparity agrees: it does not where the camera's sight is blocked. Where the two maps
    contradict each other, confidence and the photographs' agreement decide. What neither camera saw is filled
    from the farther side of the gap.

    Args:
        left: The left photograph, uint8 RGB [H, W, 3].
        right: The right one, of the same size.
        estimate: Of these two photographs (`stereoweave.estimate`).
        position: 0 is the left camera, 1 the right one; -1 to 2.
        threads: How many threads may be used, of which four at most are; all cores if left out.

    Returns:
        The view, of the photographs' size; `drawn` is False where the colour was invented. At 0 and 1 it is
        the photograph itself.

    Raises:
        ValueError: If the sizes differ, or a number is out of its range.
    """
    return Renderer(StereoPair(left=left, right=right), estimate, threads=threads).view(position)


def check_position(position: float) -> None:
    """Raise a ValueError unless views can be rendered at that position."""
    if not FIRST_POSITION <= position <= LAST_POSITION:
        raise StereoweaveError(
            f"position: expected {FIRST_POSITION} to {LAST_POSITION} (0 left camera, 1 right), got {position}"
        )


def _check_size(pair: StereoPair, estimate: Estimate) -> None:
    found, expected = estimate.disparity_px.shape, pair.left.shape[:2]
    if found != expected:
        raise StereoweaveError(
            f"estimate: expected the photographs' size {expected[1]}x{expected[0]}, "
            f"got {found[1]}x{found[0]}; make it from these photographs"
        )


def _rendered(left: np.ndarray, right: np.ndarray, estimate: Estimate, position: float, threads: int) -> View:
    from stereoweave import rendering_kernels as kernels  # Numba takes half a second to import

    distances = abs(position), abs(1 - position)
    sides = (
        _side(left, estimate.disparity_px, -position, distances[1] / sum(distances)),
        _side(right, estimate.right_disparity_px, 1 - position, distances[0] / sum(distances)),
    )
    confidence = np.require(estimate.confidence, np.float32, ["C", "W"])
    canvas = _canvas(left if position < 0.5 else right)

    def place(rows: slice) -> None:
        seen, part = [side.rows(rows) for side in sides], canvas.rows(rows)
        for side in seen:
            kernels.splat(side.disparity_px, side.shift, side.landed_px)
        kernels.choose(*seen, confidence[rows], part)
        kernels.compare(*seen, part)

    def paint(rows: slice) -> None:
        kernels.paint(*(side.rows(rows) for side in sides), canvas.rows(rows))

    _in_bands(place, left.shape[0], threads)
    _align(canvas)
    _in_bands(paint, left.shape[0], threads)
    kernels.fill(canvas)
    return View(image=np.clip(np.rint(canvas.image), 0, 255).astype(np.uint8), drawn=canvas.drawn)


def _side(
    photo: UInt8[np.ndarray, "h w 3"], disparity_px: Float[np.ndarray, "h w"], shift: float, nearness: float
) -> "Side":
    """One photograph as the kernels take it, nothing landed yet."""
    from stereoweave.rendering_kernels import IMPURE, Side

    # Numba would compile every kernel once more for arrays that are read-only or have gaps.
    photo = np.require(photo, np.uint8, ["C", "W"])
    disparity_px = np.require(disparity_px, np.float32, ["C", "W"])
    parted_px = abs(shift) * (cv2.dilate(disparity_px, np.ones((3, 3), np.uint8)) - disparity_px)
    return Side(
        photo=photo,
        grey=cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY),
        disparity_px=disparity_px,
        purity=np.clip(1 + _PARTED_PX - parted_px, IMPURE, 1).astype(np.float32),
        landed_px=np.empty_like(disparity_px),
        shift=shift,
        nearness=nearness,
    )


def _canvas(photo: UInt8[np.ndarray, "h w 3"]) -> "Canvas":
    """An empty canvas; where a whole row finds no colour, this photograph will show."""
    from stereoweave.rendering_kernels import Canvas

    size = photo.shape[:2]
    return Canvas(
        front_px=np.empty(size, np.float32),
        back_px=np.empty(size, np.float32),
        share=np.empty(size, np.float32),
        products=np.empty(photo.shape, np.float32),
        image=photo.astype(np.float32),
        pure=np.empty(size, bool),
        drawn=np.empty(size, bool),
    )


def _align(canvas: "Canvas") -> None:
    """Move the new view's disparities so that the photographs match there (Lucas and Kanade, one step).

    A matcher's noise would show as blur otherwise: each photograph would be sampled beside the right place.
    """
    window = (_WINDOW_PX, _WINDOW_PX)
    sums = cv2.boxFilter(canvas.products, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
    step_px = -sums[..., 0] / (sums[..., 1] + _FLAT_LEVELS2 * np.maximum(sums[..., 2], 1))
    canvas.front_px[:] += canvas.products[..., 2] * np.clip(step_px, -_LARGEST_STEP_PX, _LARGEST_STEP_PX)


def _in_bands(work: Callable[[slice], None], height: int, count: int) -> None:
    """Do the work on that many bands of rows, each in a thread.

    Rows are independent: in rectified photographs everything moves along them.
    """
    ends = [height * band // count for band in range(count + 1)]
    with ThreadPoolExecutor(count) as pool:
        list(pool.map(work, map(slice, ends[:-1], ends[1:])))
