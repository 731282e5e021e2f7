"""HEIC pictures, which pillow-heif decodes: their views, and the cameras of a spatial photo.

pillow-heif 1.8 reads the stereo group and the focal lengths, but neither the cameras' positions nor the
disparity adjustment, so these are read here from the file's boxes (ISO/IEC 14496-12 and 23008-12).
"""

import math
import re
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from stereoweave.errors import FormatError, StereoweaveError, require_extra
from stereoweave.io import exif
from stereoweave.io.boxes import Box, find_boxes, split_readable_boxes
from stereoweave.io.hdr import HDR, WHITE_CODE, map_tones

BRANDS = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"})
ENDINGS = frozenset({".heic", ".heif", ".hif"})
FORMAT = "HEIF"  # Pillow's name for an open picture's format
_STEREO_GROUP = "ster"
# libheif holds the whole file in memory. Those of 48 megapixels take about 20 MB.
_MOST_BYTES = 500_000_000
# pillow-heif copies the EXIF data and the colour profile of each picture, even if they share one, when it
# opens a file. A profile lies in the box `meta`. A spatial photo of 2560x2560 px has a `meta` of 4 kB, with 2
# pictures and their 50 hidden tiles.
_MOST_META_BYTES = 1_000_000
_MOST_PICTURES = 20
_BAND_ROWS = 256
_MOST_BOXES = 1000  # on the top level of a file
# Types of items that are no pictures.
OTHER_ITEMS = frozenset({b"Exif", b"mime", b"uri "})
# Cameras write this box by its identifier, as drafts of the standard did.
EXTRINSICS_UUID = bytes.fromhex("4363e9145b7d4aab97aebea69803b434")
_EXTRINSICS = (EXTRINSICS_UUID, b"cmex")
# Apple's box: a signed number, ten-thousandths of the picture's width.
_DISPARITY_ADJUSTMENT = bytes.fromhex("de22508536cb436587432f8705e7c78a")

# Flag of a pose with a direction. Without it, the camera looks along the axis of its group.
_HAS_DIRECTION = 8
# A camera's principal point is within this share of the side from the picture's centre.
_OFF_CENTRE = 1 / 8


class DeepPicture(NamedTuple):
    """A picture with all its bits as pillow-heif stores them, how many these are, and its `nclx_profile`."""

    stored: np.ndarray[Any, Any]
    bits: int
    colours: dict[str, Any]


class _Pose(NamedTuple):
    """A camera's place in metres, x, y and z, and its direction, as stored."""

    position_m: tuple[float, float, float]
    direction: tuple[bool, bytes]


