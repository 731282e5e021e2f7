"""Layouts: views of a pair as 3-D viewers and displays take them, and as pictures that move.

A layout makes one picture, uint8 RGB, of a `Renderer`, so that a film can do the same for each of its frames;
a motion is a row of views. The two eyes are the positions 0 and 1 of the renderer, whose strength and
convergence they keep to.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from stereoweave.errors import StereoweaveError
from stereoweave.io.animation import check_animation_ending
from stereoweave.io.colormap import find_colour_range_px
from stereoweave.io.files import checking_format_size, picture_kind, replacing, write_image
from stereoweave.rendering.renderer import FIRST_POSITION, LAST_POSITION, Renderer
from stereoweave.stereo import Estimate, StereoPair

# A quilt's viewers move their heads much farther than a pair's cameras are apart, so they ask for a wide fan
# of views; the outer ones, which are seen least, may be the ones that were mostly invented.
_FAN = (-0.5, 1.5)
# The largest quilt that the maker of the displays asks for (its 32 inch and 65 inch ones).
_QUILT_SIDE_PX = 8192
_MOST_VIEWS = 200
_SHEET_SIDE = 3

# Rec. 601's luma, as JPEG and OpenCV count it.
_GREY = (0.299, 0.587, 0.114)
_RED, _GREEN, _BLUE = np.eye(3)
_NOTHING = (0.0, 0.0, 0.0)
# Red, green and blue of a red-cyan anaglyph, each as shares of the left picture's three and the right one's.
_ANAGLYPHS = {
    "grey": ([_GREY, _NOTHING, _NOTHING], [_NOTHING, _GREY, _GREY]),
    "colour": ([_RED, _NOTHING, _NOTHING], [_NOTHING, _GREEN, _BLUE]),
    "half_colour": ([_GREY, _NOTHING, _NOTHING], [_NOTHING, _GREEN, _BLUE]),
    # E. Dubois, "Conversion of a Stereo Pair to Anaglyph with the Least-Squares Projection Method", 2009; the
    # method: ICASSP 2001. It is one for linear light; like most programs, and like his own recipe for
    # Photoshop, this applies the matrices to the stored values.
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
    """What can be chosen about a layout.

    Attributes:
        columns, rows: How many views a quilt has in a row, and in a column.
        range_px: The disparities that rgbd shows as black and as white; a picture's own unless given.
            A film has one for all its frames, so that it does not flicker.
    """

    columns: int = 8
    rows: int = 6
    range_px: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 1 or not 2 <= self.columns * self.rows <= _MOST_VIEWS:
            raise StereoweaveError(
                f"quilt: expected columns and rows of 2 to {_MOST_VIEWS} views, "
                f"got {self.columns}x{self.rows}; the displays' are 5x9, 8x6, 7x7 and 11x6"
            )
        if self.range_px is not None and not -math.inf < self.range_px[0] < self.range_px[1] < math.inf:
            raise StereoweaveError(
                f"expected two disparities in px, the lower one first, got {self.range_px}",
                setting="range_px",
            )


@dataclass(frozen=True, kw_only=True)
class Layout:
    """A way to make one picture of several views.

    Attributes:
        compose: The picture, uint8 RGB.
        positions: The ends of what it takes its views from.
        converged: Whether the views lie upon one another, so that the scene's middle should stay in place.
        mark: What its viewers look for in the name of a file.
    """

    compose: Callable[[Renderer, LayoutOptions], np.ndarray]
    positions: tuple[float, ...] = (0.0, 1.0)
    converged: bool = False
    mark: str = ""


@dataclass(frozen=True, kw_only=True)
class Animation:
    """Views one after another, which begin anew where they end.

    Attributes:
        positions: Of each frame of one turn.
        frame_ms: How long each is shown; a multiple of 10, in which GIF counts.
        mp4_turns: How often an MP4 shows them, which players do not repeat by themselves.
    """

    positions: tuple[float, ...]
    frame_ms: int
    mp4_turns: int
    converged: bool = True

    def turns(self, path: str | Path) -> int:
        """How many turns a file of that name shows."""
        return self.mp4_turns if check_animation_ending(path) == ".mp4" else 1


def render_views(renderer: Renderer, positions: Iterable[float]) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """The views from these positions, uint8 RGB [H, W, 3], each rendered when it is asked for."""
    return (renderer.view(position).image for position in positions)


def side_by_side(renderer: Renderer, choices: LayoutOptions) -> UInt8[np.ndarray, "h w 3"]:
    """Both eyes' pictures, the left one on the left: twice the width."""
    return np.hstack(_render_eyes(renderer))


