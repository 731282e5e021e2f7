"""Scenes for the 3-D viewer: two layers with depth, as images that a browser can read."""

import base64
import io
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8
from PIL import Image

from stereoweave.rendering.canvas_kernels import SAME_SURFACE_PX
from stereoweave.rendering.layers import Layers, Reach, make_layers
from stereoweave.rendering.layouts import median_disparity_px
from stereoweave.rendering.renderer import check_convergence_px, check_strength
from stereoweave.rendering.scaling import fit_size, scale_down
from stereoweave.rendering.speckles import find_nearer_px
from stereoweave.stereo import Estimate, StereoPair

POSITIONS = (-0.1, 1.1)
"""The positions between which the viewer moves."""
LARGEST_PX = (1600, 1600)
"""Largest width and height of the packed images."""
_UP = 0.2
_MOST_BYTES = 2_900_000
_FRONT_QUALITIES = (92, 88, 80, 70, 55, 40, 25, 10)
# The layer behind is seen in narrow strips only.
_LOWER_QUALITY = 8
# Steps of the packed disparity; at 1/8 px they cannot be seen.
_STEP_PX = 1 / 8
# The layer behind is smooth, so every second pixel of its disparity is enough.
_THINNING = 2
_TILE_PX = 16
# Borders that a viewpoint leaves without a picture are cut off, up to this share of a side.
_MOST_CUT = 0.06
_MOST_MARGIN = 0.12
# The columns beside a border, as a share of the width, whose disparity determines the cut there.
_BORDER = 0.1


def pack_scene(  # noqa: PLR0913 - all but the first two are optional
    pair: StereoPair,
    estimate: Estimate,
    *,
    size_px: tuple[int, int] = LARGEST_PX,
    strength: float = 1.0,
    convergence_px: float | None = None,
    threads: int | None = None,
) -> dict[str, Any]:
    """Return the scene for `StereoweaveViewer`, which JSON can hold; see `make_viewer` for the arguments.

    Images are data: addresses. A disparity map is a lossless WebP: its level, 256 * red + green, is
    the disparity in units of `code_px[1]` above `code_px[0]`. Its blue is how many pixels of disparity nearer
    the surface is whose colour a pixel of the front layer may carry.
    """
    strength, width = check_strength(strength), pair.left.shape[1]
    plane_px = median_disparity_px(estimate)
    if convergence_px is not None:
        plane_px = check_convergence_px(convergence_px, width)
    largest_px = min(size_px[0], LARGEST_PX[0]), min(size_px[1], LARGEST_PX[1])
    pair, estimate = scale_down(pair, estimate, fit_size(pair.left.shape, largest_px))
    plane_px *= pair.left.shape[1] / width
    first, last = (0.5 + strength * (position - 0.5) for position in POSITIONS)
    reach = Reach(first=first, last=last, up=_UP * strength)
    margin_px = _find_margin_px(estimate.disparity_px, reach, plane_px)
    layers = make_layers(pair, estimate, reach, margin_px, threads)
    height, width = layers.front_px.shape
    low_px = min(float(layers.front_px.min()), float(layers.behind_px.min()))
    high_px = max(float(layers.front_px.max()), float(layers.behind_px.max())) + _STEP_PX
    bounds = _find_bounds(layers, reach, plane_px, (low_px, high_px))
    rows, columns = bounds.shape[:2]
    return {
        "size_px": [width, height],
        "shown_px": _find_shown_px(layers.front_px, reach, plane_px),
        "behind_frame_px": [*margin_px, layers.behind_px.shape[1], layers.behind_px.shape[0]],
        "tiles_px": [columns * _TILE_PX, rows * _TILE_PX],
        "code_px": [low_px, _STEP_PX],
        "range_px": [low_px, high_px],
        "plane_px": plane_px,
        "positions": [reach.first, reach.last],
        "up": reach.up,
        "bounds": _address(bounds),
        **_encode_layers(layers, low_px),
    }


def _find_margin_px(disparity_px: Float[np.ndarray, "h w"], reach: Reach, plane_px: float) -> tuple[int, int]:
    """Return the columns and rows beyond the borders that the viewpoints show."""
    far_px = float(abs(disparity_px - plane_px).max())
    height, width = disparity_px.shape
    most = max(abs(reach.first), abs(reach.last))
    margins = min(most * far_px, _MOST_MARGIN * width), min(reach.up * far_px, _MOST_MARGIN * height)
    # Even numbers, so that thinning starts at a pixel of both grids.
    return _THINNING * int(np.ceil(margins[0] / _THINNING)), _THINNING * int(np.ceil(margins[1] / _THINNING))


def _find_shown_px(front_px: Float32[np.ndarray, "h w"], reach: Reach, plane_px: float) -> list[float]:
    """Return the rectangle of the left image to show, as left, top, width and height.

    Outside it, some viewpoint would show what neither camera saw, as far as it is a narrow strip.
    """
    height, width = front_px.shape
    beside = max(1, round(_BORDER * width))
    first, last = min(reach.first, 0.0), max(reach.last, 0.0)
    left_px = np.percentile(front_px[:, :beside], [2, 98]) - plane_px
    right_px = np.percentile(front_px[:, -beside:], [2, 98]) - plane_px
    all_px = np.percentile(front_px, [2, 98]) - plane_px
    # Beyond the right border, the right image shows what comes into view from the right.
    cuts = max(-last * left_px[0], -first * left_px[1]), -first * -right_px[0], reach.up * abs(all_px).max()
    start, stop, top = (
        float(np.clip(cut, 0, _MOST_CUT * side))
        for cut, side in zip(cuts, (width, width, height), strict=True)
    )
    return [start, top, width - start - stop, height - 2 * top]


