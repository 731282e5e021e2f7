"""XMP metadata of VR180 photos and other panoramas: their projection, and the right eye's picture.

Google's VR photo formats ("Cardboard Camera VR Photo Format", of which VR180 is a crop to 180 degrees): the
picture of the file is the left eye's; GPano tells which part of the sphere it shows; GImage:Data holds the
right eye's picture, in base64, in the extended XMP (Adobe's XMP Specification, part 3, 1.1.3.1), which is
split over segments of the file.
"""

import base64
import binascii
import re
from pathlib import Path
from typing import Any, NamedTuple

from stereoweave.errors import FormatError, Remedy

EXTENSION = b"http://ns.adobe.com/xmp/extension/\0"
_GUID_BYTES = 32
_HEADER_BYTES = len(EXTENSION) + _GUID_BYTES + 8
_AGAIN = Remedy("copy or export it again")
_NUMBERS = (
    "FullPanoWidthPixels",
    "FullPanoHeightPixels",
    "CroppedAreaImageWidthPixels",
    "CroppedAreaImageHeightPixels",
    "CroppedAreaTopPixels",
)


class Panorama(NamedTuple):
    """Part of the sphere that a picture shows, in degrees; None for angles that the metadata lacks.

    Attributes:
        width_deg: Extent from left to right.
        pitch_deg: Pitch at the bottom and at the top.
    """

    width_deg: float | None
    pitch_deg: tuple[float, float] | None


def read_xmp(picture: Any) -> bytes:
    """Return the main XMP of an open picture; empty if there is none."""
    found = picture.info.get("xmp", b"")
    return found if isinstance(found, bytes) else str(found).encode(errors="replace")


def is_panorama(xmp: bytes) -> bool:
    """Return whether XMP is that of a VR180 picture or of an equirectangular panorama."""
    return b"GImage:" in xmp or b"equirectangular" in xmp.lower()


def read_panorama(path: Path, xmp: bytes) -> Panorama | None:
    """Return what GPano tells about a picture; None if it is no panorama.

    Raises:
        FormatError: The projection is not equirectangular, or the numbers contradict each other.
    """
    if not is_panorama(xmp):
        return None
    kind = _find(xmp, b"GPano:ProjectionType") or b"equirectangular"
    if kind.strip().lower() != b"equirectangular":
        raise FormatError(
            f"{path}: expected an equirectangular panorama, found {kind[:40].decode(errors='replace')!r}; "
            "export it as one"
        )
    values = [_find(xmp, b"GPano:" + name.encode()) for name in _NUMBERS]
    if None in values[:4]:
        return Panorama(None, None)
    try:
        full_width, full_height, width, height, top = (float(value or 0) for value in values)
        if not (0 < width <= full_width < 1e6 and 0 < height <= full_height < 1e6):
            raise ValueError
        if not 0 <= top <= full_height - height:
            raise ValueError
    except ValueError:
        said = ", ".join(
            f"{name} {(value or b'missing')[:20].decode(errors='replace')}"
            for name, value in zip(_NUMBERS, values, strict=True)
        )
        raise FormatError(
            f"{path}: expected GPano metadata of a part of a panorama, found {said}", remedy=_AGAIN
        ) from None
    upper_deg = 90 - 180 * top / full_height
    return Panorama(360 * width / full_width, (upper_deg - 180 * height / full_height, upper_deg))


def read_right_eye(path: Path, picture: Any, xmp: bytes) -> bytes | None:
    """Return the file of the right eye's picture in an open JPEG; None if the metadata promises none.

    Raises:
        FormatError: The picture is promised, but missing, incomplete or not in base64. Damaged extended
            metadata of a picture whose main XMP promises none are ignored.
    """
    extended = _join_extension(path, picture, xmp)
    text = _find(extended, b"GImage:Data") or _find(xmp, b"GImage:Data")
    if text is None:
        if b"GImage:" not in xmp + extended:
            return None
        raise FormatError(
            f"{path}: expected a VR180 picture with the right eye's picture in its metadata, found none; "
            "some programs drop it when they save or send a picture",
            remedy=Remedy("use the original file"),
        )
    try:
        return base64.b64decode(b"".join(text.split()) + b"==", validate=False)
    except binascii.Error as error:
        raise FormatError(
            f"{path}: expected the right eye's picture in base64, found damaged text ({error})", remedy=_AGAIN
        ) from error


def _join_extension(path: Path, picture: Any, xmp: bytes) -> bytes:
    """Return the extended XMP, joined from its segments; empty if there is none."""
    segments = [content for _, content in getattr(picture, "applist", []) if content.startswith(EXTENSION)]
    named = (_find(xmp, b"xmpNote:HasExtendedXMP") or b"").strip()
    parts = [(content[len(EXTENSION) :][:_GUID_BYTES], content) for content in segments]
    # Some programs change the main XMP, and with it the name of its extension.
    mine = [content for guid, content in parts if guid == named] or segments
    pieces: dict[int, bytes] = {}
    stated = 0
    for content in mine:
        if len(content) < _HEADER_BYTES:
            continue
        stated = int.from_bytes(content[_HEADER_BYTES - 8 : _HEADER_BYTES - 4])
        pieces[int.from_bytes(content[_HEADER_BYTES - 4 : _HEADER_BYTES])] = content[_HEADER_BYTES:]
    joined, end = [], 0
    for start in sorted(pieces):
        if start != end:
            break
        joined.append(pieces[start])
        end = start + len(pieces[start])
    if end != stated:
        if b"GImage:" not in xmp:  # an ordinary picture, whose extended metadata do not matter
            return b""
        raise FormatError(
            f"{path}: expected {stated} bytes of extended metadata with the right eye's picture, found {end} "
            "without a gap",
            remedy=_AGAIN,
        )
    return b"".join(joined)


def _find(xmp: bytes, name: bytes) -> bytes | None:
    """Return the value of a property, written as an attribute or as an element; None if it is missing."""
    found = re.search(re.escape(name) + rb"""\s*(?:=\s*(?:"([^"]*)"|'([^']*)')|>([^<]*)<)""", xmp)
    return next((value for value in found.groups() if value is not None), None) if found else None
