"""Boxes of MP4, MOV and HEIC files (ISO/IEC 14496-12)."""

import os
import struct
from collections.abc import Callable, Iterator, Sequence
from itertools import count
from typing import BinaryIO, NamedTuple

from stereoweave.errors import FormatError

# A box starts with its size and its type, and with its size in 64 bits if that in 32 bits is 1.
_SHORTEST_HEAD, _LONGEST_HEAD = 8, 16


class Box(NamedTuple):
    """A box: its type, its content, and all of its bytes. The type is empty for bytes that are no box."""

    kind: bytes
    content: bytes
    whole: bytes


class Place(NamedTuple):
    """Where a box and its content start, and where both end, in what holds it."""

    kind: bytes
    start: int
    begin: int
    end: int


def make_box(kind: bytes, content: bytes) -> bytes:
    """Return a box of this type."""
    if len(content) + 8 < 1 << 32:
        return struct.pack(">I4s", len(content) + 8, kind) + content
    return struct.pack(">I4sQ", 1, kind, len(content) + 16) + content


def make_full_box(kind: bytes, content: bytes) -> bytes:
    """Return a box of version 0, without flags."""
    return make_box(kind, bytes(4) + content)


def find_boxes(file: BinaryIO, most: int) -> Iterator[Place]:
    """Yield the boxes on the top level of a file.

    Raises:
        FormatError: One of them is damaged or cut off, or there are more than `most`.
    """
    total, start = os.fstat(file.fileno()).st_size, 0
    for number in count():
        if start == total:
            return
        if number == most:
            raise FormatError(f"expected at most {most} boxes, found more; write the file again")
        file.seek(start)
        place = _read_place(file.read(_LONGEST_HEAD), start, total - start)
        if not place.begin <= place.end <= total:
            raise FormatError(
                f"expected whole boxes, found {place.kind!r} with {place.end - start} bytes of which the "
                f"file holds {total - start}; record or write the file again"
            )
        yield place
        start = place.end


def split_boxes(content: bytes) -> list[Box]:
    """Return the boxes that follow one another. A rest, shorter than a box, is the last one, without a type.

    Raises:
        FormatError: A box is longer than what holds it, or has no size.
    """
    found, end = [], 0
    for place in _walk(content):
        if not place.begin <= place.end <= len(content):
            raise FormatError(
                f"expected boxes that fit into the index, found {place.kind!r} with "
                f"{place.end - place.start} bytes at the place of {len(content) - place.start}; "
                "write the file again"
            )
        found.append(_cut_out(content, place))
        end = place.end
    return [*found, Box(b"", b"", content[end:])] if end < len(content) else found


def split_readable_boxes(content: bytes) -> Iterator[Box]:
    """Yield the boxes that follow one another, up to a damaged one.

    A box with an identifier (`uuid`) has this as its type. The last one may have no size.
    """
    for place in _walk(content, may_be_open=True):
        if place.begin <= place.end <= len(content):
            box = _cut_out(content, place)
            is_named = box.kind == b"uuid"
            yield Box(box.content[:16], box.content[16:], box.whole) if is_named else box


def _walk(content: bytes, *, may_be_open: bool = False) -> Iterator[Place]:
    """Yield the places of boxes, up to and with the first one that does not fit."""
    start = 0
    while len(content) - start >= _SHORTEST_HEAD:
        rest = len(content) - start if may_be_open else 0
        place = _read_place(content[start : start + _LONGEST_HEAD], start, rest)
        yield place
        if not place.begin <= place.end <= len(content):
            return
        start = place.end


def _read_place(head: bytes, start: int, open_size: int) -> Place:
    """Return where a box lies, by its first bytes; a size of 0 stands for `open_size` bytes."""
    size, kind, long_size = struct.unpack(">I4sQ", head.ljust(_LONGEST_HEAD, b"\0"))
    begin = start + (_LONGEST_HEAD if size == 1 else _SHORTEST_HEAD)
    return Place(kind, start, begin, start + {0: open_size, 1: long_size}.get(size, size))


def _cut_out(content: bytes, place: Place) -> Box:
    return Box(place.kind, content[place.begin : place.end], content[place.start : place.end])


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
