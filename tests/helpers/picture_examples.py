"""Shared by the tests of pictures: colour profiles, and files with false headers."""

import io
import struct
import zlib

import pytest
from PIL import Image

from stereoweave.errors import FormatError


def profile(name, red, green, blue):
    """Return an ICC profile, version 4, with these primaries (XYZ under D50) and the curve of sRGB."""

    def fixed(*values):
        return b"".join(struct.pack(">i", round(value * 65536)) for value in values)

    def text(value):
        content = value.encode("utf-16-be")
        return b"mluc" + struct.pack(">LLL2s2sLL", 0, 1, 12, b"en", b"US", len(content), 28) + content

    def xyz(*values):
        return b"XYZ " + bytes(4) + fixed(*values)

    curve = b"para" + bytes(4) + struct.pack(">HH", 3, 0)
    curve += fixed(2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
    tags = {b"desc": text(name), b"cprt": text("none"), b"wtpt": xyz(0.9642, 1, 0.8249)}
    tags |= {b"rXYZ": xyz(*red), b"gXYZ": xyz(*green), b"bXYZ": xyz(*blue)}
    tags |= dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve)
    table, body = struct.pack(">L", len(tags)), b""
    start = 128 + 4 + 12 * len(tags)
    for tag, content in tags.items():
        table += tag + struct.pack(">LL", start + len(body), len(content))
        body += content + bytes(-len(content) % 4)
    header = struct.pack(">L4sL4s4s4s", start + len(body), bytes(4), 0x04000000, b"mntr", b"RGB ", b"XYZ ")
    header += struct.pack(">6H", 2026, 1, 1, 0, 0, 0) + b"acsp" + bytes(28) + fixed(0.9642, 1, 0.8249)
    return header.ljust(128, b"\0") + table + body


SRGB = (0.4361, 0.2225, 0.0139), (0.3851, 0.7169, 0.0971), (0.1431, 0.0606, 0.7141)
DISPLAY_P3 = (0.5151, 0.2412, -0.0011), (0.2920, 0.6922, 0.0419), (0.1571, 0.0666, 0.7841)


def png_of(width_px, height_px):
    """Return a PNG with hardly any content whose header claims this size."""
    content = io.BytesIO()
    Image.new("L", (1, 1)).save(content, "PNG")
    head = b"IHDR" + struct.pack(">LL", width_px, height_px) + content.getvalue()[24:29]
    whole = content.getvalue()
    return whole[:12] + head + struct.pack(">L", zlib.crc32(head)) + whole[33:]


def refusal_of(function, *arguments, kind=FormatError):
    """The message of the error that the call must end in, which names the file in one line."""
    with pytest.raises(kind) as caught:
        function(*arguments)
    message = str(caught.value)
    assert "\n" not in message
    assert str(arguments[0]) in message
    assert "expected" in message
    return message
