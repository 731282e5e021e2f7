"""Shared by the tests of spatial videos: an encoded example, and changes of what it says about itself."""

import struct
from pathlib import Path

import numpy as np
from video_examples import Pair, example_pairs

SPATIAL = Path(__file__).resolve().parents[1] / "spatial_video" / "pan.mp4"
SPATIAL_FRAMES, SPATIAL_GROUP = 50, 10  # a key frame every 10 frames

# The boxes around the sample description of the first track, and the bytes before the boxes within each.
_WAY = {b"moov": 0, b"trak": 0, b"mdia": 0, b"minf": 0, b"stbl": 0, b"stsd": 8}
_WAY |= dict.fromkeys((b"hvc1", b"hev1", b"avc1"), 78)
# Three-dimensional reference displays information: an SEI message in a NAL unit of type 39, of 4 or 5 bytes.
_DISPLAYS = b"\x4e\x01\xb0"


def spatial_pairs() -> list[Pair]:
    """Return the pictures that the example was encoded from."""
    return example_pairs(SPATIAL_FRAMES, width=320, height=192)


def spatial_boxes(
    *, baseline_um: int, degrees: float, adjustment: int = 0, eyes: int = 3, hero: int = 1
) -> bytes:
    """Return the boxes by which a sample description declares the cameras, in Apple's format.

    Args:
        baseline_um: Distance of the cameras in micrometres.
        degrees: Horizontal field of view.
        adjustment: Shift of the views in 1/10000 of the width.
        eyes: 1 for a left view, plus 2 for a right one, plus 8 if the right one comes first.
        hero: The eye to show alone: 1 left, 2 right.
    """
    parts = [
        box(b"stri", bytes([0, 0, 0, 0, eyes])),
        box(b"hero", bytes([0, 0, 0, 0, hero])),
        box(b"cams", box(b"blin", struct.pack(">II", 0, baseline_um))),
        box(b"cmfy", box(b"dadj", struct.pack(">Ii", 0, adjustment))),
    ]
    return box(b"vexu", box(b"eyes", b"".join(parts))) + box(
        b"hfov", struct.pack(">I", round(1000 * degrees))
    )


def box(kind: bytes, content: bytes) -> bytes:
    """Return a box of an MP4 file."""
    return struct.pack(">I", 8 + len(content)) + kind + content


def with_boxes(content: bytes, boxes: bytes) -> bytes:
    """Return an MP4 file, whose index is at its end, with these boxes instead of those about the cameras."""
    grown, done = b"", 0
    for start, end, kind in _boxes(content, 0, len(content)):
        if kind == b"moov":
            grown += content[done:start] + _rebuilt(content[start:end], boxes)
            done = end
    return grown + content[done:]


def swap_views(content: bytes) -> bytes:
    """Return a video whose stream says that the base view, of identifier 0, is the right one."""
    changed, found = bytearray(content), content.find(_DISPLAYS)
    while found >= 0:
        start, length = found + 4, content[found + 3]
        bits = "".join(f"{byte:08b}" for byte in content[start : start + length])
        # Precision, no viewing distance, one display: then the left view, 0, and the right one, 1.
        at = bits.index("1010", _end_of_number(bits, 0) + 1)
        bits = bits[:at] + "0101" + bits[at + 4 :]
        changed[start : start + length] = int(bits, 2).to_bytes(length, "big")
        found = content.find(_DISPLAYS, start)
    return bytes(changed)


def units(content: bytes) -> list[tuple[int, int, int, int]]:
    """Return the start, end, type and layer of each NAL unit in a packet of an MP4 file."""
    found, start = [], 0
    while start + 6 <= len(content):
        length = int.from_bytes(content[start : start + 4], "big")
        head = int.from_bytes(content[start + 4 : start + 6], "big")
        found.append((start + 4, start + 4 + length, head >> 9 & 63, head >> 3 & 63))
        start += 4 + length
    return found


def psnr_db(image: np.ndarray, expected: np.ndarray) -> float:
    """Return the peak signal-to-noise ratio of an 8-bit image."""
    return float(10 * np.log10(255**2 / np.mean((image.astype(float) - expected) ** 2)))


def _boxes(content: bytes, start: int, end: int) -> list[tuple[int, int, bytes]]:
    found = []
    while start + 8 <= end:
        length = struct.unpack_from(">I", content, start)[0]
        found.append((start, start + length, content[start + 4 : start + 8]))
        start += length
    return found


def _rebuilt(whole: bytes, boxes: bytes) -> bytes:
    kind = whole[4:8]
    before = _WAY[kind]
    inner, is_entry, entered = whole[8 : 8 + before], before == 78, False
    for start, end, part in _boxes(whole, 8 + before, len(whole)):
        if part in (b"vexu", b"hfov"):
            continue
        follow = part in _WAY and not entered
        entered |= follow
        inner += _rebuilt(whole[start:end], boxes) if follow else whole[start:end]
    return box(kind, inner + boxes if is_entry else inner)


def _end_of_number(bits: str, start: int) -> int:
    """Return the end of an Exp-Golomb number."""
    zeros = bits.index("1", start) - start
    return start + 2 * zeros + 1
