"""Output layouts for 3-D viewers and displays, and animations.

A layout composes one image, uint8 RGB, from the views of a `Renderer`; in a video, every frame is such an
image. An animation is a sequence of views. The left eye is at the renderer's position 0 and the right eye at
position 1; the renderer's strength and convergence apply.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from jaxtyping import Num, UInt8
from PIL import Image

from stereoweave.arguments import check_choice
from stereoweave.errors import Remedy, StereoweaveError
from stereoweave.io.animation import check_animation_ending
from stereoweave.io.colormap import find_colour_range_px
from stereoweave.io.images import picture_kind, save_encoded, write_image
from stereoweave.io.spatial_photos import write_spatial_photo
from stereoweave.io.vr180_photos import is_vr180_name
from stereoweave.rendering.floating_windows import cut_windows
from stereoweave.rendering.renderer import Renderer, check_position
from stereoweave.stereo import Estimate, StereoCamera, StereoPair

# Viewers of a quilt move their heads much farther than the cameras are apart, so a quilt needs a wide range
# of positions. The outer views may consist mostly of filled holes, but are seen least.
_FAN = (-0.5, 1.5)
# Side of the largest quilt that Looking Glass recommends (for its 32-inch and 65-inch displays).
_QUILT_SIDE_PX = 8192
_MOST_VIEWS = 200
# .webp is a picture or an animation.
_MOVING_ENDINGS = (".mp4", ".gif")
_SHEET_SIDE = 3

# Luma of Rec. 601, as in JPEG and OpenCV.
_GREY = (0.299, 0.587, 0.114)
_RED, _GREEN, _BLUE = np.eye(3)
_NOTHING = (0.0, 0.0, 0.0)
# Red-cyan anaglyphs: 3x3 RGB matrices for the left and for the right view; the two products are added.
_ANAGLYPHS = {
    "grey": ([_GREY, _NOTHING, _NOTHING], [_NOTHING, _GREY, _GREY]),
    "colour": ([_RED, _NOTHING, _NOTHING], [_NOTHING, _GREEN, _BLUE]),
    "half_colour": ([_GREY, _NOTHING, _NOTHING], [_NOTHING, _GREEN, _BLUE]),
    # E. Dubois, "Conversion of a Stereo Pair to Anaglyph with the Least-Squares Projection Method", 2009;
    # method in ICASSP 2001. The matrices are derived for linear light. Like most programs and Dubois's own
    # Photoshop recipe, we apply them to the stored values.
    "dubois": (
        [
            (0.456100, 0.500484, 0.176381),
            (-0.0400822, -0.0378246, -0.0157589),
            (-0.0152161, -0.0205971, -0.00546856),
        ],
        [
            (-0.0434706, -0.0879388, -0.00155529),
            (0.378476, 0.73364, -0.0184503),
            (-0.0721527, -0.112961, 1.2264),
        ],
    ),
}


@dataclass(frozen=True, kw_only=True)
class LayoutOptions:
    """Options of a layout.

    Attributes:
        columns, rows: Number of columns and rows of views in a quilt.
        range_px: Disparities shown as black and as white in rgbd; default: the image's own range. A video
            uses one range for all frames, to avoid flicker.
        windows_px: Widths of the floating windows at the left and at the right border (`floating_windows`),
            in layouts of two views.
    """

    columns: int = 8
    rows: int = 6
    range_px: tuple[float, float] | None = None
    windows_px: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 1 or not 2 <= self.columns * self.rows <= _MOST_VIEWS:
            raise StereoweaveError(
                f"expected columns and rows for 2 to {_MOST_VIEWS} views, "
                f"got {self.columns}x{self.rows}; displays use 5x9, 8x6, 7x7 or 11x6",
                setting="quilt",
            )
        if self.range_px is not None and not -math.inf < self.range_px[0] < self.range_px[1] < math.inf:
            raise StereoweaveError(
                f"expected two disparities in px, the lower one first, got {self.range_px}",
                setting="range_px",
            )


Eye: TypeAlias = Num[np.ndarray, "_ _ 3"]
"""View of one eye, or both arranged in one image: RGB, uint8, or float32 from 0 to 255."""


@dataclass(frozen=True, kw_only=True)
class Layout:
    """A way to compose one image from several views.

    Attributes:
        compose: Function that returns the image, uint8 RGB.
        join: Function that arranges the views of the left and the right eye in the image; None if the layout
            shows others, or mixes them.
        positions: Outermost positions of the layout's views.
        converged: Whether views are overlaid or compared in place, so the middle of the scene should have no
            parallax.
        mark: File name suffix by which viewers detect the layout.
        squeezed: For a layout of views at half width or height: the layout that gives its image from a pair
            that is squeezed already (`squeeze`), and the axis of the squeezing.
    """

    compose: Callable[[Renderer, LayoutOptions], np.ndarray]
    join: Callable[[Eye, Eye], Eye] | None = None
    positions: tuple[float, ...] = (0.0, 1.0)
    converged: bool = False
    mark: str = ""
    squeezed: tuple[str, int] | None = None


@dataclass(frozen=True, kw_only=True)
class Animation:
    """A loop of views.

    Attributes:
        positions: Positions of the frames of one turn.
        frame_ms: Duration of a frame; a multiple of 10, the unit of GIF.
        mp4_turns: Number of turns in an MP4 file, which players do not loop.
        converged: See `Layout`.
    """

    positions: tuple[float, ...]
    frame_ms: int
    mp4_turns: int
    converged: bool = True

    def turns(self, path: str | Path) -> int:
        """Return the number of turns to write to a file, according to its extension."""
        return self.mp4_turns if check_animation_ending(path) == ".mp4" else 1


def render_views(renderer: Renderer, positions: Iterable[float]) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Lazily render the views from these positions as uint8 RGB [H, W, 3]."""
    return (renderer.view(position).image for position in positions)


