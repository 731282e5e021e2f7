"""Contact sheets with one row per scene, and quizzes of unlabelled images."""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console

from stereoweave.io.colormap import OCCLUDED_RGB, colour_disparity, find_colour_range_px
from stereoweave.stereo import Sample
from stereoweave.synth.sets.pair_rendering import RenderSpec, SceneRenderer, render_pair
from stereoweave.system.progress import progress

COLUMNS = ("left", "right", "depth", "occluded, left", "occluded, right")
_TILE_PX = 320, 240
_LABEL_PX = 20


def contact_sheet(
    renderer: SceneRenderer, scenes: Sequence[str], seed: int, index: int = 0
) -> UInt8[np.ndarray, "h w 3"]:
    """Render pair `index` of each scene into one row: images, depth (red is near) and occlusion masks."""
    rows = [np.hstack([_draw_label(text) for text in COLUMNS])]
    for scene, sample in _render_samples(renderer, [(scene, index) for scene in scenes], seed):
        tiles = [_shrink(picture) for picture in _row_of_pictures(sample)]
        rows += [_draw_label(f"{scene} {index}", len(tiles) * _TILE_PX[0]), np.hstack(tiles)]
    return np.vstack(rows)


def quiz_sheet(
    renderer: SceneRenderer, scenes: Sequence[str], seed: int, pictures: int = 16
) -> tuple[UInt8[np.ndarray, "h w 3"], list[str]]:
    """Render unlabelled left images in random order, four per row; return the sheet and the scene names.

    The names are in the order of the images, row by row.
    """
    order = np.random.default_rng(seed).permutation(
        [scenes[place % len(scenes)] for place in range(pictures)]
    )
    names = order.tolist()
    numbered = [(name, place) for place, name in enumerate(names)]
    tiles = [_shrink(sample.left) for _, sample in _render_samples(renderer, numbered, seed)]
    tiles += [np.zeros_like(tiles[0])] * (-pictures % 4)
    return np.vstack([np.hstack(tiles[start : start + 4]) for start in range(0, len(tiles), 4)]), names


def _render_samples(
    renderer: SceneRenderer, pairs: Sequence[tuple[str, int]], seed: int
) -> Iterator[tuple[str, Sample]]:
    """Yield the scene and sample of each pair while showing a progress bar."""
    with progress(Console()) as bar:
        shown = bar.add_task("rendering pairs", total=len(pairs), loss="", rate="")
        for scene, index in pairs:
            yield scene, render_pair(renderer, RenderSpec(scene=scene, seed=seed), index).sample
            bar.advance(shown)


def _row_of_pictures(sample: Sample) -> list[UInt8[np.ndarray, "h w 3"]]:
    depth = colour_disparity(sample.disparity_px, find_colour_range_px(sample.disparity_px))
    left, right = (
        _overlay_mask(sample.left, sample.occluded),
        _overlay_mask(sample.right, sample.right_occluded),
    )
    return [sample.left, sample.right, depth, left, right]


def _overlay_mask(
    image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the image in dark grey with the mask in orange."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) // 2
    return np.where(mask[..., None], np.array(OCCLUDED_RGB, np.uint8), grey[..., None])


def _shrink(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "240 320 3"]:
    return cv2.resize(image, _TILE_PX, interpolation=cv2.INTER_AREA)


def _draw_label(text: str, width_px: int = _TILE_PX[0]) -> UInt8[np.ndarray, "h w 3"]:
    strip = Image.new("RGB", (width_px, _LABEL_PX), "white")
    ImageDraw.Draw(strip).text((6, 2), text, fill="black", font=ImageFont.load_default(14))
    return np.array(strip)
