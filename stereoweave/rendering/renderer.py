"""View synthesis: images from virtual cameras on or beside the line through the two real cameras."""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Num, UInt8

from stereoweave.arguments import check_kind, check_number
from stereoweave.errors import StereoweaveError
from stereoweave.io.arrays import ImageLike, as_rgb
from stereoweave.matching.exposure import match_exposure, recolour
from stereoweave.matching.left_right_check import at_match
from stereoweave.stereo import Estimate, StereoCamera, StereoPair, View, assume_camera, check_fits
from stereoweave.system.threads import in_bands, thread_count

if TYPE_CHECKING:
    from stereoweave.rendering.canvas_kernels import Canvas, Side

FIRST_POSITION, LAST_POSITION = -1.0, 2.0
_MOST_THREADS = 4
_LEAST_NEARNESS = 1e-3
# Rows per band when background is uncovered. Independent of the number of threads, as results must be.
_BAND_ROWS = 60
_FARTHEST_MOVE = 1.0
# Percentile of the disparity that is taken as infinitely far; matching errors lie below it.
_FAR_PERCENT = 1


class Renderer:
    """Renderer of any number of views of one pair; the data that all views share is computed once.

    Attributes:
        pair: The two images, and their camera if known.
        estimate: The pair's estimate.
        strength: Factor that scales the baseline about its middle: position p is seen from
            0.5 + strength * (p - 0.5).
        convergence_px: Disparity of the plane that stays in place in all views; from -width to width.
        fine: The two images in more than 8 bits, for `fine_view`: float32 RGB from 0 to 255, of which the
            pair's are the rounded ones; None if there are none.
    """

    def __init__(  # noqa: PLR0913 - the options of all views
        self,
        pair: StereoPair,
        estimate: Estimate,
        *,
        strength: float = 1.0,
        convergence_px: float = 0.0,
        threads: int | None = None,
        fine: tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w 3"]] | None = None,
    ) -> None:
        check_fits(estimate, pair)
        _check_fine(fine, pair)
        self.pair, self.estimate, self.fine = pair, estimate, fine
        self.strength = check_strength(strength)
        self.convergence_px = check_convergence_px(convergence_px, pair.left.shape[1])
        self._threads = min(_MOST_THREADS, thread_count(threads))
        maps_px = estimate.disparity_px, estimate.right_disparity_px
        with ThreadPoolExecutor(self._threads) as pool:
            looks = pool.submit(match_exposure, pair.left, pair.right, estimate)
            self._sides = tuple(pool.map(_make_side, (pair.left, pair.right), maps_px, fine or (None, None)))
        self._looks = looks.result()
        self._hidden: dict[bool, HiddenBackground] = {}
        self._confidence = np.require(estimate.confidence, np.float32, ["C", "W"])

    def __repr__(self) -> str:
        height, width = self.pair.left.shape[:2]
        return (
            f"Renderer({width}x{height}, strength {self.strength:g}, convergence {self.convergence_px:g} px)"
        )

    def view(self, position: float, *, up: float = 0.0, forward: float = 0.0) -> View:
        """Render the view from a position, where 0 is the left camera and 1 the right one; see `render`.

        Args:
            position: Position from -1 to 2, after `strength` is applied.
            up: Distance above the line through the cameras, in baselines; from -1 to 1.
            forward: Distance from that line towards the scene, in baselines; from -1 to 1.
        """
        position = check_position(position, strength=self.strength, up=up, forward=forward)
        up, forward = float(up), float(forward)
        moves = bool(self.convergence_px or up or forward)
        if position in (0, 1) and not moves:
            pair = self.pair
            image, seen = (pair.right, pair.right_seen) if position else (pair.left, pair.left_seen)
            drawn = np.ones(image.shape[:2], bool) if seen is None else seen.copy()
            return View(image=image.copy(), drawn=drawn)
        canvas = self._draw(position)
        if up or forward:
            from stereoweave.rendering.camera_motion import move_camera

            camera = self.pair.camera or _assume_camera(self.estimate)
            offset_px = (position - 0.5) * self.convergence_px + position * camera.doffs_px
            canvas = move_camera(canvas, camera, offset_px, up, forward)
        return View(image=canvas.image, drawn=canvas.drawn)

    def fine_view(self, position: float) -> Float32[np.ndarray, "h w 3"]:
        """Render the view from a position in the bits of `fine`, from 0 to 255; see `view`."""
        if self.fine is None:
            raise StereoweaveError("fine: expected two pictures for a view in more than 8 bits, found none")
        position = check_position(position, strength=self.strength)
        if position in (0, 1) and not self.convergence_px:
            return self.fine[int(position)].copy()
        # The kernels add a half, which rounds where images are of whole numbers.
        return np.clip(self._draw(position).image - np.float32(0.5), 0, 255)

    def _draw(self, position: float) -> "Canvas":
        """Render the view from a position on the line through the cameras, with holes filled."""
        from stereoweave.rendering.canvas_kernels import empty_canvas
        from stereoweave.rendering.draw_kernels import draw  # it loads LLVM
        from stereoweave.rendering.hole_filling_kernels import fill, paint_background

        # The square root makes the weights of both images more equal, which lowers noise: +0.03 dB on
        # rendered views and +0.1 dB on Venus.
        shares = abs(1 - position) ** 0.5, abs(position) ** 0.5
        tables = self._looks.tables(position) if self._looks else (None, None)
        colours = [_recolour(side.image, table) for side, table in zip(self._sides, tables, strict=True)]
        left, right = (
            side._replace(
                **colour,
                shift=end - position,
                offset_px=(position - 0.5) * self.convergence_px,
                # Not 0, because some surfaces are seen by the more distant camera only.
                nearness=max(share / sum(shares), _LEAST_NEARNESS),
            )
            for side, colour, end, share in zip(self._sides, colours, (0, 1), shares, strict=True)
        )
        canvas = empty_canvas((left if position < 0.5 else right).image)
        work = partial(draw, left, right, self._confidence, canvas)
        in_bands(work, len(canvas.image), self._threads, self._threads)
        if not 0 <= position <= 1:
            # Between the cameras, holes are only a few pixels wide: `fill` alone is faster and as good.
            hidden = self.find_background(right=position > 1)
            paint_background(*hidden, (right if position > 1 else left).shift, left.offset_px, canvas)
        fill(canvas)
        for side, seen in ((left, self.pair.left_seen), (right, self.pair.right_seen)):
            if seen is not None:
                canvas.drawn[:] &= _is_content(seen, side, canvas.surface_px)
        return canvas

    def find_background(self, right: bool) -> "HiddenBackground":
        """Return the background that neither camera sees but that is visible from beyond one of them."""
        if right not in self._hidden:
            self._hidden[right] = _uncover_background(self._sides, right, self._threads)
        return self._hidden[right]