def join_side_by_side(left: Eye, right: Eye) -> Eye:
    """Return both eyes' views side by side at full width, with the left eye's on the left."""
    return np.hstack([left, right])


def join_side_by_side_half(left: Eye, right: Eye) -> Eye:
    """Return both eyes' views side by side, each at half width, with the left eye's on the left.

    If the width is odd, the last column is repeated.
    """
    return np.hstack([squeeze(eye, axis=1) for eye in (left, right)])


def join_crossed(left: Eye, right: Eye) -> Eye:
    """Return both eyes' views side by side, with the right eye's on the left, for cross-eyed viewing."""
    return np.hstack([right, left])


def join_top_bottom(left: Eye, right: Eye) -> Eye:
    """Return both eyes' views one above the other at full height, with the left eye's on top."""
    return np.vstack([left, right])


def join_top_bottom_half(left: Eye, right: Eye) -> Eye:
    """Return both eyes' views one above the other, each at half height, with the left eye's on top.

    If the height is odd, the last row is repeated.
    """
    return np.vstack([squeeze(eye, axis=0) for eye in (left, right)])


def make_anaglyph(kind: str) -> Callable[[Eye, Eye], Eye]:
    """Return the function that mixes both eyes' views in a red-cyan anaglyph, with red for the left eye.

    `kind` is a key of `_ANAGLYPHS`.
    """
    shares = [np.array(matrix, np.float32) for matrix in _ANAGLYPHS[kind]]

    def mix(left: Eye, right: Eye) -> Eye:
        red, cyan = (
            cv2.transform(eye.astype(np.float32), matrix)
            for eye, matrix in zip((left, right), shares, strict=True)
        )
        # Round and clip only the sum, not each eye's part.
        return cv2.add(red, cyan, dtype=cv2.CV_8U)

    return mix


