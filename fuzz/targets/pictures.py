"""Pictures with one or two views, in every supported format, with tags, profiles and markers."""

import base64
import io
import json
import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from PIL import Image, ImageCms, features
from pillow_heif import HeifFile

from fuzz.repairs import repair_png
from fuzz.targets import Target, read_every_way, write_to_bytes
from stereoweave.io.images import read_image
from stereoweave.pictures.loading import open_pictures
from stereoweave.rendering.layouts import write_picture

_SIZE_PX = 48, 72


def eyes(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return a small pair, uint8 RGB [48, 72, 3], of one texture with a disparity of 4 px."""
    rng = np.random.default_rng(seed)
    noise = rng.integers(0, 256, (_SIZE_PX[0], _SIZE_PX[1] + 4, 3), np.uint8)
    texture = cv2.GaussianBlur(noise, (0, 0), 1)
    return texture[:, 4:].copy(), texture[:, :-4].copy()


def encode_picture(image: np.ndarray, kind: str, **options: Any) -> bytes:
    """Return an image encoded by Pillow."""
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, kind, **options)
    return stream.getvalue()


def _starts() -> dict[str, bytes]:
    left, right = eyes()
    both = np.hstack([left, right])
    grey = cv2.cvtColor(both, cv2.COLOR_RGB2GRAY)
    return {
        **dict(_plain(both, grey)),
        **dict(_with_tags(both)),
        "eyes.mpo": write_to_bytes("eyes.mpo", lambda path: write_picture(path, both)),
        "eyes.jps": write_to_bytes("eyes.jps", lambda path: write_picture(path, both)),
        "eyes.heic": _encode_heic(left, right),
        "leia.jpg": _encode_lif(left, right),
        "sensor.dng": _encode_dng(left),
        "above_TB.png": encode_picture(np.vstack([left, right]), "PNG"),
        "eyes.vr.jpg": _encode_vr180(),
    }


def _encode_vr180() -> bytes:
    """Return a VR180 photo, large enough for a window, whose right eye is in two segments of extended XMP."""
    left, right = (encode_picture(np.tile(eye, (3, 2, 1)), "JPEG") for eye in eyes())
    values = {"FullPanoWidth": 288, "FullPanoHeight": 144}
    values |= {"CroppedAreaImageWidth": 144, "CroppedAreaImageHeight": 144}
    told = "".join(f' GPano:{name}Pixels="{value}"' for name, value in values.items())
    guid, text = b"0" * 32, b'<x GImage:Data="' + base64.b64encode(right) + b'"/>'
    main = f'<x{told} GPano:ProjectionType="equirectangular" xmpNote:HasExtendedXMP="{guid.decode()}"/>'
    contents = [b"http://ns.adobe.com/xap/1.0/\0" + main.encode()]
    for start in range(0, len(text), 1 + len(text) // 2):
        place = struct.pack(">LL", len(text), start)
        part = text[start : start + 1 + len(text) // 2]
        contents.append(b"http://ns.adobe.com/xmp/extension/\0" + guid + place + part)
    segments = [b"\xff\xe1" + struct.pack(">H", 2 + len(content)) + content for content in contents]
    return left[:2] + b"".join(segments) + left[2:]


def _encode_heic(*images: np.ndarray) -> bytes:
    """Return a HEIC file with these images, a description of a camera among their tags."""
    exif = Image.Exif()
    exif[0x0110], exif[0x0112] = "Some phone", 6
    file, stream = HeifFile(), io.BytesIO()
    for image in images:
        added = file.add_frombytes("RGB", image.shape[1::-1], image.tobytes())
        added.info["exif"] = exif.tobytes()
    file.save(stream)
    return stream.getvalue()


def _encode_lif(left: np.ndarray, right: np.ndarray) -> bytes:
    """Return a LIF file: a JPEG, then a table with the right view and the description of both."""
    camera = {"width_px": 72, "focal_px": 60, "frustum_skew": [0, 0], "rotation": [0, 0, 0]}
    views = [
        {"image": {"blob_id": number}, "position": {"x": x, "y": 0, "z": 0}, **camera}
        for number, x in ((-1, 0.0), (1000001, 1.0))
    ]
    fields = {
        1000001: encode_picture(right, "JPEG"),
        8: json.dumps({"baseline_mm": 45, "views": views}).encode(),
    }
    table = len(fields).to_bytes(4) + b"".join(
        kind.to_bytes(4) + len(content).to_bytes(4) + content for kind, content in fields.items()
    )
    return encode_picture(left, "JPEG") + table + (len(table) + 6).to_bytes(4) + b"\x1e\x1a"


def _encode_dng(image: np.ndarray) -> bytes:
    """Return a raw file, whose sensor sees the image's first channel."""
    stream = io.BytesIO()
    matrix = [part for value in np.eye(3).ravel() for part in (round(1000 * value), 1000)]
    tags = [
        (272, "s", 0, "Some camera", True),
        (33421, "H", 2, (2, 2), True),
        (33422, "B", 4, (0, 1, 1, 2), True),
        (50706, "B", 4, (1, 4, 0, 0), True),
        (50721, "2i", 9, matrix, True),
    ]
    values = image[..., 0].astype(np.uint16) << 8
    tifffile.imwrite(stream, values, photometric=32803, extratags=tags, software=False, metadata=None)
    return stream.getvalue()


def _plain(both: np.ndarray, grey: np.ndarray) -> Iterator[tuple[str, bytes]]:
    kinds = {"png": "PNG", "jpg": "JPEG", "tif": "TIFF", "webp": "WEBP", "bmp": "BMP", "gif": "GIF"}
    kinds |= {"ppm": "PPM", "jp2": "JPEG2000"} | ({"avif": "AVIF"} if features.check("avif") else {})
    for ending, kind in kinds.items():
        yield f"colour.{ending}", encode_picture(both, kind)
    for ending in ("png", "tif", "pgm"):
        yield f"deep.{ending}", encode_picture(grey.astype(np.uint16) << 8, kinds.get(ending, "PPM"))
    yield "lzw.tif", encode_picture(both, "TIFF", compression="tiff_lzw")
    yield "jpeg.tif", encode_picture(both, "TIFF", compression="jpeg")
    yield "lossless.webp", encode_picture(both, "WEBP", lossless=True)
    yield "alpha.png", encode_picture(np.dstack([both, grey]), "PNG")
    yield "progressive.jpg", encode_picture(grey, "JPEG", progressive=True)


def _with_tags(both: np.ndarray) -> Iterator[tuple[str, bytes]]:
    exif = Image.Exif()
    exif[0x0110], exif[0x0112] = "FinePix REAL 3D W3", 3
    details = exif.get_ifd(0x8769)
    details |= {0x920A: 6.3, 0xA405: 35, 0xA002: 144, 0xA20E: 3000.0, 0xA210: 3}
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes()
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    xmp = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><GPano:Pose>0</GPano:Pose></x:xmpmeta>'
    for ending, kind in {"jpg": "JPEG", "png": "PNG", "webp": "WEBP", "tif": "TIFF"}.items():
        yield f"tags.{ending}", encode_picture(both, kind, exif=exif, icc_profile=srgb)
    yield "profile.jpg", encode_picture(both, "JPEG", exif=exif, icc_profile=profile, xmp=xmp)


def _read(path: Path) -> None:
    read_every_way(
        partial(open_pictures, [path]), partial(open_pictures, [path, path]), partial(read_image, path)
    )


TARGET = Target(
    starts=_starts,
    read=_read,
    tokens=(
        *b"IHDR IDAT IEND tRNS PLTE acTL eXIf iCCP II*\0 MM\0* RIFF VP8L ANIM GIF89a P6 BM ftypavif".split(),
        *b"ftypheic meta iloc iinf infe iprp ipco ipma ispe hvcC irot grpl ster idat mdat".split(),
        *(b"\xff\xd8", b"\xff\xd9", b"\xff\xe1", b"\xff\xe2MPF\0", b"\xff\xe3_JPSJPS_", b"Exif\0\0", b"jP  "),
        *(b"\x21\xf9\x04", b"\x2c", b"acsp", b"GImage:", b"\x1e\x1a", b"blob_id", b"views", b"\x12\xc6"),
    ),
    repair=repair_png,
)
