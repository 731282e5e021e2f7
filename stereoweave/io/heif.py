"""HEIC pictures, which pillow-heif decodes: their views, and the cameras of a spatial photo.

pillow-heif 1.8 reads the stereo group and the focal lengths, but neither the cameras' positions nor the
disparity adjustment, so these are read here from the file's boxes (ISO/IEC 14496-12 and 23008-12).
"""

import math
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from PIL import Image

from stereoweave.errors import FormatError, StereoweaveError, require_extra
from stereoweave.io import exif

BRANDS = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"})
ENDINGS = frozenset({".heic", ".heif", ".hif"})
FORMAT = "HEIF"  # Pillow's name for an open picture's format
_STEREO_GROUP = "ster"
# libheif holds the whole file in memory. Those of 48 megapixels take about 20 MB.
_MOST_BYTES = 500_000_000
_MOST_META_BYTES = 4_000_000
# Cameras write the first of these boxes by its identifier, as drafts of the standard did.
_EXTRINSICS = (bytes.fromhex("4363e9145b7d4aab97aebea69803b434"), b"cmex")
# Apple's box: a signed number, ten-thousandths of the picture's width.
_DISPARITY_ADJUSTMENT = bytes.fromhex("de22508536cb436587432f8705e7c78a")

# Flag of a pose with a direction. Without it, the camera looks along the axis of its group.
_HAS_DIRECTION = 8

_Box = tuple[bytes, bytes]  # its type and its content


class _Pose(NamedTuple):
    """A camera's place in metres, x, y and z, and its direction, as stored."""

    position_m: tuple[float, float, float]
    direction: tuple[bool, bytes]


def open_heif(path: Path) -> Image.Image:
    """Open a HEIC picture at its primary image, without decoding it.

    Raises:
        FormatError: pillow-heif is not installed, or the file is larger than 500 MB.
        Exception: The file is damaged; pillow-heif raises SyntaxError, ValueError and others.
    """
    try:
        with require_extra("heic", f"{path}: expected a picture, found HEIC, which needs pillow-heif"):
            from pillow_heif import HeifImageFile
    except StereoweaveError as missing:
        raise FormatError.from_error(missing) from missing
    size_bytes = path.stat().st_size
    if size_bytes > _MOST_BYTES:
        raise FormatError(
            f"{path}: expected a HEIC picture of at most {_MOST_BYTES // 1_000_000} MB, "
            f"found {size_bytes // 1_000_000} MB; scale it down"
        )
    return HeifImageFile(path)


def find_views(picture: Any) -> list[int]:
    """Return the indices of the left and the right view; empty if the file holds one view.

    A stereo group names them, left first. Without one, two pictures of the same size are the views if the
    file holds no others.
    """
    group = _find_stereo_group(picture)
    if group:
        return list(group["images"])
    if picture.n_frames != 2:
        return []
    primary, sizes_px = picture.tell(), []
    for index in (0, 1):
        picture.seek(index)
        sizes_px.append(picture.size)
    picture.seek(primary)
    return [0, 1] if sizes_px[0] == sizes_px[1] else []


def read_lens(path: Path, picture: Any) -> exif.Lens | None:
    """Return the cameras of a spatial photo whose left view is current; None if the file tells nothing.

    The focal length comes from the left view's intrinsic matrix, the baseline from both views' positions,
    the convergence from Apple's disparity adjustment.
    """
    width_px, height_px = picture.size
    matrix = picture.info.get("heif", {}).get("camera_intrinsic_matrix", {})
    focal_px = exif.take_plausible_focal_px(matrix.get("focal_length_x"), width_px, height_px)
    group = _find_stereo_group(picture)
    views = _read_properties(_read_meta(path), group["entities"]) if group else []
    adjusted = next((share for share in map(_read_adjustment, views) if share is not None), None)
    poses = [pose for pose in map(_read_pose, views) if pose is not None]
    left, right = poses if len(poses) == 2 else (None, None)
    lens = exif.Lens(
        focal_px=focal_px,
        baseline_m=(math.dist(left.position_m, right.position_m) or None) if left and right else None,
        convergence_px=None if adjusted is None else adjusted * width_px,
        parallel=bool(left and right and left.direction == right.direction),
        source="the HEIC file",
    )
    return lens if lens.is_known else None