def rgbd(renderer: Renderer, choices: LayoutOptions) -> UInt8[np.ndarray, "h w 3"]:
    """Return the left image beside its disparity as a grey image of the same size, where white is near.

    Strength and convergence have no effect, because RGB-D displays render the views themselves.
    """
    disparity_px = renderer.estimate.disparity_px
    low_px, high_px = choices.range_px or find_colour_range_px(disparity_px)
    share = np.clip((disparity_px - low_px) / (high_px - low_px), 0, 1)
    grey = np.rint(255 * share).astype(np.uint8)
    return np.hstack([renderer.pair.left, cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB)])


def quilt(renderer: Renderer, choices: LayoutOptions) -> UInt8[np.ndarray, "h w 3"]:
    """Return a quilt: views in rows, ordered from the bottom left to the top right.

    Views are scaled down if a side of the quilt would exceed 8192 px. Source: Looking Glass's definition of a
    quilt.
    """
    height, width = renderer.pair.left.shape[:2]
    columns, rows = choices.columns, choices.rows
    smaller = max(1.0, columns * width / _QUILT_SIDE_PX, rows * height / _QUILT_SIDE_PX)
    return _join_tiles(_render_tiles(renderer, columns, rows, smaller)[::-1])


def contact_sheet(renderer: Renderer, choices: LayoutOptions) -> UInt8[np.ndarray, "h w 3"]:
    """Return nine views from positions -0.5 to 1.5 in reading order, each at a third of its size."""
    return _join_tiles(_render_tiles(renderer, _SHEET_SIDE, _SHEET_SIDE, _SHEET_SIDE))


def _compose_eyes(join: Callable[[Eye, Eye], Eye]) -> Callable[[Renderer, LayoutOptions], Eye]:
    """Return the `compose` function of a layout that shows the views of both eyes and nothing else."""

    def compose(renderer: Renderer, choices: LayoutOptions) -> Eye:
        left, right = render_views(renderer, (0.0, 1.0))
        return join(*cut_windows((left, right), choices.windows_px))

    return compose


def _arrange(join: Callable[[Eye, Eye], Eye], **rest: Any) -> Layout:
    return Layout(compose=_compose_eyes(join), join=join, **rest)


def _swing_positions(count: int) -> tuple[float, ...]:
    """Return `count` positions from 0 to 1 and back along a cosine, which is slow at both ends."""
    return tuple((0.5 - 0.5 * np.cos(2 * np.pi * np.arange(count) / count)).tolist())


# VR players detect LR, TB and half in file names. The marks of full and crossed layouts follow iw3, the most
# widely used conversion tool; the mark of a quilt follows Looking Glass.
LAYOUTS: dict[str, Layout] = {
    "side_by_side": _arrange(join_side_by_side, mark="_LRF_Full_SBS"),
    "side_by_side_half": _arrange(join_side_by_side_half, mark="_half_LR", squeezed=("side_by_side", 1)),
    "crossed": _arrange(join_crossed, mark="_RLF_cross"),
    "top_bottom": _arrange(join_top_bottom, mark="_TBF_fulltb"),
    "top_bottom_half": _arrange(join_top_bottom_half, mark="_half_TB", squeezed=("top_bottom", 0)),
    **{
        f"anaglyph_{kind}": Layout(compose=_compose_eyes(make_anaglyph(kind)), converged=True)
        for kind in _ANAGLYPHS
    },
    "rgbd": Layout(compose=rgbd, positions=(), mark="_RGBD"),
    "quilt": Layout(compose=quilt, positions=_FAN, converged=True, mark="_qs{columns}x{rows}a{aspect:g}"),
    "contact_sheet": Layout(compose=contact_sheet, positions=_FAN, converged=True),
}
ANIMATIONS: dict[str, Animation] = {
    "sweep": Animation(positions=_swing_positions(80), frame_ms=40, mp4_turns=1),
    "wiggle": Animation(positions=_swing_positions(12), frame_ms=60, mp4_turns=5),
}
VIEWER = "viewer"
"""The layout of a page that shows the scene in 3-D (`outputs/viewer.py`)."""
# Layouts that are determined by the file extension.
_LAYOUT_BY_ENDING = {".mpo": "side_by_side", ".heic": "side_by_side", ".jps": "crossed", ".html": VIEWER}
_HOLD_TWO_PICTURES = (".mpo", ".heic")
# No chroma subsampling, because stereo pictures are magnified and compared by both eyes.
_FINE = {"quality": 95, "subsampling": 0}
# The JPEG marker APP3, the segment's length, the identifier, the length of the next four bytes, these four
# bytes (separation 0, right eye first, side by side and stereo) and the length of an empty comment. Source:
# ExifTool's table of JPS tags.
_JPS_SEGMENT = b"\xff\xe3\x00\x12_JPSJPS_\x00\x04\x00\x00\x02\x01\x00\x00"


