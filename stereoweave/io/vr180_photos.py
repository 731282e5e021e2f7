"""Writing of VR180 photos: the left eye's JPEG, with the right eye's in its extended XMP.

The formats are those that `vr180` reads. Google's name for such a file ends in .vr.jpg.
"""

import base64
import hashlib
import io
import struct
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from stereoweave.io.files import replacing
from stereoweave.io.images import checking_format_size
from stereoweave.io.vr180 import EXTENSION

ENDING = ".vr.jpg"
# A segment has at most 65,533 bytes, of which its header takes 75.
_MOST_BYTES = 65_000
_MAIN = b"http://ns.adobe.com/xap/1.0/\0"
_PACKET = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" '
    'xmlns:GImage="http://ns.google.com/photos/1.0/image/" xmlns:xmpNote="http://ns.adobe.com/xmp/note/" {}/>'
    "</rdf:RDF></x:xmpmeta>"
)


def is_vr180_name(path: Path) -> bool:
    """Return whether a file name is that of a VR180 photo."""
    return path.name.lower().endswith(ENDING)


def write_vr180_photo(
    path: Path, left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"], width_deg: float
) -> None:
    """Write the equirectangular views of both eyes, 180 degrees high, as one photo.

    Args:
        path: File to write.
        left: Left eye's view.
        right: Right eye's view.
        width_deg: Extent of both views from left to right, 180 or 360 degrees.
    """
    extended = _PACKET.format(
        f'GImage:Mime="image/jpeg" GImage:Data="{base64.b64encode(_encode_jpeg(right)).decode()}"'
    ).encode()
    # Adobe's XMP Specification, part 3: the digest of the extension is its name.
    guid = hashlib.md5(extended, usedforsecurity=False).hexdigest().upper()
    segments = [_make_segment(_MAIN + _describe(left, width_deg, guid))]
    for start in range(0, len(extended), _MOST_BYTES):
        head = EXTENSION + guid.encode() + struct.pack(">II", len(extended), start)
        segments.append(_make_segment(head + extended[start : start + _MOST_BYTES]))
    with replacing(path) as temporary, checking_format_size(path, left.shape):
        jpeg = _encode_jpeg(left)
        temporary.write_bytes(jpeg[:2] + b"".join(segments) + jpeg[2:])


def _describe(left: UInt8[np.ndarray, "h w 3"], width_deg: float, guid: str) -> bytes:
    """Return the main XMP: which part of the sphere the views show, and the name of the extension."""
    height_px, width_px = left.shape[:2]
    full_px = round(width_px * 360 / width_deg)
    values = {
        "GPano:ProjectionType": "equirectangular",
        "GPano:FullPanoWidthPixels": full_px,
        "GPano:FullPanoHeightPixels": height_px,
        "GPano:CroppedAreaImageWidthPixels": width_px,
        "GPano:CroppedAreaImageHeightPixels": height_px,
        "GPano:CroppedAreaLeftPixels": (full_px - width_px) // 2,
        "GPano:CroppedAreaTopPixels": 0,
        "GImage:Mime": "image/jpeg",
        "xmpNote:HasExtendedXMP": guid,
    }
    return _PACKET.format(" ".join(f'{name}="{value}"' for name, value in values.items())).encode()


def _encode_jpeg(picture: UInt8[np.ndarray, "h w 3"]) -> bytes:
    file = io.BytesIO()
    # As other stereo pictures: magnified, and compared by both eyes.
    Image.fromarray(picture).save(file, "JPEG", quality=95, subsampling=0)
    return file.getvalue()


def _make_segment(content: bytes) -> bytes:
    return b"\xff\xe1" + struct.pack(">H", len(content) + 2) + content
