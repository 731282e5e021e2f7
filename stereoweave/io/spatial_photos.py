"""Writing of spatial photos: HEIC files with a left and a right view, marked as Apple's are.

pillow-heif writes both pictures, but neither the stereo group nor the cameras, so these are added to the
file's boxes (ISO/IEC 14496-12 and 23008-12).
"""

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from stereoweave.errors import FormatError, require_extra
from stereoweave.io.boxes import Box, change_boxes, make_box, split_boxes
from stereoweave.io.files import replacing
from stereoweave.io.heif import EXTRINSICS_UUID, OTHER_ITEMS
from stereoweave.stereo import StereoCamera

_QUALITY = 95
# Apple writes the camera's properties by the identifiers of a draft of the standard.
_INTRINSICS = bytes.fromhex("22cc04c7d6d94e079d904eb6ecbaf3a3")
# Intrinsics are shares of the width and the height, with this many bits after the point.
_SHIFT = 28
# The greatest number of the properties, which have 32 bits.
_MOST = (1 << 31) - 1
_HAS_X = 1
_GROUP = 1000  # libheif numbers items from 1 on; groups share their numbers
_META_HEAD = 4  # version and flags
_HIDDEN = 1
_UNKNOWN = "expected a HEIC file of two pictures as libheif writes it, found"


def write_spatial_photo(
    path: Path,
    left: UInt8[np.ndarray, "h w 3"],
    right: UInt8[np.ndarray, "h w 3"],
    camera: StereoCamera | None = None,
) -> None:
    """Write two views of the same size as a spatial photo.

    Args:
        path: The file.
        left: The left view, RGB.
        right: The right view, RGB.
        camera: Camera of the views, of parallel directions; None if it is unknown.

    Raises:
        StereoweaveError: pillow-heif is not installed, or the file cannot be written.
    """
    with require_extra("heic", f"{path}: writing a spatial photo needs pillow-heif"):
        from pillow_heif import HeifFile
    file = HeifFile()
    for view in (left, right):
        file.add_frombytes("RGB", (view.shape[1], view.shape[0]), np.ascontiguousarray(view).tobytes())
    with replacing(path) as temporary:
        # Devices decode only halved colours.
        file.save(temporary, quality=_QUALITY, chroma=420)
        marked = mark_views(temporary.read_bytes(), camera, (left.shape[1], left.shape[0]))
        temporary.write_bytes(marked)


def mark_views(content: bytes, camera: StereoCamera | None, size_px: tuple[int, int]) -> bytes:
    """Return a HEIC file of two pictures with a group that says that they are a left and a right view.

    Args:
        content: The file, as libheif writes it.
        camera: Camera of the views, of parallel directions; None if it is unknown.
        size_px: Width and height of a view.

    Raises:
        FormatError: The file is damaged, has not two pictures, or is stored in another way.
    """
    boxes = split_boxes(content)
    metas = [at for at, box in enumerate(boxes) if box.kind == b"meta"]
    if len(metas) != 1 or any(box.kind == b"mdat" for box in boxes[: metas[0]]):
        raise FormatError(f"{_UNKNOWN} {len(metas)} boxes meta, or pictures before it")
    old = boxes[metas[0]]
    views = _find_views(_children(old))
    properties = _make_properties(camera, size_px)
    grown = _add_properties(old.content[_META_HEAD:], views, properties)
    grown += make_box(b"grpl", make_box(b"ster", struct.pack(">5I", 0, _GROUP, 2, *views)))
    by = _META_HEAD + len(grown) + 8 - len(old.whole)
    moved = change_boxes(grown, (b"iloc",), lambda table: _move_items(table, by), needed=True)
    meta = make_box(b"meta", old.content[:_META_HEAD] + moved)
    return b"".join(
        [*(box.whole for box in boxes[: metas[0]]), meta, *(b.whole for b in boxes[metas[0] + 1 :])]
    )


def _children(meta: Box) -> dict[bytes, bytes]:
    return {box.kind: box.content for box in split_boxes(meta.content[_META_HEAD:])}


def _find_views(parts: dict[bytes, bytes]) -> tuple[int, int]:
    """Return the numbers of the two pictures."""
    table = parts.get(b"iinf", b"")
    if len(table) < 6 or b"grpl" in parts:
        raise FormatError(f"{_UNKNOWN} no table of items, or groups")
    entries = [box.content for box in split_boxes(table[6 if table[0] == 0 else 8 :]) if box.kind == b"infe"]
    views = [
        int.from_bytes(entry[4:6])
        for entry in entries
        if entry[:1] == b"\2" and not entry[3] & _HIDDEN and entry[8:12] not in OTHER_ITEMS
    ]
    if len(views) != 2:
        raise FormatError(f"{_UNKNOWN} {len(views)} pictures")
    return views[0], views[1]