def choose_layout(path: str | Path, name: str | None) -> str | None:
    """Return the layout of an output file, given by name or by the file extension; None for a single view.

    Raises:
        StereoweaveError: The layout is unknown or does not match the file extension.
    """
    if name is not None:
        check_choice("layout", name, [*LAYOUTS, *ANIMATIONS, VIEWER])
    ending = Path(path).suffix.lower()
    held = _LAYOUT_BY_ENDING.get(ending)
    if held is not None:
        if name not in (None, held):
            raise StereoweaveError(f"{path}: expected the layout {held} for this extension, found {name}")
        return held
    if name == VIEWER:
        raise StereoweaveError(
            f"{path}: expected the file extension .html for the layout viewer, "
            f"found {Path(path).suffix or 'none'}"
        )
    if name is None and ending in _MOVING_ENDINGS:
        raise StereoweaveError(
            f"{path}: expected an animation for this extension, found a single view",
            remedy=Remedy(f"choose {' or '.join(ANIMATIONS)}", ("layout",)),
        )
    if name in ANIMATIONS:
        check_animation_ending(path)
    else:
        _check_picture_ending(path, name)
    return name


def _check_picture_ending(path: str | Path, name: str | None) -> None:
    """Raise a StereoweaveError unless a picture has this extension; without a layout, it names the others."""
    try:
        picture_kind(path)
    except StereoweaveError as error:
        if name is not None:
            raise
        others = f"3-D pictures have {', '.join(_LAYOUT_BY_ENDING)}"
        moving = f"{' and '.join(ANIMATIONS)} {', '.join(_MOVING_ENDINGS)}"
        raise error.with_detail(f"{others}; {moving}") from error


def has_two_views(name: str | None) -> bool:
    """Return whether a layout shows the views of two eyes, which may have floating windows."""
    return name in LAYOUTS and LAYOUTS[name].positions == (0.0, 1.0)


def check_shows_depth(name: str | None) -> None:
    """Raise a StereoweaveError if a layout does not show several views at once, which a screen needs."""
    if name not in LAYOUTS or not LAYOUTS[name].positions:
        raise StereoweaveError(
            f"expected only with a layout of several views, found with {name or 'a single view'}",
            setting="screen",
            remedy=Remedy("choose one, such as side_by_side or anaglyph_dubois", ("layout",)),
        )


def is_converged(name: str | None) -> bool:
    """Return whether the middle of the scene has no parallax by default in a layout; see `Layout`."""
    return name == VIEWER or name in ANIMATIONS or (name in LAYOUTS and LAYOUTS[name].converged)


def check_positions(positions: Iterable[float], strength: float) -> None:
    """Raise a StereoweaveError if a view cannot be rendered from one of these positions at this strength."""
    for position in positions:
        check_position(position, strength=strength)


def median_disparity_px(estimate: Estimate) -> float:
    """Return the confidence-weighted median disparity in px, which is taken as the middle of the scene."""
    # Weights are positive, so that even a pair with a confidence of 0 everywhere has a median.
    weights = np.maximum(estimate.confidence, 1e-6)
    return float(np.quantile(estimate.disparity_px, 0.5, weights=weights, method="inverted_cdf"))


