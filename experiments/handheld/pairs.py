"""Simulated hand-held pairs: rectified pairs of known disparity, retaken by two simulated cameras."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from experiments.handheld.cameras import HandheldCamera, Ranges, Size, draw_cameras, expose, store
from stereoweave.data.readers import list_scenes
from stereoweave.stereo import StereoPair

# Seed and ranges were fixed before any method of alignment was tuned. Change neither.
SEED, RANGES = 20260, Ranges()
PAIRS_EACH = 100
# Rendered originals: scene and number of pairs.
SCENES = {"rooms": 50, "street": 20, "bridge": 10, "refinery": 10, "ship": 10}
_RENDERED_PX = Size(800, 600)
# True correspondences are sampled on a grid, away from disparity edges.
_GRID_PX = 8
_SMOOTH_PX = 1.0
_OCCLUSION_PX = 1.0


@dataclass(frozen=True, kw_only=True)
class Original:
    """A rectified pair of known disparity.

    Attributes:
        name: Name of the scene.
        pair: The left and the right image.
        truth_px: float32 [H, W], disparity of the left view; NaN where unknown.
        focal_px: Focal length in pixels.
    """

    name: str
    pair: StereoPair
    truth_px: Float32[np.ndarray, "h w"]
    focal_px: float


@dataclass(frozen=True, kw_only=True)
class HandheldPair:
    """A pair taken by two hand-held cameras.

    Attributes:
        name: Name of the original, followed by the number of the pair.
        pair: The two pictures, which have the same size.
        left_px, right_px: float64 [N, 2], places at which the two pictures show the same point of the scene.
    """

    name: str
    pair: StereoPair
    left_px: Float[np.ndarray, "n 2"]
    right_px: Float[np.ndarray, "n 2"]


def make_handheld_pairs(real: Path, step: int = 1) -> Iterator[HandheldPair]:
    """Yield pairs made from rendered originals, then pairs made from each real pair of a folder in turn.

    Args:
        real: Folder of real pairs.
        step: Distance between the pairs that are made; a pair is the same for any step.
    """
    scenes = list_scenes(real)
    for index, original in render_originals(step):
        yield take_again(original, index)
    for index in range(PAIRS_EACH, 2 * PAIRS_EACH, step):
        scene = scenes[(index - PAIRS_EACH) % len(scenes)]()
        # Any focal length fits a rectified pair of unknown depth; this one is typical of a phone.
        focal_px = float(scene.pair.left.shape[1])
        original = Original(name=scene.name, pair=scene.pair, truth_px=scene.truth_px, focal_px=focal_px)
        yield take_again(original, index)


def take_again(original: Original, index: int, ranges: Ranges = RANGES) -> HandheldPair:
    """Retake a rectified pair with two hand-held cameras.

    Args:
        original: The rectified pair.
        index: Number of the pair; together with the seed, it determines all random numbers.
        ranges: Ranges of the random parameters.
    """
    rng = np.random.default_rng((SEED, index))
    cameras = draw_cameras(rng, ranges, original.pair.left.shape[1], original.focal_px)
    return take_with(cameras, original, index, rng, ranges)


def take_with(
    cameras: tuple[HandheldCamera, HandheldCamera],
    original: Original,
    index: int,
    rng: np.random.Generator,
    ranges: Ranges,
) -> HandheldPair:
    """Retake a rectified pair with these two cameras; see `take_again`."""
    before = Size(original.pair.left.shape[1], original.pair.left.shape[0])
    size = _find_size(cameras, before)
    left, right = (
        _take(camera, image, size, before)
        for camera, image in zip(cameras, (original.pair.left, original.pair.right), strict=True)
    )
    right = expose(rng, ranges, right)
    left_px, right_px = _find_correspondences(cameras, original.truth_px, size)
    return HandheldPair(
        name=f"{original.name}-{index:03d}",
        pair=StereoPair(left=store(rng, ranges, left), right=store(rng, ranges, right)),
        left_px=left_px,
        right_px=right_px,
    )


def render_originals(step: int = 1) -> Iterator[tuple[int, Original]]:
    """Yield the numbers and the originals of the rendered pairs at this distance from each other."""
    from stereoweave.synth.sets.pair_rendering import RenderSpec, render_pair
    from stereoweave.synth.sets.renderers import shared_renderer

    numbered = [(scene, index) for scene, count in SCENES.items() for index in range(count)]
    for number in range(0, len(numbered), step):
        scene, index = numbered[number]
        spec = RenderSpec(scene=scene, seed=SEED, size_px=_RENDERED_PX)
        sample = render_pair(shared_renderer(), spec, index).sample
        assert sample.camera is not None
        yield (
            number,
            Original(
                name=scene,
                pair=StereoPair(left=sample.left, right=sample.right),
                truth_px=sample.disparity_px,
                focal_px=sample.camera.focal_px,
            ),
        )


def _find_size(cameras: tuple[HandheldCamera, HandheldCamera], original: Size) -> Size:
    """Return the largest size with the original's proportions at which both cameras see only the original."""
    last_px = np.array(original) - 1
    for percent in range(100, 0, -1):
        size = Size(original.width * percent // 100, original.height * percent // 100)
        border_px = _border(size)
        sources_px = np.concatenate([camera.find_sources(border_px, size, original) for camera in cameras])
        if (sources_px >= 0).all() and (sources_px <= last_px).all():
            return size
    raise AssertionError("the ranges leave nothing of the picture")


def _border(size: Size) -> Float[np.ndarray, "n 2"]:
    shares = np.linspace(0, 1, 33)
    zeros, ones = np.zeros_like(shares), np.ones_like(shares)
    columns = np.concatenate([shares, shares, zeros, ones])
    rows = np.concatenate([zeros, ones, shares, shares])
    return np.column_stack([columns, rows]) * (np.array(size) - 1)


def _take(
    camera: HandheldCamera, image: UInt8[np.ndarray, "h w 3"], size: Size, original: Size
) -> UInt8[np.ndarray, "h2 w2 3"]:
    rows, columns = np.mgrid[: size.height, : size.width]
    places_px = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
    sources_px = camera.find_sources(places_px, size, original).astype(np.float32)
    x, y = (sources_px[:, axis].reshape(rows.shape) for axis in (0, 1))
    return cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def _find_correspondences(
    cameras: tuple[HandheldCamera, HandheldCamera], truth_px: Float32[np.ndarray, "h w"], size: Size
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Return the places at which the two hand-held pictures show the points that both cameras see."""
    original = Size(truth_px.shape[1], truth_px.shape[0])
    rows, columns = np.nonzero(_find_visible(truth_px))
    on_grid = (rows % _GRID_PX == 0) & (columns % _GRID_PX == 0)
    rows, columns = rows[on_grid], columns[on_grid]
    sources_px = np.column_stack([columns, rows]).astype(np.float64)
    matches_px = np.column_stack([columns - truth_px[rows, columns], rows]).astype(np.float64)
    left_px, right_px = (
        camera.find_places(places_px, size, original)
        for camera, places_px in zip(cameras, (sources_px, matches_px), strict=True)
    )
    both_px = np.hstack([left_px, right_px])
    inside = ((both_px >= 0) & (both_px <= np.tile(size, 2) - 1)).all(1)
    return left_px[inside], right_px[inside]


def _find_visible(truth_px: Float32[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the mask of left pixels on smooth surfaces of known disparity that the right camera sees."""
    known = np.where(np.isfinite(truth_px), truth_px, np.float32(1e6))
    window = np.ones((3, 3), np.uint8)
    smooth = cv2.dilate(known, window) - cv2.erode(known, window) < _SMOOTH_PX
    width = truth_px.shape[1]
    rows, columns = np.nonzero(np.isfinite(truth_px))
    disparity_px = truth_px[rows, columns]
    matches = np.rint(columns - disparity_px).astype(int)
    inside = (matches >= 0) & (matches < width)
    nearest_px = np.full(truth_px.shape, -np.inf, np.float32)
    np.maximum.at(nearest_px, (rows[inside], matches[inside]), disparity_px[inside])
    visible = np.zeros(truth_px.shape, bool)
    visible[rows[inside], columns[inside]] = (
        disparity_px[inside] >= nearest_px[rows[inside], matches[inside]] - _OCCLUSION_PX
    )
    return visible & smooth
