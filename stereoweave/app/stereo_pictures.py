"""3-D pictures of a matched pair to download: layouts, animations and the depth map."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from stereoweave.cameras.rectify import crop
from stereoweave.io.animation import write_animation
from stereoweave.io.images import write_image
from stereoweave.outputs.report import downscale
from stereoweave.rendering.layouts import (
    ANIMATIONS,
    LAYOUTS,
    LayoutOptions,
    add_mark,
    median_disparity_px,
    render_views,
    write_picture,
)
from stereoweave.rendering.renderer import Renderer
from stereoweave.stereo import Estimate, StereoCamera, StereoPair

# GIF files of larger animations are too large for most messengers.
_ANIMATED_PX = 800
_PREVIEW_PX = 1280
_DEPTH_MAP = "depth_map"


@dataclass(frozen=True)
class Kind:
    """A kind of 3-D picture: its label, how to look at it, and its file extension."""

    label: str
    viewing: str
    ending: str


# By the layout's or the animation's name, or a name of our own; MPO and JPS hold layouts of their own.
KINDS: dict[str, Kind] = {
    "anaglyph_dubois": Kind(
        "Anaglyph (red-cyan glasses)",
        "Look through red-cyan glasses, red on the left eye. The best colours.",
        ".jpg",
    ),
    "wiggle": Kind(
        "Wiggle (moves by itself)",
        "Shows depth without glasses, in any program that shows GIF files.",
        ".gif",
    ),
    "side_by_side": Kind(
        "Side by side (VR headset)",
        "For VR headsets, 3-D viewers and parallel viewing: the left eye's view is on the left.",
        ".jpg",
    ),
    "crossed": Kind(
        "Crossed (without glasses)", "Cross your eyes until the two pictures become one.", ".jpg"
    ),
    "mpo": Kind("MPO (3-D camera)", "The file of 3-D cameras with both views, for 3-D televisions.", ".mpo"),
    _DEPTH_MAP: Kind("Depth map", "White is near, black is far. For image editors and 3-D photos.", ".png"),
    "rgbd": Kind(
        "Picture beside its depth map", "For programs and displays that read colour with depth.", ".jpg"
    ),
    "quilt": Kind("Quilt (Looking Glass)", "48 views in one picture, for Looking Glass displays.", ".jpg"),
    "sweep": Kind("Sweep (moves slowly)", "A smooth ride from the left camera to the right one.", ".webp"),
    "side_by_side_half": Kind(
        "Side by side, half width (3-D television)",
        "The television stretches each half to full width.",
        ".jpg",
    ),
    "top_bottom": Kind(
        "Top and bottom (VR headset)", "For VR headsets: the left eye's view is on top.", ".jpg"
    ),
    "top_bottom_half": Kind(
        "Top and bottom, half height (3-D television)",
        "The television stretches each half to full height.",
        ".jpg",
    ),
    "anaglyph_half_colour": Kind(
        "Anaglyph, half colour", "For red-cyan glasses. Less flicker on red and blue things.", ".jpg"
    ),
    "anaglyph_colour": Kind("Anaglyph, full colour", "For red-cyan glasses. Red things may flicker.", ".jpg"),
    "anaglyph_grey": Kind("Anaglyph, grey", "For red-cyan glasses, without colours that flicker.", ".jpg"),
    "jps": Kind("JPS (3-D viewer)", "A JPEG file with both views, for 3-D picture viewers.", ".jps"),
    "contact_sheet": Kind("Contact sheet", "Nine small views from left to right, to compare them.", ".jpg"),
}
# The layouts that these two file formats hold.
_HELD = {"mpo": "side_by_side", "jps": "crossed"}


@dataclass(frozen=True)
class StereoPicture:
    """A written 3-D picture, and a file that a browser shows."""

    file: Path
    shown: Path


def write_stereo_picture(
    pair: StereoPair, estimate: Estimate, kind: str, folder: Path, report: Callable[[float, str], None]
) -> StereoPicture:
    """Write one of the `KINDS` and a preview of it to a folder, without the borders of an aligned pair."""
    report(0.1, "preparing")
    pair, estimate = crop_both(pair, estimate)
    file = folder / f"{'picture' if kind in _HELD else kind}{KINDS[kind].ending}"
    report(0.3, "drawing")
    if kind in ANIMATIONS:
        motion = ANIMATIONS[kind]
        renderer = _make_renderer(*downscale(pair, estimate, _ANIMATED_PX), converged=motion.converged)
        write_animation(file, render_views(renderer, motion.positions), motion.frame_ms)
        return StereoPicture(file, file)
    if kind == _DEPTH_MAP:
        both = LAYOUTS["rgbd"].compose(_make_renderer(pair, estimate), LayoutOptions())
        picture = both[:, pair.left.shape[1] :]
    else:
        layout = _HELD.get(kind, kind)
        file = add_mark(file, layout, pair, LayoutOptions())
        renderer = _make_renderer(pair, estimate, converged=LAYOUTS[layout].converged)
        picture = LAYOUTS[layout].compose(renderer, LayoutOptions())
    report(0.8, "writing")
    write_picture(file, picture)
    shown = folder / f"{kind}_preview.jpg"
    write_image(shown, _shrink(picture))
    return StereoPicture(file, shown)


def _make_renderer(pair: StereoPair, estimate: Estimate, *, converged: bool = False) -> Renderer:
    return Renderer(pair, estimate, convergence_px=median_disparity_px(estimate) if converged else 0.0)


def crop_both(pair: StereoPair, estimate: Estimate) -> tuple[StereoPair, Estimate]:
    """Crop a pair and its estimate to the largest rectangle that both pictures cover; drop the camera.

    Raises:
        StereoweaveError: No pixel is valid in both pictures.
    """
    # A camera whose centre is the first pixel tells where the rectangle begins.
    cropped = crop(replace(pair, camera=StereoCamera(focal_px=1, baseline_m=1, cx_px=0, cy_px=0)))
    assert cropped.camera is not None
    top, left = round(-cropped.camera.cy_px), round(-cropped.camera.cx_px)
    height, width = cropped.left.shape[:2]
    part = np.s_[top : top + height, left : left + width]
    return replace(cropped, camera=None), Estimate(
        disparity_px=estimate.disparity_px[part],
        right_disparity_px=estimate.right_disparity_px[part],
        confidence=estimate.confidence[part],
        occluded=estimate.occluded[part],
    )


def _shrink(picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    scale = min(1.0, _PREVIEW_PX / max(picture.shape))
    size = tuple(max(1, round(scale * side)) for side in picture.shape[1::-1])
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