def add_mark(path: str | Path, name: str, pair: StereoPair, choices: LayoutOptions) -> Path:
    """Return a path whose file name ends in the suffix by which viewers detect the layout.

    A quilt's suffix gives the numbers of columns and rows and the aspect ratio of one view, as in
    view_qs8x6a0.75.png. An .mpo, .heic or .jps file and a VR180 photo need no suffix.
    """
    path = Path(path)
    if path.suffix.lower() in _LAYOUT_BY_ENDING or is_vr180_name(path):
        return path
    height, width = pair.left.shape[:2]
    aspect = round(width / height, 3)
    mark = LAYOUTS[name].mark.format(columns=choices.columns, rows=choices.rows, aspect=aspect)
    return path if path.stem.endswith(mark) else path.with_stem(path.stem + mark)


def write_picture(
    path: str | Path, picture: UInt8[np.ndarray, "h w 3"], camera: StereoCamera | None = None
) -> None:
    """Write a layout's image in the format given by the file extension.

    An .mpo file, the format of 3-D cameras, stores the two halves of a `side_by_side` image as separate
    pictures, with the left eye's first. So does a .heic file, a spatial photo, with their `camera`. A .jps
    file is a JPEG of a `crossed` image with a JPS header.
    """
    ending = Path(path).suffix.lower()
    if ending not in _LAYOUT_BY_ENDING:
        write_image(path, picture)
        return
    if ending == ".heic":
        left, right = np.split(picture, 2, axis=1)
        write_spatial_photo(Path(path), left, right, camera)
        return
    if ending == ".jps":
        save_encoded(path, Image.fromarray(picture), "JPEG", extra=_JPS_SEGMENT, **_FINE)
        return
    first, second = (Image.fromarray(half) for half in np.split(picture, 2, axis=1))
    save_encoded(path, first, "MPO", save_all=True, append_images=[second], **_FINE)


def describe_picture(path: str | Path, name: str, picture: UInt8[np.ndarray, "h w 3"]) -> str:
    """Describe what `write_picture` writes: the layout and its size, or the two pictures in the file."""
    height_px, width_px = picture.shape[:2]
    if Path(path).suffix.lower() in _HOLD_TWO_PICTURES:
        return f"two pictures of {width_px // 2}x{height_px} px in one file"
    return f"{name}, {width_px}x{height_px} px"


def squeeze(eye: Num[np.ndarray, "h w 3"], axis: int) -> Num[np.ndarray, "h2 w2 3"]:
    """Squeeze an image to half its size along an axis by averaging neighbouring pixels.

    If the side along this axis is odd, the last row or column is repeated.
    """
    odd = [(0, side % 2 * (index == axis)) for index, side in enumerate(eye.shape)]
    even = np.pad(eye, odd, "edge")
    height, width = even.shape[:2]
    size = (width, height // 2) if axis == 0 else (width // 2, height)
    return cv2.resize(even, size, interpolation=cv2.INTER_AREA)


def _render_tiles(
    renderer: Renderer, columns: int, rows: int, smaller: float
) -> UInt8[np.ndarray, "rows h columns w 3"]:
    """Render evenly spaced views as tiles in reading order, each scaled down by the factor `smaller`."""
    height, width = (max(1, int(side / smaller)) for side in renderer.pair.left.shape[:2])
    tiles = np.empty((rows, height, columns, width, 3), np.uint8)
    for index, view in enumerate(render_views(renderer, np.linspace(*_FAN, rows * columns).tolist())):
        row, column = divmod(index, columns)
        tiles[row, :, column] = cv2.resize(view, (width, height), interpolation=cv2.INTER_AREA)
    return tiles


def _join_tiles(tiles: UInt8[np.ndarray, "rows h columns w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Join the tiles into one image."""
    rows, height, columns, width, _ = tiles.shape
    return tiles.reshape(rows * height, columns * width, 3)
