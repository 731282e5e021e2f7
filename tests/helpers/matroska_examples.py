"""Matroska files written byte by byte (RFC 8794 and 9559), with what FFmpeg's writer lacks."""

import io
from collections.abc import Sequence

import numpy as np
from PIL import Image

FRAME_NS = 40_000_000  # 25 frames a second


def element(identifier: str, *contents: bytes | int) -> bytes:
    """Return an EBML element with an identifier in hexadecimal digits; a number becomes four bytes."""
    body = b"".join(part.to_bytes(4) if isinstance(part, int) else part for part in contents)
    return bytes.fromhex(identifier) + (1 << 56 | len(body)).to_bytes(8) + body


def video_track(number: int, size_px: tuple[int, int], *, stereo_mode: int | None = None) -> bytes:
    """Return the description of a track of JPEGs; its unique number is 10 times the other one."""
    mode = [] if stereo_mode is None else [element("53b8", stereo_mode)]
    return element(
        "ae",
        element("d7", number),
        element("73c5", 10 * number),
        element("83", 1),
        element("86", b"V_MJPEG"),
        element("23e383", FRAME_NS),
        element("e0", element("b0", size_px[0]), element("ba", size_px[1]), *mode),
    )


def stereo_track(number: int, planes: Sequence[tuple[int, int]]) -> bytes:
    """Return a track that joins others: each plane is a track's number and 0 for left or 1 for right."""
    parts = [element("e4", element("e5", 10 * track), element("e6", kind)) for track, kind in planes]
    return element(
        "ae",
        element("d7", number),
        element("73c5", 10 * number),
        element("83", 1),
        element("86", b"V_MJPEG"),
        element("e2", element("e3", *parts)),
    )


def block(track: int, time_ms: int, *images: np.ndarray) -> bytes:
    """Return a block with an image, or with several ones laced (EBML lacing is left out: sizes by Xiph)."""
    packets = [_jpeg(image) for image in images]
    head = bytes([0x80 | track]) + time_ms.to_bytes(2) + bytes([0x80 | (0x02 if len(images) > 1 else 0)])
    if len(packets) > 1:
        head += bytes([len(packets) - 1])
        head += b"".join(b"\xff" * (len(each) // 255) + bytes([len(each) % 255]) for each in packets[:-1])
    return element("a3", head, *packets)


def matroska(tracks: Sequence[bytes], blocks: Sequence[bytes]) -> bytes:
    """Return a whole file, of one cluster."""
    head = element(
        "1a45dfa3",
        element("4282", b"matroska"),
        element("4287", 4),
        element("4285", 2),
    )
    info = element(
        "1549a966", element("2ad7b1", 1_000_000), element("4d80", b"test"), element("5741", b"test")
    )
    cluster = element("1f43b675", element("e7", 0), *blocks)
    return head + element("18538067", info, element("1654ae6b", *tracks), cluster)


def _jpeg(image: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "JPEG", quality=97, subsampling=0)
    return stream.getvalue()