def _make_properties(
    camera: StereoCamera | None, size_px: tuple[int, int]
) -> tuple[list[bytes], list[bytes]]:
    """Return the properties of the left and of the right view; none for a camera beyond their numbers."""
    if camera is None:
        return [], []
    # The shares are of the size as stored, which is even because of the halved colours. The principal point
    # counts from the picture's corner.
    width_px, height_px = (side_px + side_px % 2 for side_px in size_px)
    shares = (
        camera.focal_px / width_px,
        (camera.cx_px + 0.5) / width_px,
        (camera.cy_px + 0.5) / height_px,
    )
    numbers = [round(share * (1 << _SHIFT)) for share in shares]
    x_um = round(1e6 * camera.baseline_m)
    if max(x_um, *map(abs, numbers)) > _MOST:
        return [], []
    intrinsics = make_box(b"uuid", _INTRINSICS + struct.pack(">I3i", _SHIFT << 8, *numbers))
    left = make_box(b"uuid", EXTRINSICS_UUID + bytes(4))
    right = make_box(b"uuid", EXTRINSICS_UUID + struct.pack(">Ii", _HAS_X, x_um))
    return [intrinsics, left], [intrinsics, right]


def _add_properties(
    parts: bytes, views: tuple[int, int], properties: tuple[list[bytes], list[bytes]]
) -> bytes:
    """Return the boxes in `meta` with further properties of both views."""
    numbers: dict[int, list[int]] = {}

    def extend(shared: bytes) -> bytes:
        count = len(split_boxes(shared))
        for view, own in zip(views, properties, strict=True):
            numbers[view] = [count + 1 + index for index in range(len(own))]
            count += len(own)
        return shared + b"".join([*properties[0], *properties[1]])

    extended = change_boxes(parts, (b"iprp", b"ipco"), extend, needed=True)
    return change_boxes(extended, (b"iprp", b"ipma"), lambda table: _associate(table, numbers), needed=True)


def _associate(table: bytes, numbers: dict[int, list[int]]) -> bytes:
    """Return the content of `ipma` with further properties of some items."""
    if (
        len(table) < 8
        or table[:4] != bytes(4)
        or max(map(max, filter(None, numbers.values())), default=0) > 127
    ):
        raise FormatError(f"{_UNKNOWN} another table of properties")
    count, at, entries = int.from_bytes(table[4:8]), 8, b""
    for _ in range(count):
        if len(table) < at + 3 or len(table) < at + 3 + table[at + 2]:
            raise FormatError(f"{_UNKNOWN} a table of properties that is cut off")
        item, owned = int.from_bytes(table[at : at + 2]), table[at + 3 : at + 3 + table[at + 2]]
        at += 3 + len(owned)
        owned += bytes(numbers.get(item, ()))
        entries += struct.pack(">HB", item, len(owned)) + owned
    return table[:8] + entries + table[at:]


def _move_items(table: bytes, by: int) -> bytes:
    """Return the content of `iloc` after the data of all items in the file moved."""
    if (
        len(table) < 8
        or table[:4] not in (bytes(4), b"\1\0\0\0")
        or table[4:6] not in (b"\x44\x40", b"\x44\0")
    ):
        raise FormatError(f"{_UNKNOWN} another table of places")
    moved = bytearray(table)
    for at in _find_places(table):
        place = int.from_bytes(table[at : at + 4]) + by
        if place >= 1 << 32:
            raise FormatError(f"{_UNKNOWN} one above 4 GB")
        moved[at : at + 4] = place.to_bytes(4)
    return bytes(moved)


def _find_places(table: bytes) -> Iterator[int]:
    """Yield where the table has the numbers of 4 bytes that count from the start of the file."""
    versioned, base_bytes = table[0], table[5] >> 4
    at = 8
    for _ in range(int.from_bytes(table[6:8])):
        is_in_file = not versioned or int.from_bytes(table[at + 2 : at + 4]) & 15 == 0
        base_at = at + (6 if versioned else 4)
        first = base_at + base_bytes + 2
        count = int.from_bytes(table[first - 2 : first])
        at = first + 8 * count
        if len(table) < at:
            raise FormatError(f"{_UNKNOWN} a table of places that is cut off")
        if not is_in_file:
            continue
        # Extents count from the base.
        if any(table[base_at : base_at + base_bytes]):
            yield base_at
        else:
            yield from range(first, at, 8)
