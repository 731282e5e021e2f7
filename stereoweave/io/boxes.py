"""Boxes of MP4, MOV and HEIC files (ISO/IEC 14496-12), on bytes."""

import struct
from collections.abc import Callable, Sequence
from typing import NamedTuple

from stereoweave.errors import FormatError


class Box(NamedTuple):
    """A box: its type, its content, and all of its bytes. The type is empty for bytes that are no box."""

    kind: bytes
    content: bytes
    whole: bytes


def make_box(kind: bytes, content: bytes) -> bytes:
    """Return a box of this type."""
    if len(content) + 8 < 1 << 32:
        return struct.pack(">I4s", len(content) + 8, kind) + content
    return struct.pack(">I4sQ", 1, kind, len(content) + 16) + content


def make_full_box(kind: bytes, content: bytes) -> bytes:
    """Return a box of version 0, without flags."""
    return make_box(kind, bytes(4) + content)


def split_boxes(content: bytes) -> list[Box]:
    """Return the boxes that follow one another. A rest, shorter than a box, is the last one, without a type.

    Raises:
        FormatError: A box is longer than what holds it.
    """
    found, start = [], 0
    while len(content) - start >= 8:
        size, kind = struct.unpack_from(">I4s", content, start)
        head = 16 if size == 1 else 8
        if size == 1:
            size = int.from_bytes(content[start + 8 : start + 16])
        end = start + size
        if size < head or end > len(content):
            raise FormatError(
                f"expected boxes that fit into the index, found {kind!r} with {size} bytes at the place of "
                f"{len(content) - start}; write the file again"
            )
        found.append(Box(kind, content[start + head : end], content[start:end]))
        start = end
    return [*found, Box(b"", b"", content[start:])] if start < len(content) else found


def change_boxes(
    boxes: bytes, way: Sequence[bytes], change: Callable[[bytes], bytes], *, needed: bool = False
) -> bytes:
    """Return boxes after a change of the content of each box at the end of the way through their types.

    Raises:
        FormatError: A box is damaged; or `needed` is true and there is none on the way.
    """
    kind, *rest = way
    found = split_boxes(boxes)
    if needed and not any(box.kind == kind for box in found):
        raise FormatError(f"expected the box {kind.decode()} in the index, found none; write the file again")
    return b"".join(
        make_box(
            kind, change_boxes(box.content, rest, change, needed=needed) if rest else change(box.content)
        )
        if box.kind == kind
        else box.whole
        for box in found
    )
