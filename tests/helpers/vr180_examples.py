"""VR180 photos, written byte by byte from Google's and Adobe's specifications."""

import base64
import io
import struct

from PIL import Image

GUID = "0123456789ABCDEF0123456789ABCDEF"
MAIN, EXTENSION = b"http://ns.adobe.com/xap/1.0/\0", b"http://ns.adobe.com/xmp/extension/\0"
MOST_IN_SEGMENT = 65_000


def encode_jpeg(image, quality=95):
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=quality, subsampling=0)
    return file.getvalue()


def make_segment(content):
    return b"\xff\xe1" + struct.pack(">H", len(content) + 2) + content


def make_gpano(width_px, height_px, **changes):
    """Return the main XMP of a VR180 photo whose picture shows 180x180 degrees."""
    values = {
        "ProjectionType": "equirectangular",
        "FullPanoWidthPixels": 2 * width_px,
        "FullPanoHeightPixels": height_px,
        "CroppedAreaImageWidthPixels": width_px,
        "CroppedAreaImageHeightPixels": height_px,
        "CroppedAreaLeftPixels": width_px // 2,
        "CroppedAreaTopPixels": 0,
    } | changes
    told = " ".join(f'GPano:{name}="{value}"' for name, value in values.items() if value is not None)
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
        'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about="" '
        'xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" '
        'xmlns:GImage="http://ns.google.com/photos/1.0/image/" '
        f'xmlns:xmpNote="http://ns.adobe.com/xmp/note/" {told} GImage:Mime="image/jpeg" '
        f'xmpNote:HasExtendedXMP="{GUID}"/></rdf:RDF></x:xmpmeta>'
    ).encode()


def make_extension(text, stated_bytes=None, most=MOST_IN_SEGMENT):
    """Return the segments of an extended XMP, each with its identifier, length and place."""
    stated = len(text) if stated_bytes is None else stated_bytes
    return [
        make_segment(
            EXTENSION + GUID.encode() + struct.pack(">LL", stated, start) + text[start : start + most]
        )
        for start in range(0, len(text), most)
    ]


def embed(right_file):
    return b'<rdf:Description GImage:Data="' + base64.b64encode(right_file) + b'"/>'


def make_vr180(left, right, *, gpano=None, extension=None):
    """Return the bytes of a VR180 photo; `gpano` and `extension` replace its metadata."""
    main = make_gpano(left.shape[1], left.shape[0]) if gpano is None else gpano
    parts = make_extension(embed(encode_jpeg(right))) if extension is None else extension
    jpeg = encode_jpeg(left)
    return jpeg[:2] + make_segment(MAIN + main) + b"".join(parts) + jpeg[2:]
