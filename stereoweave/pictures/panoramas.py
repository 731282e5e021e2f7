"""VR180 and 360-degree pictures: their projection, the right eye in metadata, and windows of both eyes."""

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Shaped

from stereoweave.cameras.sphere_remap import Cutter, Spreader
from stereoweave.cameras.sphere_windows import (
    ArcWindow,
    CylinderWindow,
    PerspectiveWindow,
    StripWindow,
    Window,
    make_whole_window,
    make_window,
)
from stereoweave.cameras.spherical import (
    EQUIRECTANGULAR,
    FISHEYE,
    HALF,
    RECTILINEAR,
    Projection,
    SphereRequest,
    describe_projection,
)
from stereoweave.errors import FormatError, Note, Remedy, StereoweaveError
from stereoweave.io import vr180
from stereoweave.io.decoding import DecodedPicture, decode_embedded, measure_embedded
from stereoweave.pictures.pair_layouts import PAIR_LAYOUTS
from stereoweave.stereo import StereoPair

_OVERRIDE = Remedy("rectilinear is an ordinary picture", ("projection",))
# Words by which players of VR files know them: the projection, and the aspect ratio of each eye's image.
_WORDS_IN_NAMES = {
    "vr180": (HALF, 1.0),
    "180x180": (HALF, 1.0),
    "180": (HALF, 1.0),
    "360": (EQUIRECTANGULAR, 2.0),
    "360x180": (EQUIRECTANGULAR, 2.0),
    "vr360": (EQUIRECTANGULAR, 2.0),
}
_ASPECT_TOLERANCE = 0.01
_DEFAULT_FOV_DEG = 90.0
NO_SPHERE: dict[str, object] = dict.fromkeys(("projection", "look_deg", "fov_deg", "lens_fov_deg", "whole"))
"""`SphereView.settings` of an ordinary file."""


class SphereView(NamedTuple):
    """What is shown of a VR180 or 360-degree file: a window of both eyes' images, and their projection.

    `settings` are those that lead to it, by keyword, as JSON values; defaults are filled in.
    """

    window: Window
    projection: Projection
    eye_size_px: tuple[int, int]
    settings: dict[str, object]

    @classmethod
    def chosen(
        cls, projection: Projection, eye_size_px: tuple[int, int], request: SphereRequest
    ) -> "SphereView":
        """Return the view that the user asks for. Raises StereoweaveError if there is none."""
        settings: dict[str, object] = NO_SPHERE | {"projection": projection.name}
        if projection.name == FISHEYE:
            settings["lens_fov_deg"] = projection.lens_fov_deg
        if request.whole:
            window = make_whole_window(projection, eye_size_px)
            return cls(window, projection, eye_size_px, settings | {"whole": True})
        look_deg = request.look_deg or (0.0, 0.0)
        fov_deg = _DEFAULT_FOV_DEG if request.fov_deg is None else request.fov_deg
        settings |= {"look_deg": "{:.15g},{:.15g}".format(*look_deg), "fov_deg": fov_deg}
        return cls(make_window(projection, eye_size_px, look_deg, fov_deg), projection, eye_size_px, settings)

    def cutter(self) -> Cutter:
        """Return the cutter of both eyes' images."""
        return Cutter(self.projection, self.eye_size_px, self.window)

    @property
    def is_flat(self) -> bool:
        """Whether the window is a perspective image."""
        return isinstance(self.window, PerspectiveWindow)

    @property
    def is_whole(self) -> bool:
        """Whether the window shows all directions."""
        return isinstance(self.window, ArcWindow | StripWindow)

    @property
    def whole_projection(self) -> Projection:
        """Projection of results for the whole field of view."""
        return Projection.named(EQUIRECTANGULAR if self.projection.turns else HALF)

    @property
    def whole_size_px(self) -> tuple[int, int]:
        """Width and height of results for the whole field of view."""
        height_px = self.window.size_px[1]
        return (2 * height_px if self.projection.turns else height_px), height_px

    def spreader(self) -> Spreader:
        """Return the spreader of the window's images over results for the whole field of view."""
        return Spreader(self.window, self.whole_projection, self.whole_size_px)

    def note(self, request: SphereRequest, why: str) -> Note:
        """Return a note on what is shown."""
        width_px, height_px = self.window.size_px
        yaw_deg, pitch_deg = request.look_deg or (0.0, 0.0)
        part = (
            "the whole field of view" if request.whole else f"a window at {yaw_deg:g},{pitch_deg:g} degrees"
        )
        bent = " on a cylinder" if isinstance(self.window, CylinderWindow) else ""
        kind = f"{describe_projection(self.projection)}{why}"
        return Note(f"{kind}; shown: {part}{bent}, {width_px}x{height_px} px", _OVERRIDE)


