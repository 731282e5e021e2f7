"""New views from an estimate: what a camera elsewhere on the line through the two would have seen."""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from stereoweave.arguments import check_number
from stereoweave.errors import StereoweaveError
from stereoweave.matching.exposure import match_exposure, recolour
from stereoweave.stereo import Estimate, StereoCamera, StereoPair, View, check_fits
from stereoweave.system.threads import in_bands, thread_count

if TYPE_CHECKING:
    from stereoweave.rendering.canvas_kernels import Canvas, Side

FIRST_POSITION, LAST_POSITION = -1.0, 2.0
_MOST_THREADS = 4
_LEAST_NEARNESS = 1e-3
# What is hidden is found in bands of about this many rows, however many threads there are.
_BAND_ROWS = 60
_FARTHEST_MOVE = 1.0
# So few pixels may be farther than what is taken to be far away: a matcher's errors.
_FAR_PERCENT = 1


class Renderer:
    """Views of one pair from one estimate, as many as wanted: what they share is made once.

    Attributes:
        pair: The two photographs, with their camera where it is known.
        estimate: Of these two photographs.
        strength: Multiplies the baseline about the middle: p is seen from 0.5 + strength * (p - 0.5).
        convergence_px: The disparity of the plane that stays in place from view to view; at most the
            picture's width, of either sign.
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
        check_fits(estimate, pair)
        _check_shifts(strength, convergence_px, pair)
        self.pair, self.estimate = pair, estimate
        self.strength, self.convergence_px = strength, convergence_px
        self._threads = min(_MOST_THREADS, thread_count(threads))
        maps_px = estimate.disparity_px, estimate.right_disparity_px
        with ThreadPoolExecutor(self._threads) as pool:
            looks = pool.submit(match_exposure, pair.left, pair.right, estimate)
            self._sides = tuple(pool.map(_make_side, (pair.left, pair.right), maps_px))
        self._looks = looks.result()
        self._hidden: dict[bool, HiddenBackground] = {}
        self._confidence = np.require(estimate.confidence, np.float32, ["C", "W"])

    def view(self, position: float, *, up: float = 0.0, forward: float = 0.0) -> View:
        """The view from a position: 0 is the left camera, 1 the right one; see `render`.

        Args:
            position: -1 to 2 after `strength`.
            up: How far above the line through the cameras, in baselines; -1 to 1.
            forward: How far before it, in baselines; -1 to 1.
        """
        check_number("position", position)
        position = 0.5 + self.strength * (position - 0.5)
        check_position(position, up=up, forward=forward)
        moves = bool(self.convergence_px or up or forward)
        if position in (0, 1) and not moves:
            photo = self.pair.right if position else self.pair.left
            return View(image=photo.copy(), drawn=np.ones(photo.shape[:2], bool))
        canvas = self._draw(float(position))
        if up or forward:
            from stereoweave.rendering.camera_motion import move_camera

            camera = self.pair.camera or _assume_camera(self.estimate)
            offset_px = (position - 0.5) * self.convergence_px + position * camera.doffs_px
            canvas = move_camera(canvas, camera, offset_px, up, forward)
        return View(image=canvas.image, drawn=canvas.drawn)

    def _draw(self, position: float) -> "Canvas":
        """The view from the line through the cameras, filled."""
        from stereoweave.rendering.canvas_kernels import empty_canvas
        from stereoweave.rendering.draw_kernels import draw  # Numba takes half a second to import
        from stereoweave.rendering.hole_filling_kernels import fill, lay

        # The root, because two photographs have less noise than one: 0.03 dB on rendered views, 0.1 on Venus.
        shares = abs(1 - position) ** 0.5, abs(position) ** 0.5
        tables = self._looks.tables(position) if self._looks else (None, None)
        photos = [_recolour(side.photo, table) for side, table in zip(self._sides, tables, strict=True)]
        left, right = (
            side._replace(
                **photo,
                shift=end - position,
                offset_px=(position - 0.5) * self.convergence_px,
                # Not 0, because the other camera alone sees some things.
                nearness=max(share / sum(shares), _LEAST_NEARNESS),
            )
            for side, photo, end, share in zip(self._sides, photos, (0, 1), shares, strict=True)
        )
        canvas = empty_canvas((left if position < 0.5 else right).photo)
        work = partial(draw, left, right, self._confidence, canvas)
        in_bands(work, len(canvas.image), self._threads, self._threads)
        if not 0 <= position <= 1:
            # In between, what neither camera saw is a few pixels wide; `fill` is quicker, and does as well.
            hidden = self._find_background(right=position > 1)
            lay(*hidden, (right if position > 1 else left).shift, left.offset_px, canvas)
        fill(canvas)
        return canvas

    def _find_background(self, right: bool) -> "HiddenBackground":
        """What is hidden from both cameras, and seen from beyond the right one or the left one."""
        if right not in self._hidden:
            self._hidden[right] = _uncover_background(self._sides, right, self._threads)
        return self._hidden[right]


class HiddenBackground(NamedTuple):
    """Background that neither camera sees, at a photograph's pixels; see `background_kernels.uncover`."""

    disparity_px: np.ndarray
    colours: np.ndarray