def open_heif(path: Path) -> Image.Image:
    """Open a HEIC picture at its primary image, without decoding it.

    Raises:
        FormatError: pillow-heif is not installed, the file is larger than 500 MB, or its box `meta` is
            larger than 1 MB, or lists more than 20 pictures beside hidden ones.
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
    _check_meta(path, _read_meta(path))
    return HeifImageFile(path)


def read_sizes(path: Path) -> list[tuple[int, int]]:
    """Return the widths and heights in pixels of all pictures and tiles, as the file states them.

    Those of cropped pictures are among them, because a damaged crop may be larger than its picture.
    """
    parts = split_readable_boxes(_read_meta(path)[4:])
    inner = (split_readable_boxes(part.content) for part in parts if part.kind == b"iprp")
    sizes_px = []
    for kind, content, _ in (
        b for boxes in inner for part in boxes for b in split_readable_boxes(part.content)
    ):
        if kind == b"ispe" and len(content) >= 12:
            sizes_px.append(struct.unpack_from(">LL", content, 4))
        elif kind == b"clap" and len(content) >= 16:
            # Each is a fraction.
            width, parts_w, height, parts_h = struct.unpack_from(">4L", content)
            sizes_px.append((width // max(parts_w, 1), height // max(parts_h, 1)))
    return sizes_px


def has_stereo_group(path: Path) -> bool:
    """Return whether a file in boxes, HEIC or AVIF, names two of its pictures a left and a right view."""
    try:
        parts = _read_parts(_read_meta(path)[4:])
    except FormatError:
        return False
    return _STEREO_GROUP.encode() in _read_parts(parts.get(b"grpl", b""))


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

    Focal length and principal point come from the left view's intrinsic matrix, the baseline from both
    views' positions, the convergence from Apple's disparity adjustment.
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
        principal_point_px=_read_principal_point_px(matrix, picture.size) if focal_px else None,
        baseline_m=(math.dist(left.position_m, right.position_m) or None) if left and right else None,
        convergence_px=None if adjusted is None else adjusted * width_px,
        parallel=bool(left and right and left.direction == right.direction),
        source="the HEIC file",
    )
    return lens if lens.is_known else None


def _read_principal_point_px(
    matrix: Mapping[str, Any], size_px: tuple[int, int]
) -> tuple[float, float] | None:
    """Return the principal point, counted from the centre of the first pixel; None if it is implausible."""
    found = [matrix.get(f"principal_point_{axis}", math.nan) for axis in "xy"]
    if any(not abs(at - side / 2) <= side * _OFF_CENTRE for at, side in zip(found, size_px, strict=True)):
        return None
    return found[0] - 0.5, found[1] - 0.5


def name_hdr(picture: Any) -> str | None:
    """Return the name of the transfer function of an HDR picture, PQ or HLG; None for an ordinary picture."""
    return HDR.get((picture.info.get("nclx_profile") or {}).get("transfer_characteristics", 0))


def decode_deep(path: Path, picture: Any) -> DeepPicture:
    """Decode the current picture of an open HDR file with all its bits.

    Pillow's pictures have 8 bits, in which the steps of HDR are visible.

    Raises:
        Exception: The file is damaged; pillow-heif raises SyntaxError, ValueError and others.
    """
    from pillow_heif import open_heif

    deep = open_heif(path, convert_hdr_to_8bit=False)[picture.tell()]
    info: dict[str, Any] = deep.info
    return DeepPicture(np.asarray(deep), int(info["bit_depth"]), info["nclx_profile"])


def map_deep(picture: DeepPicture) -> UInt8[np.ndarray, "h w 3"]:
    """Map the tones of an HDR picture to sRGB."""
    stored, bits, colours = picture
    # pillow-heif shifts the bits of deep pictures up to the 16th.
    white = 255 if stored.dtype == np.uint8 else ((1 << bits) - 1) << 16 - bits
    channels = stored[..., :3] if stored.ndim == 3 else np.broadcast_to(stored[..., None], (*stored.shape, 3))
    shown = np.empty(channels.shape, np.uint8)
    for start in range(0, len(shown), _BAND_ROWS):  # light takes 12 bytes a pixel
        rows = slice(start, start + _BAND_ROWS)
        codes = np.rint(channels[rows] * np.float32(WHITE_CODE / white)).astype(np.uint16)
        shown[rows] = map_tones(codes, colours["transfer_characteristics"], colours["color_primaries"])
    return shown


def _check_meta(path: Path, meta: bytes) -> None:
    """Raise a ValueError if the contents of the box `meta` are missing, a FormatError for many pictures."""
    if not meta:
        raise ValueError("no box 'meta', or several")
    # All entries, wherever they are: a search by boxes would miss those that only libheif finds.
    entries = [meta[found.end() : found.end() + 14] for found in re.finditer(b"infe", meta)]
    count = sum(_is_visible_picture(entry) for entry in entries)
    if count > _MOST_PICTURES:
        raise FormatError(
            f"{path}: expected a HEIC file of at most {_MOST_PICTURES} pictures, found {count}; "
            "save its two views as separate pictures"
        )


def _is_visible_picture(entry: bytes) -> bool:
    """Tell whether an item is a picture that is not hidden, as tiles are, from the content of its `infe`."""
    kind = entry[10:14] if entry[:1] == b"\3" else entry[8:12]  # identifiers of 32 bits, or of 16
    return len(kind) == 4 and not entry[3] & 1 and kind not in OTHER_ITEMS


def _find_stereo_group(picture: Any) -> dict[str, Any] | None:
    """Return the first group of two pictures that are a left and a right view; None if there is none."""
    for group in picture.info.get("entity_groups", []):
        indices = group["images"]
        # A damaged group may name no picture, shown as None, or the same one twice.
        if group["type"] == _STEREO_GROUP and len({*indices} - {None}) == len(indices) == 2:
            return group
    return None


def _read_pose(properties: Sequence[Box]) -> _Pose | None:
    """Return a camera's pose from its extrinsic matrix; None if the file has none that is undamaged."""
    content = next((content for kind, content, _ in properties if kind in _EXTRINSICS), b"")
    flags = int.from_bytes(content[:4])
    axes = [axis for axis in range(3) if flags >> axis & 1]
    end = 4 + 4 * len(axes)
    if len(content) < end:
        return None
    values = dict(zip(axes, struct.unpack_from(f">{len(axes)}l", content, 4), strict=True))
    x, y, z = (values.get(axis, 0) / 1e6 for axis in range(3))
    return _Pose((x, y, z), (bool(flags & _HAS_DIRECTION), content[end:]))


def _read_adjustment(properties: Sequence[Box]) -> float | None:
    """Return the disparity adjustment as a share of the picture's width; None if there is none."""
    for kind, content, _ in properties:
        if kind == _DISPARITY_ADJUSTMENT and len(content) == 4:
            share = struct.unpack(">l", content)[0] / 10_000
            return share if abs(share) <= 1 else None
    return None


def _read_properties(meta: bytes, items: Sequence[int]) -> list[list[Box]]:
    """Return the properties of each item, from the contents of the box `meta`; damaged ones are left out."""
    parts = _read_parts(_read_parts(meta[4:]).get(b"iprp", b""))
    shared, table = list(split_readable_boxes(parts.get(b"ipco", b""))), parts.get(b"ipma", b"")
    found: dict[int, list[Box]] = {}
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


def _read_parts(content: bytes) -> dict[bytes, bytes]:
    """Return the contents of boxes by their types."""
    return {box.kind: box.content for box in split_readable_boxes(content)}


def _read_meta(path: Path) -> bytes:
    """Return the contents of a file's box `meta`; empty if there is none, or several, or a damaged box.

    Of several, which the standard rules out, libheif may use another one.

    Raises:
        FormatError: The box is larger than 1 MB.
    """
    with path.open("rb") as file:
        try:
            places = [place for place in find_boxes(file, _MOST_BOXES) if place.kind == b"meta"]
        except FormatError:
            return b""
        if len(places) != 1:
            return b""
        [meta] = places
        if meta.end - meta.start > _MOST_META_BYTES:
            raise FormatError(
                f"{path}: expected a HEIC picture whose box 'meta' is at most 1 MB, found "
                f"{(meta.end - meta.start) / 1e6:.1f} MB; save it again without its colour profile"
            )
        file.seek(meta.begin)
        return file.read(meta.end - meta.begin)