def read_projection(path: Path, xmp: bytes, eye_size_px: tuple[int, int]) -> Projection | None:
    """Return the projection that a picture's XMP states for its image; None if it is no panorama.

    Raises:
        FormatError: See `vr180.read_panorama`; or the angles are impossible; or it lacks them, and the image
            fits no projection.
    """
    found = vr180.read_panorama(path, xmp)
    if found is None:
        return None
    if found.width_deg is None or found.pitch_deg is None:
        return find_by_aspect(path, eye_size_px)
    width_deg = min(found.width_deg, 360.0)
    # Of a crop, the middle is straight ahead: the rest is the heading of the camera.
    half_deg = width_deg / 2
    name = HALF if width_deg <= 180 else EQUIRECTANGULAR
    try:
        return Projection(name=name, yaw_deg=(-half_deg, half_deg), pitch_deg=found.pitch_deg)
    except StereoweaveError as error:
        raise FormatError(
            f"{path}: {error.message}, according to its metadata",
            remedy=Remedy("choose its projection", ("projection",)),
        ) from error


def guess_projection(name: str, eye_size_px: tuple[int, int]) -> Projection | None:
    """Return the projection that a file's name states, if the eyes' images have its aspect ratio."""
    aspect = eye_size_px[0] / eye_size_px[1]
    for word in re.split(r"[^a-z0-9]+", Path(name).name.lower()):
        kind, expected = _WORDS_IN_NAMES.get(word, ("", 0.0))
        if kind and abs(aspect / expected - 1) < _ASPECT_TOLERANCE:
            return Projection.named(kind)
    return None


def choose_layout(
    layout: str, name: str | None, frame_size_px: tuple[int, int], request: SphereRequest
) -> str:
    """Return the layout at full size, instead of half, for two equirectangular images in one frame.

    Their angles are shares of width and height, whatever their ratio; enlarging them would add no detail. And
    a VR180 film of square views looks like one of views at half width.

    Args:
        layout: The layout found, a name in `PAIR_LAYOUTS`.
        name: Name of the file, which may state a projection; None if the file itself declares one.
        frame_size_px: Width and height of the frame.
        request: What the user asks for.
    """
    full = layout.removesuffix("_half")
    if request.projection is not None:
        return layout if request.projection in (RECTILINEAR, FISHEYE) else full
    if name is None or full == layout:
        return full
    return full if guess_projection(name, PAIR_LAYOUTS[full].eye_size_px(*frame_size_px)) else layout


def read_right_eye(path: Path, picture: Any, xmp: bytes) -> DecodedPicture | None:
    """Return the right eye's picture of an open VR180 photo; None for other pictures.

    Raises:
        FormatError: It is missing or damaged.
    """
    content = vr180.read_right_eye(path, picture, xmp)
    return None if content is None else decode_embedded(_name_right_eye(path), content)


def measure_right_eye(path: Path, picture: Any, xmp: bytes) -> tuple[int, int] | None:
    """Return the size in pixels of what `read_right_eye` returns, without decoding it. Raises FormatError."""
    content = vr180.read_right_eye(path, picture, xmp)
    return None if content is None else measure_embedded(_name_right_eye(path), content)


def _name_right_eye(path: Path) -> str:
    return f"{path} (right eye)"


def cut_pair(pair: StereoPair, view: SphereView) -> StereoPair:
    """Return the window of both eyes' images, with masks of what they show."""
    cutter = view.cutter()
    left, right = (cutter.cut(image) for image in (pair.left, pair.right))
    return StereoPair(left=left, right=right, left_seen=cutter.seen, right_seen=cutter.seen)


def find_by_aspect(path: Path, eye_size_px: tuple[int, int]) -> Projection:
    """Return the projection of 180x180 or 360x180 degrees that fits an image's aspect ratio."""
    aspect = eye_size_px[0] / eye_size_px[1]
    for name, expected in ((HALF, 1.0), (EQUIRECTANGULAR, 2.0)):
        if abs(aspect / expected - 1) < _ASPECT_TOLERANCE:
            return Projection.named(name)
    raise FormatError(
        f"{path}: expected a panorama whose metadata tells its angles, or of 180x180 or 360x180 degrees, "
        f"found {eye_size_px[0]}x{eye_size_px[1]} px without them",
        remedy=Remedy("choose its projection", ("projection",)),
    )


# Layouts whose views are equirectangular again, each with its columns and rows of views.
WHOLE_LAYOUTS = {
    "side_by_side": (2, 1),
    "crossed": (2, 1),
    "top_bottom": (1, 2),
    "anaglyph_grey": (1, 1),
    "anaglyph_colour": (1, 1),
    "anaglyph_half_colour": (1, 1),
    "anaglyph_dubois": (1, 1),
}


def check_whole_layout(name: str | None) -> None:
    """Raise a StereoweaveError for a layout that cannot show the whole field of view; None is one view."""
    if name not in (None, *WHOLE_LAYOUTS):
        raise StereoweaveError(
            f"expected one of {', '.join(WHOLE_LAYOUTS)} for the whole field of view, found {name}",
            setting="layout",
        )


def spread_views(
    spreader: Spreader, image: Shaped[np.ndarray, "h w *c"], layout: str | None
) -> Shaped[np.ndarray, "h2 w2 *c"]:
    """Return a layout's image with each view spread over an equirectangular image."""
    columns, rows = WHOLE_LAYOUTS.get(layout or "", (1, 1))
    bands = [np.split(band, columns, axis=1) for band in np.split(image, rows, axis=0)]
    spread = [[spreader.spread(np.ascontiguousarray(part)) for part in parts] for parts in bands]
    return np.vstack([np.hstack(parts) for parts in spread])