def render(  # noqa: PLR0913 - each is a choice of the caller's
    left: UInt8[np.ndarray, "h w 3"],
    right: UInt8[np.ndarray, "h w 3"],
    estimate: Estimate,
    position: float,
    threads: int | None = None,
    *,
    strength: float = 1.0,
    convergence_px: float = 0.0,
    up: float = 0.0,
    forward: float = 0.0,
    camera: StereoCamera | None = None,
) -> View:
    """The view from a position on the line through the two cameras, or beside it, made of both photographs.

    Both disparity maps are splatted to the new view, where the nearer surface wins. Each pixel takes its
    colour from the place of its surface in both photographs, weighted by how near their cameras are, and by
    whether their own disparity agrees: it does not where the camera's sight is blocked. Where the two maps
    contradict each other, confidence and the photographs' agreement decide. What neither camera saw goes on
    from the farther side of the gap. Photographs that differ in exposure or colour are brought to one look:
    that of the left one at 0, that of the right one at 1, and in between on the way.

    For many views of one pair make a `Renderer`.

    Args:
        left: The left photograph, uint8 RGB [H, W, 3].
        right: The right one, of the same size.
        estimate: Of these two photographs (`stereoweave.estimate`).
        position: 0 is the left camera, 1 the right one; -1 to 2.
        threads: How many threads may be used, of which four at most are; all cores if left out.
        strength: Multiplies the baseline about the middle, as for `Renderer`.
        convergence_px: The disparity of the plane that stays in place from view to view.
        up: How far above the line through the cameras, in baselines; -1 to 1.
        forward: How far before it, in baselines; -1 to 1.
        camera: For `forward` and `up`, which take its focal length, centre and doffs; without one, the focal
            length is taken to be the picture's width.

    Returns:
        The view, of the photographs' size; `drawn` is False where the colour was invented. At 0 and 1 it is
        the photograph itself.

    Raises:
        ValueError: If the sizes differ, or a number is out of its range.
    """
    pair = StereoPair(left=left, right=right, camera=camera)
    renderer = Renderer(pair, estimate, strength=strength, convergence_px=convergence_px, threads=threads)
    return renderer.view(position, up=up, forward=forward)


def check_position(position: float, *, up: float = 0.0, forward: float = 0.0) -> None:
    """Raise a ValueError unless views can be rendered from there."""
    for name, value in (("position", position), ("up", up), ("forward", forward)):
        check_number(name, value)
    if not FIRST_POSITION <= position <= LAST_POSITION:
        raise StereoweaveError(
            f"expected {FIRST_POSITION} to {LAST_POSITION} (0 left camera, 1 right), got {position}",
            setting="position",
        )
    for name, value in (("up", up), ("forward", forward)):
        if not abs(value) <= _FARTHEST_MOVE:
            raise StereoweaveError(
                f"expected -{_FARTHEST_MOVE:g} to {_FARTHEST_MOVE:g} (baselines), got {value}", setting=name
            )


def _check_shifts(strength: float, convergence_px: float, pair: StereoPair) -> None:
    check_number("strength", strength)
    check_number("convergence_px", convergence_px)
    if not 0 <= strength < math.inf:
        raise StereoweaveError(f"expected 0 or more, got {strength}", setting="strength")
    width = pair.left.shape[1]
    if not abs(convergence_px) <= width:
        raise StereoweaveError(
            f"expected -{width} to {width} px, the picture's width, got {convergence_px}",
            setting="convergence_px",
        )


def _make_side(photo: UInt8[np.ndarray, "h w 3"], disparity_px: Float[np.ndarray, "h w"]) -> "Side":
    """One photograph as the kernels take it, for no view yet."""
    from stereoweave.rendering.canvas_kernels import Side

    # Numba would compile every kernel once more for arrays that are read-only or have gaps.
    photo = np.require(photo, np.uint8, ["C", "W"])
    disparity_px = np.require(disparity_px, np.float32, ["C", "W"])
    return Side(
        photo=photo,
        grey=cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY),
        disparity_px=disparity_px,
        nearer_px=cv2.dilate(disparity_px, np.ones((3, 3), np.uint8)) - disparity_px,
        shift=0.0,
        offset_px=0.0,
        nearness=0.0,
    )


def _recolour(
    photo: UInt8[np.ndarray, "h w 3"], table: Float[np.ndarray, "256 3"] | None
) -> dict[str, np.ndarray]:
    """A side's photograph and its grey levels in another look; nothing without a table."""
    if table is None:
        return {}
    coloured = recolour(photo, table)
    return {"photo": coloured, "grey": cv2.cvtColor(coloured, cv2.COLOR_RGB2GRAY)}


def _assume_camera(estimate: Estimate) -> StereoCamera:
    """A camera of 53 degrees of view, whose principal point is the picture's centre.

    Where disparities are negative, the cameras converge: what has the least is then taken to be far away.
    """
    height, width = estimate.disparity_px.shape
    return StereoCamera(
        focal_px=width,
        baseline_m=1.0,
        cx_px=(width - 1) / 2,
        cy_px=(height - 1) / 2,
        doffs_px=max(0.0, -float(np.percentile(estimate.disparity_px, _FAR_PERCENT))),
    )


def _uncover_background(sides: "Sequence[Side]", right: bool, threads: int) -> HiddenBackground:
    """What is behind the foreground of the right photograph, or of the left one, for views from beyond it."""
    from stereoweave.rendering.background_kernels import uncover

    own, other = sides[right], sides[not right]
    hidden = HiddenBackground(np.empty_like(own.disparity_px), np.empty_like(own.photo))
    # From beyond the left camera one looks behind the foreground where the background is on its left.
    outwards = 1 if right else -1
    known = own.photo, own.disparity_px, own.nearer_px, other.disparity_px, outwards
    height = len(own.photo)
    in_bands(partial(uncover, *known, *hidden), height, -(-height // _BAND_ROWS), threads)
    return hidden