def side_by_side_half(renderer: Renderer, choices: LayoutOptions) -> UInt8[np.ndarray, "h w 3"]:
    """As `side_by_side`, each picture at half its width; of an odd one the last column is repeated."""
    return np.hstack([_halve(eye, axis=1) for eye in _render_eyes(renderer)])


def crossed(renderer: Renderer, choices: LayoutOptions) -> UInt8[np.ndarray, "h w 3"]:
    """Both eyes' pictures, the right one on the left, to be seen with crossed eyes."""
    return np.hstack(_render_eyes(renderer)[::-1])


def top_bottom(renderer: Renderer, choices: LayoutOptions) -> UInt8[np.ndarray, "h w 3"]:
    """Both eyes' pictures, the left one above: twice the height."""
    return np.vstack(_render_eyes(renderer))


def top_bottom_half(renderer: Renderer, choices: LayoutOptions) -> UInt8[np.ndarray, "h w 3"]:
    """As `top_bottom`, each picture at half its height; of an odd one the last row is repeated."""
    return np.vstack([_halve(eye, axis=0) for eye in _render_eyes(renderer)])


def make_anaglyph(kind: str) -> Callable[[Renderer, LayoutOptions], np.ndarray]:
    """A layout for glasses whose left glass is red, the right one cyan; by the name of its matrices."""
    shares = [np.array(matrix, np.float32) for matrix in _ANAGLYPHS[kind]]

    def compose(renderer: Renderer, choices: LayoutOptions) -> UInt8[np.ndarray, "h w 3"]:
        left, right = (
            cv2.transform(eye.astype(np.float32), matrix)
            for eye, matrix in zip(_render_eyes(renderer), shares, strict=True)
        )
        # Rounds and cuts off the sum, as each eye's share alone must not be.
        return cv2.add(left, right, dtype=cv2.CV_8U)

    return compose


def rgbd(renderer: Renderer, choices: LayoutOptions) -> UInt8[np.ndarray, "h w 3"]:
    """The left photograph, and beside it its disparity in grey, near is white: twice the width.

    Displays that take colour and depth make views of their own, so strength and convergence are theirs.
    """
    disparity_px = renderer.estimate.disparity_px
    low_px, high_px = choices.range_px or find_colour_range_px(disparity_px)
    share = np.clip((disparity_px - low_px) / (high_px - low_px), 0, 1)
    grey = np.rint(255 * share).astype(np.uint8)
    return np.hstack([renderer.pair.left, cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB)])


def quilt(renderer: Renderer, choices: LayoutOptions) -> UInt8[np.ndarray, "h w 3"]:
    """Views from left to right in rows, the first at the bottom left, the last at the top right.

    Source: Looking Glass's definition of a quilt. Views are made smaller where the quilt would have a side
    above 8192 px.
    """
    height, width = renderer.pair.left.shape[:2]
    columns, rows = choices.columns, choices.rows
    smaller = max(1.0, columns * width / _QUILT_SIDE_PX, rows * height / _QUILT_SIDE_PX)
    return _join_tiles(_render_tiles(renderer, columns, rows, smaller)[::-1])


