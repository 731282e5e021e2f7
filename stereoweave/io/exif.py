"""What cameras write beside their pixels: which way is up, the focal length, the distance of two lenses."""

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

# Tags by their numbers, those of EXIF and those of CIPA DC-007, the Multi-Picture Format.
Tags = Mapping[int, Any]
_VIEWPOINT, _BASELINE = 0xB101, 0xB206
_UNKNOWN = 0xFFFFFFFF
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
# CIPA DCG-001: a focal length "in 35 mm film" is one of the same diagonal angle on 36 mm x 24 mm.
_FILM_DIAGONAL_MM = math.hypot(36, 24)
# Shares of a view's diagonal: a fisheye lens has 0.15 and more, a telescope up to 50. Else the tag is wrong.
_SHORTEST, _LONGEST = 0.1, 100
# Of 3-D cameras that do not write it down, by the makers' data sheets.
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
    """What a picture's tags say of the cameras; None for what they do not say.

    Attributes:
        focal_px: The focal length in pixels of one view.
        baseline_m: The distance of the two lenses in metres.
    """

    focal_px: float | None = None
    baseline_m: float | None = None

    def __post_init__(self) -> None:
        for name, value in (("focal_px", self.focal_px), ("baseline_m", self.baseline_m)):
            if value is not None and not 0 < value < math.inf:
                raise StereoweaveError(f"{name} must be positive and finite, got {value}")


def read_tags(picture: Image.Image) -> Tags:
    """The tags of an opened picture, of an MPO file those of the frame at hand; damaged ones are left out."""
    # Pillow warns about each tag that it leaves out.
    with warnings.catch_warnings(action="ignore"):
        return _exif_tags(picture) | _multi_picture_tags(picture.info.get("mp", b""))


def orientation(tags: Tags) -> int | None:
    """EXIF's 1 to 8 for how the picture lies, 1 is upright; None where it does not say."""
    value = tags.get(Base.Orientation)
    return value if value in (1, *_TURNS) else None


def turned(picture: Image.Image, lies: int | None) -> Image.Image:
    """The picture upright, which lies as an `orientation` says."""
    return picture.transpose(_TURNS[lies]) if lies in _TURNS else picture


def viewpoint(tags: Tags) -> int:
    """The number of a frame of an MPO file, of which cameras count from the left; 0 where it does not say."""
    value = tags.get(_VIEWPOINT)
    return value if isinstance(value, int) else 0


def lens_of(tags: Tags, width_px: int, height_px: int) -> Lens | None:
    """What the tags say of the cameras, for views of this size; None where they say nothing.

    The views have to show what the camera saw, at whatever scale: a cut-out has a wrong focal length.
    """
    lens = Lens(focal_px=_focal_px(tags, width_px, height_px), baseline_m=_baseline_m(tags))
    return None if lens == Lens() else lens


def _exif_tags(picture: Image.Image) -> dict[int, Any]:
    try:
        tags = picture.getexif()
        return dict(tags) | dict(tags.get_ifd(IFD.Exif))
    except Exception:  # whatever Pillow raises of damaged ones, as in `picture_files`
        return {}


def _multi_picture_tags(content: bytes) -> dict[int, Any]:
    """The tags of a frame of an MPO file: those of the file, where the frame is its first, and its own."""
    tags: dict[int, Any] = {}
    try:
        directory = ImageFileDirectory_v2(content[:8])
        for _ in range(2):
            if directory.next:
                file = io.BytesIO(content)
                file.seek(directory.next)
                directory.load(file)
                tags |= dict(directory)
    except Exception:  # likewise
        return tags
    if getattr(tags.get(_BASELINE), "numerator", _UNKNOWN) == _UNKNOWN:
        tags.pop(_BASELINE, None)
    return tags


def _focal_px(tags: Tags, width_px: int, height_px: int) -> float | None:
    diagonal_px = math.hypot(width_px, height_px)
    lengths_px = (
        _focal_on_film_px(tags, diagonal_px),
        _focal_on_sensor_px(tags, width_px),
    )
    return next((px for px in lengths_px if px and _SHORTEST < px / diagonal_px < _LONGEST), None)


def _focal_on_film_px(tags: Tags, diagonal_px: float) -> float | None:
    of_film_mm = _positive(tags.get(Base.FocalLengthIn35mmFilm))
    return of_film_mm / _FILM_DIAGONAL_MM * diagonal_px if of_film_mm else None


def _focal_on_sensor_px(tags: Tags, width_px: int) -> float | None:
    focal_mm, density = _positive(tags.get(Base.FocalLength)), _positive(tags.get(Base.FocalPlaneXResolution))
    taken_px = _positive(tags.get(Base.ExifImageWidth))
    unit_mm = _UNIT_MM.get(tags.get(Base.FocalPlaneResolutionUnit, 2))
    if focal_mm and density and taken_px and unit_mm:
        return focal_mm * density / unit_mm * width_px / taken_px
    return None


def _baseline_m(tags: Tags) -> float | None:
    model = str(tags.get(Base.Model, "")).strip("\0 ")
    return _positive(tags.get(_BASELINE)) or _BASELINES_M.get(model)


def _positive(value: Any) -> float | None:
    """The number of a tag; None for 0, which says that it is not known, and for what is no number."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if 0 < number < math.inf else None
