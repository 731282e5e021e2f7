"""Picture metadata: orientation, focal length and baseline, from EXIF and the Multi-Picture Format."""

import io
import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from PIL import Image
from PIL.ExifTags import IFD, Base
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from stereoweave.errors import StereoweaveError

# Values by tag number, from EXIF and from CIPA DC-007, the Multi-Picture Format.
Tags = Mapping[int, Any]
_VIEWPOINT, _BASELINE = 0xB101, 0xB206
_UNKNOWN = 0xFFFFFFFF
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
# CIPA DCG-001: a "35 mm film" focal length has the same diagonal angle of view on 36 mm x 24 mm.
_FILM_DIAGONAL_MM = math.hypot(36, 24)
# Plausible focal lengths, in view diagonals: a fisheye lens has at least 0.15, a telescope up to 50.
_SHORTEST, _LONGEST = 0.1, 100
# Baselines of 3-D cameras that do not store them, from the makers' data sheets.
_BASELINES_M = {"FinePix REAL 3D W1": 0.077, "FinePix REAL 3D W3": 0.075, "Nintendo 3DS": 0.035}
_TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}


@dataclass(frozen=True, kw_only=True)
class Lens:
    """Focal length, baseline and convergence from a picture's metadata.

    Attributes:
        focal_px: Focal length in pixels of one view; None if unknown.
        principal_point_px: Column and row of the left view's principal point; None if unknown.
        baseline_m: Distance between the two lenses in metres; None if unknown.
        convergence_px: Disparity that the camera's maker shows in the plane of the screen; None if unknown.
        parallel: Whether the metadata states that both cameras look into the same direction.
        source: Where they are written, for notes.
    """

    focal_px: float | None = None
    principal_point_px: tuple[float, float] | None = None
    baseline_m: float | None = None
    convergence_px: float | None = None
    parallel: bool = False
    source: str = "EXIF"

    def __post_init__(self) -> None:
        for name, value in (("focal_px", self.focal_px), ("baseline_m", self.baseline_m)):
            if value is not None and not 0 < value < math.inf:
                raise StereoweaveError(f"{name} must be positive and finite, got {value}")

    @property
    def is_known(self) -> bool:
        """Whether any of the values is known."""
        return any(value is not None for value in (self.focal_px, self.baseline_m, self.convergence_px))


def read_tags(picture: Image.Image) -> Tags:
    """Read the tags of an open picture, or of an MPO file's current frame; damaged tags are left out."""
    # Pillow warns about each damaged tag.
    with warnings.catch_warnings(action="ignore"):
        return _read_exif_tags(picture) | _read_multi_picture_tags(picture.info.get("mp", b""))


def read_orientation(tags: Tags) -> int | None:
    """Return the EXIF orientation, from 1 (upright) to 8; None if missing or invalid."""
    value = tags.get(Base.Orientation)
    return value if value in (1, *_TURNS) else None


def turn_upright(picture: Image.Image, lies: int | None) -> Image.Image:
    """Turn a picture upright according to an EXIF orientation, which may come from another picture."""
    return picture.transpose(_TURNS[lies]) if lies in _TURNS else picture


def read_viewpoint(tags: Tags) -> int:
    """Return the viewpoint number of an MPO file's frame, counted from the left; 0 if missing."""
    value = tags.get(_VIEWPOINT)
    return value if isinstance(value, int) else 0


def read_lens(
    tags: Tags, width_px: int, height_px: int, *, stored_width_px: int | None = None
) -> Lens | None:
    """Return the focal length and the baseline for views of this size; None if the tags have neither.

    The views must show the camera's full image, at any scale; for a crop, the focal length would be wrong.
    `stored_width_px` is the width of the whole picture, as stored, if it holds both views.
    """
    focal_px = _find_focal_px(tags, width_px, height_px, stored_width_px or width_px)
    lens = Lens(focal_px=focal_px, baseline_m=_find_baseline_m(tags))
    return lens if lens.is_known else None


def take_plausible_focal_px(focal_px: Any, width_px: int, height_px: int) -> float | None:
    """Return a focal length if a lens can have it at this size of the picture; else None."""
    number, diagonal_px = _parse_positive(focal_px), math.hypot(width_px, height_px)
    return number if number and _SHORTEST < number / diagonal_px < _LONGEST else None


def _read_exif_tags(picture: Image.Image) -> dict[int, Any]:
    try:
        tags = picture.getexif()
        return dict(tags) | dict(tags.get_ifd(IFD.Exif))
    except Exception:  # damaged tags may raise any exception, as in `decoding._decoding`
        return {}


def _read_multi_picture_tags(content: bytes) -> dict[int, Any]:
    """Read the tags of a frame in an MPO file; for the first frame, these include those of the whole file."""
    tags: dict[int, Any] = {}
    try:
        directory = ImageFileDirectory_v2(content[:8])
        for _ in range(2):
            if directory.next:
                file = io.BytesIO(content)
                file.seek(directory.next)
                directory.load(file)
                tags |= dict(directory)
    except Exception:  # damaged tags may raise any exception
        return tags
    if getattr(tags.get(_BASELINE), "numerator", _UNKNOWN) == _UNKNOWN:
        tags.pop(_BASELINE, None)
    return tags


def _find_focal_px(tags: Tags, width_px: int, height_px: int, stored_width_px: int) -> float | None:
    diagonal_px = math.hypot(width_px, height_px)
    lengths_px = (
        _find_focal_on_film_px(tags, diagonal_px),
        _find_focal_on_sensor_px(tags, width_px, stored_width_px),
    )
    plausible = (take_plausible_focal_px(px, width_px, height_px) for px in lengths_px)
    return next((px for px in plausible if px), None)


def _find_focal_on_film_px(tags: Tags, diagonal_px: float) -> float | None:
    of_film_mm = _parse_positive(tags.get(Base.FocalLengthIn35mmFilm))
    return of_film_mm / _FILM_DIAGONAL_MM * diagonal_px if of_film_mm else None


def _find_focal_on_sensor_px(tags: Tags, width_px: int, stored_width_px: int) -> float | None:
    focal_mm, density = (
        _parse_positive(tags.get(Base.FocalLength)),
        _parse_positive(tags.get(Base.FocalPlaneXResolution)),
    )
    taken_px = _parse_positive(tags.get(Base.ExifImageWidth))
    unit_mm = _UNIT_MM.get(tags.get(Base.FocalPlaneResolutionUnit, 2))
    if focal_mm and density and taken_px and unit_mm:
        # Cameras write the width of the whole picture, programs that join two pictures also that of one.
        scale = 1 if taken_px == width_px else stored_width_px / taken_px
        return focal_mm * density / unit_mm * scale
    return None


def _find_baseline_m(tags: Tags) -> float | None:
    model = str(tags.get(Base.Model, "")).strip("\0 ")
    return _parse_positive(tags.get(_BASELINE)) or _BASELINES_M.get(model)


def _parse_positive(value: Any) -> float | None:
    """Return a tag's value if it is a positive number; None if it is 0, which means unknown, or invalid."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if 0 < number < math.inf else None