def _find_bounds(
    layers: Layers, reach: Reach, plane_px: float, range_px: tuple[float, float]
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Return for each tile of the view the range of disparities that any viewpoint shows in it.

    The viewer searches no further. Red is the least and green the greatest level, 0 to 255 over the range.
    """
    height, width = layers.front_px.shape
    shape = -(-height // _TILE_PX), -(-width // _TILE_PX)
    least, greatest = np.full(shape, np.inf), np.full(shape, -np.inf)
    for disparity_px, margin_px in ((layers.front_px, (0, 0)), (layers.behind_px, layers.margin_px)):
        low, high = _reduce_tiles(disparity_px)
        for row, column in np.ndindex(low.shape):
            ends = low[row, column], high[row, column]
            place = column * _TILE_PX - margin_px[0], row * _TILE_PX - margin_px[1]
            rows, columns = _find_landing(place, np.array(ends) - plane_px, reach)
            np.minimum(least[rows, columns], ends[0], out=least[rows, columns])
            np.maximum(greatest[rows, columns], ends[1], out=greatest[rows, columns])
    levels = np.dstack([least, greatest]) - range_px[0]
    levels *= 255 / (range_px[1] - range_px[0])
    red, green = np.floor(levels[..., 0]), np.ceil(levels[..., 1])
    return np.clip(np.dstack([red, green, 0 * red]), 0, 255).astype(np.uint8)


def _reduce_tiles(
    disparity_px: Float32[np.ndarray, "h w"],
) -> tuple[Float32[np.ndarray, "rows columns"], Float32[np.ndarray, "rows columns"]]:
    """Return the least and the greatest disparity in each tile."""
    height, width = disparity_px.shape
    padded = np.pad(disparity_px, ((0, -height % _TILE_PX), (0, -width % _TILE_PX)), "edge")
    cells = padded.reshape(padded.shape[0] // _TILE_PX, _TILE_PX, padded.shape[1] // _TILE_PX, _TILE_PX)
    return cells.min((1, 3)), cells.max((1, 3))


def _find_landing(
    place: tuple[int, int], apart_px: Float[np.ndarray, " 2"], reach: Reach
) -> tuple[slice, slice]:
    """Return rows and columns of the tiles in which a tile's pixels appear from some viewpoint.

    Args:
        place: Column and row of the tile's first pixel.
        apart_px: Least and greatest disparity in the tile, less that of the plane that stays in place.
        reach: The viewpoints.
    """
    ways = ((reach.first, reach.last), (-reach.up, reach.up))
    parts = []
    for first_px, eyes in zip(place, ways, strict=True):
        moves = [-eye * apart for eye in eyes for apart in (*apart_px, 0.0)]
        # One pixel more, for interpolation.
        start = int((first_px + min(moves) - 1) // _TILE_PX)
        stop = int((first_px + _TILE_PX + max(moves) + 1) // _TILE_PX) + 1
        parts.append(slice(max(start, 0), max(stop, 0)))
    return parts[1], parts[0]


def _encode_layers(layers: Layers, low_px: float) -> dict[str, str]:
    """Return images and disparities of the layers as addresses, of less than `_MOST_BYTES` in total.

    The images have the best quality for which this holds, or else the lowest one.
    """
    thin_px = _thin(layers.behind_px)
    nearer_px = find_nearer_px(layers.front_px)
    depths = {
        "frontDepth": _address(_encode_disparity(layers.front_px, nearer_px, low_px)),
        "behindDepth": _address(_encode_disparity(thin_px, 0 * thin_px, low_px)),
    }
    for quality in _FRONT_QUALITIES:
        images = {
            "front": _address(layers.front, quality),
            "behind": _address(layers.behind, quality - _LOWER_QUALITY),
        }
        if sum(map(len, [*depths.values(), *images.values()])) < _MOST_BYTES:
            break
    return depths | images


def _thin(disparity_px: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h2 w2"]:
    """Return every second pixel; beside an edge, the nearer disparity.

    So the farther disparity never comes with the nearer surface's colour.
    """
    window = np.ones((_THINNING + 2, _THINNING + 2), np.uint8)
    around_px = cv2.dilate(disparity_px, window, anchor=(1, 1))
    thick_px = np.where(around_px - disparity_px > SAME_SURFACE_PX, around_px, disparity_px)
    return thick_px[::_THINNING, ::_THINNING]


def _encode_disparity(
    disparity_px: Float32[np.ndarray, "h w"], nearer_px: Float32[np.ndarray, "h w"], low_px: float
) -> UInt8[np.ndarray, "h w 3"]:
    levels = np.rint((disparity_px - low_px) / _STEP_PX).astype(np.int32)
    blue = np.clip(np.rint(nearer_px), 0, 255).astype(np.int32)
    return np.dstack([levels >> 8, levels & 255, blue]).astype(np.uint8)


def _address(image: UInt8[np.ndarray, "h w 3"], quality: int | None = None) -> str:
    """Return a data: address of a JPEG image of this quality, or of a lossless WebP image."""
    file = io.BytesIO()
    if quality is None:
        Image.fromarray(image).save(file, "WEBP", lossless=True, method=4)
    else:
        Image.fromarray(image).save(file, "JPEG", quality=quality, subsampling=0)
    kind = "webp" if quality is None else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(file.getvalue()).decode()}"
