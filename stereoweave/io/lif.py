"""Leia's image format (LIF): a JPEG whose end holds further views, and what the file says about its cameras.

Such a file ends in a table of fields, each with a type, a length and content, the table's length and the mark
1E1A. A field of type 7 or 8 describes the views in JSON; the fields that it names hold their pictures, and -1
is the JPEG itself. Leia publishes no specification of the bytes: they are those that its own readers in
JavaScript parse (versions 4 to 5.3), and that B. Costa's dump of a tablet's photograph shows
(github.com/Bill-Costa/Multi-Image-JPEG-Splitter).
"""

import json
import math
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from stereoweave.errors import FormatError, Remedy
from stereoweave.io.exif import Lens, take_plausible_focal_px

_MARK = b"\x1e\x1a"
_END_BYTES = 6  # the table's length and the mark
_DESCRIPTIONS = (8, 7)  # types of fields, the newer one first
_THE_FILE = -1
_LONGEST_BASELINE_M = 10.0
_MOST = 1e9  # of a number that describes a camera
_MOST_FIELDS, _MOST_JSON_BYTES, _MOST_BYTES = 1000, 1_000_000, 500_000_000


class LifView(NamedTuple):
    """A view of a LIF file.

    Attributes:
        picture: Its encoded picture; None for the JPEG that the file itself is.
        x, y: Place of its camera, in units of `baseline_m`; x increases to the right.
        skew: Shift of the view in its camera, in x and y; None if the file does not state it.
        rotation: Rotation of the camera, as the file states it; None if it does not.
        focal_share: Focal length as a share of the view's width; None if the file does not state it.
    """

    picture: bytes | None
    x: float
    y: float
    skew: tuple[float, ...] | None
    rotation: Any
    focal_share: float | None


class LifViews(NamedTuple):
    """The left and the right view of a LIF file, how many views it has, and the unit of their places."""

    left: LifView
    right: LifView
    view_count: int
    baseline_m: float | None

    @property
    def by_side(self) -> dict[str, LifView]:
        """Return the views by the words left and right."""
        return {"left": self.left, "right": self.right}

    def find_lens(self, width_px: int, height_px: int) -> Lens | None:
        """Return the cameras of views of this size; None if unknown, or if the views are shifted in them."""
        if self.left.skew != self.right.skew:
            return None
        baseline_m = (self.baseline_m or 0) * (self.right.x - self.left.x)
        share = self.left.focal_share
        focal_px = None if share is None else share * width_px
        lens = Lens(
            focal_px=take_plausible_focal_px(focal_px, width_px, height_px),
            baseline_m=baseline_m if 0 < baseline_m < _LONGEST_BASELINE_M else None,
            parallel=self.left.rotation is not None and self.left.rotation == self.right.rotation,
            source="the LIF file",
        )
        return lens if lens.is_known else None


def is_lif(path: Path) -> bool:
    """Return whether a file ends as a LIF file does."""
    return _find_table(path) is not None


def read_lif(path: Path) -> LifViews | None:
    """Return the outermost views, of those at the height of the first one; None if it is no LIF file.

    Raises:
        FormatError: The file is larger than 500 MB, its table or its description is damaged, or it holds
            fewer than two views.
    """
    table = _find_table(path)
    if table is None:
        return None
    start, length = table
    if length > _MOST_BYTES:
        raise FormatError(
            f"{path}: expected a LIF file of at most {_MOST_BYTES // 1_000_000} MB, found "
            f"{length // 1_000_000} MB; save its views as separate pictures"
        )
    try:
        with path.open("rb") as file:
            file.seek(start)
            fields = _split_fields(file.read(length))
        said = _read_description(fields)
        views = [_read_view(each, fields, index) for index, each in enumerate(said["views"])]
        stated_mm = _read_plausible(said.get("baseline_mm"))
    except (
        LookupError,
        ArithmeticError,
        TypeError,
        ValueError,
        AttributeError,
        RecursionError,
        struct.error,
    ) as error:
        raise FormatError(
            f"{path}: expected a LIF file, found one whose table of views is damaged",
            remedy=Remedy("copy it again"),
        ) from error
    row = sorted((view for view in views if view.y == views[0].y), key=lambda view: view.x)
    if len(row) < 2 or row[0].x == row[-1].x:
        raise FormatError(
            f"{path}: expected a stereo picture, found a LIF file with one view and its depth map; "
            "take the picture again as 3-D, or give the two pictures it was made from"
        )
    return LifViews(row[0], row[-1], len(views), None if stated_mm is None else stated_mm / 1000)