def contact_sheet(renderer: Renderer, choices: LayoutOptions) -> UInt8[np.ndarray, "h w 3"]:
    """Nine views from -0.5 to 1.5, in the order of reading, each at a third of its size."""
    return _join_tiles(_render_tiles(renderer, _SHEET_SIDE, _SHEET_SIDE, _SHEET_SIDE))


def _swing(count: int) -> tuple[float, ...]:
    """Positions from 0 to 1 and back, slow at both ends, as a pendulum swings."""
    return tuple((0.5 - 0.5 * np.cos(2 * np.pi * np.arange(count) / count)).tolist())


# The marks are those that VR players look for (LR, TB, half), in the words of iw3, the most used conversion
# tool, where they are full or crossed; of a quilt Looking Glass's.
LAYOUTS: dict[str, Layout] = {
    "side_by_side": Layout(compose=side_by_side, mark="_LRF_Full_SBS"),
    "side_by_side_half": Layout(compose=side_by_side_half, mark="_half_LR"),
    "crossed": Layout(compose=crossed, mark="_RLF_cross"),
    "top_bottom": Layout(compose=top_bottom, mark="_TBF_fulltb"),
    "top_bottom_half": Layout(compose=top_bottom_half, mark="_half_TB"),
    "anaglyph_grey": Layout(compose=make_anaglyph("grey"), converged=True),
    "anaglyph_colour": Layout(compose=make_anaglyph("colour"), converged=True),
    "anaglyph_half_colour": Layout(compose=make_anaglyph("half_colour"), converged=True),
    "anaglyph_dubois": Layout(compose=make_anaglyph("dubois"), converged=True),
    "rgbd": Layout(compose=rgbd, positions=(), mark="_RGBD"),
    "quilt": Layout(compose=quilt, positions=_FAN, converged=True, mark="_qs{columns}x{rows}a{aspect:g}"),
    "contact_sheet": Layout(compose=contact_sheet, positions=_FAN, converged=True),
}
ANIMATIONS: dict[str, Animation] = {
    "sweep": Animation(positions=_swing(80), frame_ms=40, mp4_turns=1),
    "wiggle": Animation(positions=_swing(12), frame_ms=60, mp4_turns=5),
}
# What a file of such an ending holds, whether its layout is named or not.
_LAYOUT_BY_ENDING = {".mpo": "side_by_side", ".jps": "crossed"}
# Colour at full resolution, which JPEG halves else, for what is enlarged and compared by two eyes.
_FINE = {"quality": 95, "subsampling": 0}
# JPEG's marker APP3 and its length; the name; the length of the four bytes that follow: separation 0, the
# right eye's picture first, side by side, stereo; no comment. Source: ExifTool's table of JPS tags.
_JPS_SEGMENT = b"\xff\xe3\x00\x12_JPSJPS_\x00\x04\x00\x00\x02\x01\x00\x00"


def choose_layout(path: str | Path, name: str | None) -> str | None:
    """The layout for a file, by its name or by its ending; None for a single view.

    Raises:
        StereoweaveError: An unknown layout, or a file whose ending does not fit it.
    """
    if name is not None and name not in LAYOUTS | ANIMATIONS:
        raise StereoweaveError(
            f"expected one of {', '.join([*LAYOUTS, *ANIMATIONS])}, found {name!r}", setting="layout"
        )
    ending = Path(path).suffix.lower()
    held = _LAYOUT_BY_ENDING.get(ending)
    if held is not None:
        if name not in (None, held):
            raise StereoweaveError(
                f"{path}: expected the layout {held} in a file of this ending, found {name}"
            )
        return held
    if name in ANIMATIONS:
        check_animation_ending(path)
    else:
        picture_kind(path)
    return name


