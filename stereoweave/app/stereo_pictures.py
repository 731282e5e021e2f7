"""3-D pictures of a matched pair to download: layouts, animations, the 3-D photo and the depth map."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from stereoweave.cameras.content import crop, find_content
from stereoweave.io.images import write_image
from stereoweave.outputs.run import Result
from stereoweave.outputs.view_files import ViewFile, can_crop
from stereoweave.rendering.layouts import ANIMATIONS, LAYOUTS, VIEWER, LayoutOptions, is_converged
from stereoweave.rendering.renderer import Renderer
from stereoweave.rendering.scaling import fit_size, scale_down
from stereoweave.stereo import Estimate, StereoPair

# Larger GIF files are too large for most messengers.
_ANIMATED_PX = 800
_PREVIEW_PX = 1280
_DEPTH_MAP, _VIEW = "depth_map", "view"
AUTOMATIC_PX = 0
FULL_PX = 32_766
"""The longest side that a picture can have."""


@dataclass(frozen=True)
class Kind:
    """A kind of 3-D picture: its label, how to look at it, and its file extension."""

    label: str
    viewing: str
    ending: str


# By the layout's name, or a name of our own.
KINDS: dict[str, Kind] = {
    VIEWER: Kind(
        "3-D photo (to send)",
        "Moves with the mouse, a finger or by itself. Send the file: any browser opens it, offline too.",
        ".html",
    ),
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
    _VIEW: Kind(
        "View from the slider's place",
        "An ordinary picture, from the viewpoint that the slider under “View” shows.",
        ".jpg",
    ),
    "crossed": Kind(
        "Crossed (without glasses)", "Cross your eyes until the two pictures become one.", ".jpg"
    ),
    "mpo": Kind("MPO (3-D camera)", "The file of 3-D cameras with both views, for 3-D televisions.", ".mpo"),
    _DEPTH_MAP: Kind(
        "Depth map",
        "White is near, black is far. For image editors, and for sites that make pictures move.",
        ".png",
    ),
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
# The layouts of the kinds that are named otherwise; None is a single view.
_LAYOUTS = {"mpo": "side_by_side", "jps": "crossed", _VIEW: None}


@dataclass(frozen=True, kw_only=True)
class Wish:
    """A 3-D picture that a visitor wants.

    Attributes:
        kind: One of `KINDS`.
        longer_side_px: Longest side of each view; `AUTOMATIC_PX` suits the kind.
        crops: Whether to cut off borders, where the kind allows it.
        position: Viewpoint of a single view.
    """

    kind: str
    longer_side_px: int = AUTOMATIC_PX
    crops: bool = False
    position: float = 0.5

    @property
    def can_crop(self) -> bool:
        """Whether the kind has borders to cut off."""
        return self.kind != _DEPTH_MAP and can_crop(_LAYOUTS.get(self.kind, self.kind))

    def plain(self) -> "Wish":
        """Return the same wish without what its kind does not use: equal wishes make equal pictures."""
        position = self.position if self.kind == _VIEW else 0.5
        return replace(self, crops=self.crops and self.can_crop, position=position)

    @property
    def size_px(self) -> tuple[int, int]:
        """Largest width and height of each view."""
        automatic_px = _ANIMATED_PX if self.kind in ANIMATIONS else FULL_PX
        side_px = self.longer_side_px or automatic_px
        return side_px, side_px


@dataclass(frozen=True)
class StereoPicture:
    """A written 3-D picture, and a file that a browser shows."""

    file: Path
    shown: Path


def write_stereo_picture(
    wish: Wish, result: Result, folder: Path, report: Callable[[float, str], None]
) -> StereoPicture:
    """Write a 3-D picture and a preview of it to a folder, without the borders of an aligned pair."""
    report(0.1, "preparing")
    folder.mkdir(exist_ok=True)
    pair, estimate = crop_both(result.pair, result.estimate)
    pictures = [Path(name) for name in result.summary.pictures]
    file = folder / f"{pictures[0].stem}_{wish.kind}{KINDS[wish.kind].ending}"
    report(0.3, "drawing")
    if wish.kind == _DEPTH_MAP:
        image: UInt8[np.ndarray, "h w 3"] | None = _write_depth_map(file, pair, estimate, wish.size_px)
    else:
        view_file = _make_view_file(wish, file).add_mark(pair)
        file, image = view_file.path, view_file.write(pair, estimate, pictures).image
    if image is None:
        return StereoPicture(file, file)
    shown = folder / "preview.jpg"
    size_px = fit_size(image.shape, (_PREVIEW_PX, _PREVIEW_PX))
    write_image(shown, cv2.resize(image, size_px, interpolation=cv2.INTER_AREA))
    return StereoPicture(file, shown)


def _make_view_file(wish: Wish, file: Path) -> ViewFile:
    name = _LAYOUTS.get(wish.kind, wish.kind)
    return ViewFile(
        path=file,
        name=name,
        position=wish.position,
        convergence_px=None if is_converged(name) else 0.0,
        size_px=wish.size_px,
        crops=wish.crops,
    )


def _write_depth_map(
    file: Path, pair: StereoPair, estimate: Estimate, size_px: tuple[int, int]
) -> UInt8[np.ndarray, "h w 3"]:
    """Write and return the disparity in grey, where white is near."""
    pair, estimate = scale_down(pair, estimate, fit_size(pair.left.shape, size_px))
    both = LAYOUTS["rgbd"].compose(Renderer(pair, estimate), LayoutOptions())
    image = np.ascontiguousarray(both[:, pair.left.shape[1] :])
    write_image(file, image)
    return image


def crop_both(pair: StereoPair, estimate: Estimate) -> tuple[StereoPair, Estimate]:
    """Crop a pair and its estimate to the largest rectangle that both pictures cover.

    Raises:
        StereoweaveError: No pixel is valid in both pictures.
    """
    part = find_content(pair)
    return crop(pair), Estimate(
        disparity_px=estimate.disparity_px[part],
        right_disparity_px=estimate.right_disparity_px[part],
        confidence=estimate.confidence[part],
        occluded=estimate.occluded[part],
    )