def _find_table(path: Path) -> tuple[int, int] | None:
    """Return where the table of a LIF file begins, and its length in bytes; None for another file."""
    size = path.stat().st_size
    if size < _END_BYTES + 4:
        return None
    with path.open("rb") as file:
        file.seek(size - _END_BYTES)
        end = file.read(_END_BYTES)
        from_end = int.from_bytes(end[:4])
        if end[4:] != _MARK or not _END_BYTES + 4 <= from_end <= size:
            return None
        file.seek(size - from_end)
        is_plausible = 0 < int.from_bytes(file.read(4)) <= _MOST_FIELDS
    return (size - from_end, from_end - _END_BYTES) if is_plausible else None


def _split_fields(table: bytes) -> dict[int, bytes]:
    """Return the contents of the fields by type. Raises ValueError or struct.error for a damaged table."""
    fields: dict[int, bytes] = {}
    [count] = struct.unpack_from(">L", table)
    at = 4
    for _ in range(count):
        kind, length = struct.unpack_from(">LL", table, at)
        at += 8
        if length > len(table) - at:
            raise ValueError("a field is longer than its table")
        fields[kind] = table[at : at + length]
        at += length
    return fields


def _read_description(fields: Mapping[int, bytes]) -> Mapping[str, Any]:
    content = next((fields[kind] for kind in _DESCRIPTIONS if kind in fields), b"")
    if len(content) > _MOST_JSON_BYTES:
        raise ValueError("the description is too long")
    said = json.loads(content)
    if not isinstance(said, dict) or not isinstance(said["views"], list) or not said["views"]:
        raise ValueError("no views are described")
    return said


def _read_view(said: Mapping[str, Any], fields: Mapping[int, bytes], index: int) -> LifView:
    """Return a view from its description, of any version; one without a place is right of the one before."""
    # Version 4 has `albedoId` and `xLocation`, 5.0 to 5.2 `albedo` and `camera_data`, 5.3 `image`.
    if "albedoId" in said:
        number, place = said["albedoId"], [said.get("xLocation", index), said.get("yLocation", 0)]
    else:
        number = (said.get("image") or said["albedo"])["blob_id"]
        said = {**(said.get("camera_data") or {}), **said}
        place = [*(_read_numbers(said, "position", "xy") or (index, 0))]
    x, y = (float(value) for value in place)
    if not (math.isfinite(x) and math.isfinite(y)):
        raise ValueError("a view has no place")
    return LifView(
        picture=None if number == _THE_FILE else fields[int(number)],
        x=x,
        y=y,
        skew=_read_numbers(said, "frustum_skew", "xy"),
        rotation=said.get("rotation"),
        focal_share=_read_focal_share(said),
    )


def _read_numbers(said: Mapping[str, Any], name: str, axes: str) -> tuple[float, ...] | None:
    """Return a value's coordinates, which are named or, before version 5.3, in order; None if missing."""
    value = said.get(name)
    if isinstance(value, Mapping):
        return tuple(float(value[axis]) for axis in axes)
    if isinstance(value, Sequence) and not isinstance(value, str):
        return tuple(float(value[place]) for place, _ in enumerate(axes))
    return None


def _read_focal_share(said: Mapping[str, Any]) -> float | None:
    """Return the focal length as a share of the width; None if the file does not state a plausible one."""
    ratio = said.get("focal_ratio_to_width")
    if ratio is not None:
        return _read_plausible(ratio)
    width_px, focal_px = (_read_plausible(said.get(name)) for name in ("width_px", "focal_px"))
    return focal_px / width_px if focal_px and width_px else None


def _read_plausible(value: Any) -> float | None:
    """Return a number, which the whole numbers of JSON may be too large for; None if it is another value."""
    return float(value) if isinstance(value, int | float) and abs(value) < _MOST else None