def _find_stereo_group(picture: Any) -> dict[str, Any] | None:
    """Return the first group of two pictures that are a left and a right view; None if there is none."""
    for group in picture.info.get("entity_groups", []):
        indices = group["images"]
        # A damaged group may name no picture, shown as None, or the same one twice.
        if group["type"] == _STEREO_GROUP and len({*indices} - {None}) == len(indices) == 2:
            return group
    return None


def _read_pose(properties: Sequence[_Box]) -> _Pose | None:
    """Return a camera's pose from its extrinsic matrix; None if the file has none that is undamaged."""
    content = next((content for kind, content in properties if kind in _EXTRINSICS), b"")
    flags = int.from_bytes(content[:4])
    axes = [axis for axis in range(3) if flags >> axis & 1]
    end = 4 + 4 * len(axes)
    if len(content) < end:
        return None
    values = dict(zip(axes, struct.unpack_from(f">{len(axes)}l", content, 4), strict=True))
    x, y, z = (values.get(axis, 0) / 1e6 for axis in range(3))
    return _Pose((x, y, z), (bool(flags & _HAS_DIRECTION), content[end:]))


def _read_adjustment(properties: Sequence[_Box]) -> float | None:
    """Return the disparity adjustment as a share of the picture's width; None if there is none."""
    for kind, content in properties:
        if kind == _DISPARITY_ADJUSTMENT and len(content) == 4:
            share = struct.unpack(">l", content)[0] / 10_000
            return share if abs(share) <= 1 else None
    return None


def _read_properties(meta: bytes, items: Sequence[int]) -> list[list[_Box]]:
    """Return the properties of each item, from the contents of the box `meta`; damaged ones are left out."""
    parts = dict(_split_boxes(dict(_split_boxes(meta[4:])).get(b"iprp", b"")))
    shared, table = list(_split_boxes(parts.get(b"ipco", b""))), parts.get(b"ipma", b"")
    found: dict[int, list[_Box]] = {}
    try:
        head, count = struct.unpack_from(">LL", table)
        item_format, place_format = (">LB" if head >> 24 else ">HB"), ("H" if head & 1 else "B")
        at = 8
        for _ in range(count):
            item, number = struct.unpack_from(item_format, table, at)
            at += struct.calcsize(item_format)
            places = struct.unpack_from(f">{number}{place_format}", table, at)
            at += number * struct.calcsize(place_format)
            # The top bit says whether a reader must know the property; 0 stands for none.
            numbers = [place & (0x7FFF if head & 1 else 0x7F) for place in places]
            found[item] = [shared[place - 1] for place in numbers if 0 < place <= len(shared)]
    except struct.error:  # the table ends too early
        pass
    return [found.get(item, []) for item in items]


def _split_boxes(content: bytes) -> Iterator[_Box]:
    """Yield the boxes that follow one another; a box with an identifier has this as its type."""
    start = 0
    while start + 8 <= len(content):
        size, kind = struct.unpack_from(">L4s", content, start)
        head, end = (24 if kind == b"uuid" else 8), (start + size if size else len(content))
        if end < start + head or end > len(content):
            return
        yield (content[start + 8 : start + 24] if head == 24 else kind), content[start + head : end]
        start = end


def _read_meta(path: Path) -> bytes:
    """Return the contents of a file's box `meta`, of at most 4 MB; empty if there is none."""
    with path.open("rb") as file:
        end = path.stat().st_size
        while file.tell() < end:
            start = file.tell()
            head = file.read(16)
            size, kind, long_size = struct.unpack(">L4sQ", head.ljust(16, b"\0"))
            begin = 16 if size == 1 else 8
            size = long_size if size == 1 else size or end - start
            if size < begin or start + size > end:
                break
            if kind == b"meta":
                file.seek(start + begin)
                return file.read(min(size - begin, _MOST_META_BYTES))
            file.seek(start + size)
    return b""