def check_positions(positions: Iterable[float], strength: float) -> None:
    """Raise a StereoweaveError unless there can be views from all these positions at that strength."""
    for position in positions:
        seen_from = 0.5 + strength * (position - 0.5)
        if not FIRST_POSITION <= seen_from <= LAST_POSITION:
            by_strength = "" if strength == 1 else f", where strength {strength:g} takes {position:g}"
            raise StereoweaveError(
                f"expected {FIRST_POSITION:g} to {LAST_POSITION:g} (0 left camera, 1 right), "
                f"got {seen_from:g}{by_strength}",
                setting="position",
            )


def median_disparity_px(estimate: Estimate) -> float:
    """The disparity of the scene's middle in px: the median, each pixel weighted by its confidence."""
    # Not 0, so that a pair without any confidence has a middle too.
    weights = np.maximum(estimate.confidence, 1e-6)
    return float(np.quantile(estimate.disparity_px, 0.5, weights=weights, method="inverted_cdf"))


def add_mark(path: str | Path, name: str, pair: StereoPair, choices: LayoutOptions) -> Path:
    """The path, with the mark in its name by which viewers know the layout; as it is where it has it already.

    A quilt's says columns, rows, and width / height of one view: view_qs8x6a0.75.png. An .mpo or .jps file is
    known by its ending.
    """
    path = Path(path)
    if path.suffix.lower() in _LAYOUT_BY_ENDING:
        return path
    height, width = pair.left.shape[:2]
    aspect = round(width / height, 3)
    mark = LAYOUTS[name].mark.format(columns=choices.columns, rows=choices.rows, aspect=aspect)
    return path if path.stem.endswith(mark) else path.with_stem(path.stem + mark)


def write_picture(path: str | Path, picture: UInt8[np.ndarray, "h w 3"]) -> None:
    """Writes a layout's picture as the name's ending asks for.

    In an .mpo file, which 3-D cameras write, the halves of `side_by_side` become two pictures, the left eye's
    first; a .jps file is a JPEG of `crossed` that says so.
    """
    ending = Path(path).suffix.lower()
    if ending not in _LAYOUT_BY_ENDING:
        write_image(path, picture)
        return
    with replacing(path) as temporary, checking_format_size(path, picture.shape):
        if ending == ".jps":
            Image.fromarray(picture).save(temporary, "JPEG", extra=_JPS_SEGMENT, **_FINE)
        else:
            left, right = (Image.fromarray(half) for half in np.split(picture, 2, axis=1))
            left.save(temporary, "MPO", save_all=True, append_images=[right], **_FINE)


def _render_eyes(renderer: Renderer) -> list[UInt8[np.ndarray, "h w 3"]]:
    """The left eye's picture and the right one's."""
    return list(render_views(renderer, (0.0, 1.0)))


def _halve(eye: UInt8[np.ndarray, "h w 3"], axis: int) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Means of two neighbours along an axis; the last of an odd number is a mean with itself."""
    odd = [(0, side % 2 * (index == axis)) for index, side in enumerate(eye.shape)]
    even = np.pad(eye, odd, "edge")
    height, width = even.shape[:2]
    size = (width, height // 2) if axis == 0 else (width // 2, height)
    return cv2.resize(even, size, interpolation=cv2.INTER_AREA)


def _render_tiles(
    renderer: Renderer, columns: int, rows: int, smaller: float
) -> UInt8[np.ndarray, "rows h columns w 3"]:
    """Views along the fan, so many times smaller, in the order of reading."""
    height, width = (max(1, int(side / smaller)) for side in renderer.pair.left.shape[:2])
    tiles = np.empty((rows, height, columns, width, 3), np.uint8)
    for index, view in enumerate(render_views(renderer, np.linspace(*_FAN, rows * columns).tolist())):
        row, column = divmod(index, columns)
        tiles[row, :, column] = cv2.resize(view, (width, height), interpolation=cv2.INTER_AREA)
    return tiles


def _join_tiles(tiles: UInt8[np.ndarray, "rows h columns w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    """The tiles as one picture."""
    rows, height, columns, width, _ = tiles.shape
    return tiles.reshape(rows * height, columns * width, 3)
