"""Colour profiles of pictures that state their colours in numbers, as HEIC files may (ITU-T H.273)."""

import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

# Colour primaries and transfer curves by their numbers. Other primaries hardly differ from those of sRGB.
_PRIMARIES = {9: "BT.2020", 12: "Display P3"}
# The white of profiles, as XYZ, and the Bradford matrix, which adapts another one to it (ICC.1, annex E).
_D50 = (0.9642, 1.0, 0.8249)
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
# The curve of sRGB, by the parameters g, a, b, c and d of ICC.1's type 3.
_SRGB_CURVE = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)


def make_profile(colours: Mapping[str, Any] | None) -> bytes | None:
    """Return an ICC profile with the primaries that pillow-heif reads from a file, and the curve of sRGB.

    Return None if they are unknown, or close to those of sRGB.
    """
    name = _PRIMARIES.get((colours or {}).get("color_primaries", 0))
    if not colours or name is None:
        return None
    points = [
        [colours[f"color_primary_{which}_{axis}"] for axis in "xy"] for which in ("red", "green", "blue")
    ]
    white = _to_xyz(*(colours[f"color_primary_white_{axis}"] for axis in "xy"))
    matrix = np.stack([_to_xyz(x, y) for x, y in points], axis=1)
    matrix = matrix * np.linalg.solve(matrix, white)
    adapted = np.diag((_BRADFORD @ _D50) / (_BRADFORD @ white))
    matrix = np.linalg.inv(_BRADFORD) @ adapted @ _BRADFORD @ matrix
    return _write_profile(name, matrix)


def _to_xyz(x: float, y: float) -> np.ndarray:
    """Return the XYZ of a chromaticity, of luminance 1."""
    return np.array([x / y, 1.0, (1 - x - y) / y])


def _write_profile(name: str, matrix: np.ndarray) -> bytes:
    """Return an ICC profile, version 4, of a display whose primaries are the columns of an XYZ matrix."""
    curve = b"para" + struct.pack(">LHH", 0, 3, 0) + _pack_fixed(*_SRGB_CURVE)
    tags = {b"desc": _pack_text(name), b"cprt": _pack_text("No copyright, use freely")}
    tags[b"wtpt"] = b"XYZ " + bytes(4) + _pack_fixed(*_D50)
    for letter, column in zip((b"r", b"g", b"b"), matrix.T, strict=True):
        tags[letter + b"XYZ"] = b"XYZ " + bytes(4) + _pack_fixed(*column)
        tags[letter + b"TRC"] = curve
    table, body = struct.pack(">L", len(tags)), b""
    start = 128 + 4 + 12 * len(tags)
    for tag, content in tags.items():
        table += tag + struct.pack(">LL", start + len(body), len(content))
        body += content + bytes(-len(content) % 4)
    head = struct.pack(">L4sL4s4s4s", start + len(body), bytes(4), 0x04000000, b"mntr", b"RGB ", b"XYZ ")
    head += struct.pack(">6H", 2026, 1, 1, 0, 0, 0) + b"acsp" + bytes(28) + _pack_fixed(*_D50)
    return head.ljust(128, b"\0") + table + body


def _pack_text(words: str) -> bytes:
    text = words.encode("utf-16-be")
    return b"mluc" + struct.pack(">LLL2s2sLL", 0, 1, 12, b"en", b"US", len(text), 28) + text


def _pack_fixed(*values: float) -> bytes:
    return b"".join(struct.pack(">i", round(value * 65536)) for value in values)