class HiddenBackground(NamedTuple):
    """Background that neither camera sees, on an input image's grid; see `background_kernels.uncover`."""

    disparity_px: np.ndarray
    colours: np.ndarray


def render(  # noqa: PLR0913 - the options of one view
    left: ImageLike,
    right: ImageLike,
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
    """Render the view from a position on or beside the line through the two cameras, using both images.

    Both disparity maps are splatted to the new view; the nearer surface wins. Each pixel samples both images
    at its surface. An image's weight depends on the distance to its camera and on whether its own disparity
    agrees; where the camera's line of sight is blocked, its disparity is that of a nearer surface. Where the
    two maps contradict each other, the confidence and the similarity of the images decide. Holes, which
    neither camera sees, are filled from their farther side. Differences in exposure and colour are removed:
    the view has the colours of the left image at position 0, those of the right image at position 1, and a
    blend in between.

    To render many views of one pair, use `Renderer`.

    Args:
        left: Left image, as for `estimate`: path, PIL image, array or tensor.
        right: Right image of the same size.
        estimate: The pair's estimate (`stereoweave.estimate`). If it holds an aligned pair, that is rendered.
        position: Position from -1 to 2; 0 is the left camera and 1 the right one.
        threads: Number of threads; at most four are used. Default: all cores.
        strength: Factor that scales the baseline about its middle, as in `Renderer`.
        convergence_px: Disparity of the plane that stays in place in all views.
        up: Distance above the line through the cameras, in baselines; from -1 to 1.
        forward: Distance from that line towards the scene, in baselines; from -1 to 1.
        camera: Camera whose focal length, principal point and doffs `up` and `forward` use. Default: the
            camera of the estimate's pair, or one whose focal length is the image width.

    Returns:
        The view, which has the same size as the images; `drawn` is False in filled holes, and where an
        image's border without content, as rectification leaves it, may show. The view from position 0 or 1 is
        the image itself.

    Raises:
        ValueError: The sizes differ, or a number is out of range.
    """
    check_kind("estimate", estimate, Estimate)
    given = estimate.pair or StereoPair(left=as_rgb(left, "left"), right=as_rgb(right, "right"))
    pair = replace(given, camera=given.camera if camera is None else camera)
    renderer = Renderer(pair, estimate, strength=strength, convergence_px=convergence_px, threads=threads)
    return renderer.view(position, up=up, forward=forward)


def check_position(position: float, *, strength: float = 1.0, up: float = 0.0, forward: float = 0.0) -> float:
    """Return the position at this strength; raise a StereoweaveError if no view can be seen from there."""
    position = check_number("position", position)
    up, forward = check_number("up", up), check_number("forward", forward)
    seen_from = 0.5 + strength * (position - 0.5)
    if not FIRST_POSITION <= seen_from <= LAST_POSITION:
        between = f"{FIRST_POSITION:g} to {LAST_POSITION:g} (0 is the left camera and 1 the right one)"
        if not FIRST_POSITION <= position <= LAST_POSITION:
            raise StereoweaveError(f"expected {between}, got {position:g}", setting="position")
        found = f"{seen_from:g} (position {position:g} at strength {strength:g})"
        raise StereoweaveError(f"expected views from {between}, got {found}", setting="strength")
    for name, value in (("up", up), ("forward", forward)):
        if not abs(value) <= _FARTHEST_MOVE:
            raise StereoweaveError(
                f"expected -{_FARTHEST_MOVE:g} to {_FARTHEST_MOVE:g} baselines, got {value}", setting=name
            )
    return seen_from


def check_strength(strength: float) -> float:
    """Return a strength as a float; raise a StereoweaveError if it is negative or not finite."""
    strength = check_number("strength", strength)
    if not 0 <= strength < math.inf:
        raise StereoweaveError(f"expected 0 or more, got {strength}", setting="strength")
    return strength


def check_convergence_px(convergence_px: float, width_px: int) -> float:
    """Return a convergence as a float; raise a StereoweaveError if it exceeds the width of the picture."""
    convergence_px = check_number("convergence_px", convergence_px)
    if not abs(convergence_px) <= width_px:
        raise StereoweaveError(
            f"expected -{width_px} to {width_px} px (the picture's width), got {convergence_px}",
            setting="convergence_px",
        )
    return convergence_px


def _check_fine(fine: object, pair: StereoPair) -> None:
    if fine is None:
        return
    images = fine if isinstance(fine, tuple) else ()
    shape = pair.left.shape
    if [(getattr(x, "dtype", None), getattr(x, "shape", None)) for x in images] != [(np.float32, shape)] * 2:
        raise StereoweaveError(
            f"fine: expected a tuple of two float32 arrays {list(shape)}, found {type(fine).__name__}"
        )


def _make_side(
    image: UInt8[np.ndarray, "h w 3"],
    disparity_px: Float[np.ndarray, "h w"],
    fine: Float32[np.ndarray, "h w 3"] | None,
) -> "Side":
    """Pack an input image and its maps for the kernels; the fields that depend on the view are 0."""
    from stereoweave.rendering.canvas_kernels import Side

    # Numba compiles a second version of every kernel for read-only or non-contiguous arrays.
    image = np.require(image, np.uint8, ["C", "W"])
    disparity_px = np.require(disparity_px, np.float32, ["C", "W"])
    return Side(
        image=image if fine is None else np.require(fine, np.float32, ["C", "W"]),
        grey=cv2.cvtColor(image, cv2.COLOR_RGB2GRAY),
        disparity_px=disparity_px,
        nearer_px=cv2.dilate(disparity_px, np.ones((3, 3), np.uint8)) - disparity_px,
        shift=0.0,
        offset_px=0.0,
        nearness=0.0,
    )


def _is_content(
    seen: Bool[np.ndarray, "h w"], side: "Side", surface_px: Float32[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return the mask of the view's pixels that lie in an image's content, or outside the image."""
    content, inside = at_match(seen.astype(np.uint8), side.shift * surface_px + side.offset_px, -1)
    return (content > 0) | ~inside


def _recolour(
    image: Num[np.ndarray, "h w 3"], table: Float[np.ndarray, "256 3"] | None
) -> dict[str, np.ndarray]:
    """Return a side's image and grey levels, recoloured with a table; an empty dict if there is no table."""
    if table is None:
        return {}
    if image.dtype == np.uint8:
        coloured = recolour(image, table)
        return {"image": coloured, "grey": cv2.cvtColor(coloured, cv2.COLOR_RGB2GRAY)}
    levels = np.arange(256, dtype=np.float32)
    fine = np.dstack([np.interp(image[..., at], levels, table[:, at]) for at in range(3)]).astype(np.float32)
    return {"image": fine, "grey": cv2.cvtColor(np.rint(fine).astype(np.uint8), cv2.COLOR_RGB2GRAY)}


def _assume_camera(estimate: Estimate) -> StereoCamera:
    """Return the camera that is assumed if none is known.

    Negative disparities mean that the cameras converge; the lowest ones are then taken to be at infinity.
    """
    height, width = estimate.disparity_px.shape
    doffs_px = max(0.0, -float(np.percentile(estimate.disparity_px, _FAR_PERCENT)))
    return assume_camera((width, height), doffs_px=doffs_px)


def _uncover_background(sides: "Sequence[Side]", right: bool, threads: int) -> HiddenBackground:
    """Reconstruct the background behind one image's foreground, for views from beyond that image's camera."""
    from stereoweave.rendering.background_kernels import uncover

    own, other = sides[right], sides[not right]
    hidden = HiddenBackground(np.empty_like(own.disparity_px), np.empty_like(own.image))
    # Views from beyond the left camera uncover background to the left of the foreground.
    outwards = 1 if right else -1
    known = own.image, own.disparity_px, own.nearer_px, other.disparity_px, outwards
    height = len(own.image)
    in_bands(partial(uncover, *known, *hidden), height, -(-height // _BAND_ROWS), threads)
    return hidden
