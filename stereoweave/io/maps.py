"""Reading and writing disparity, depth and other maps."""

import math
import os
import re
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Shaped
from PIL import Image

from stereoweave.arguments import check_array, check_kind
from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.decoding import check_regular, check_size, decode_values, open_picture
from stereoweave.io.files import reading, replacing
from stereoweave.io.images import save_encoded, save_picture

# The number of digits is limited, because Python cannot print an integer of 4,301 digits.
_PFM_HEADER = re.compile(rb"Pf\s+(\d{1,9})\s+(\d{1,9})\s+(\S{1,99})\s")
_LONGEST_PFM_HEADER = 256
# Disparity in px = 16-bit value * scale + offset; without these text chunks, value / 256.
_SCALE, _OFFSET, _UNKNOWN = "disparity_scale_px", "disparity_offset_px", "disparity_unknown_value"
_STEP_PX = 1 / 256
_MOST_STEPS = 65535


class RangeError(StereoweaveError):
    """Error for a disparity outside the range of a 16-bit PNG."""


def read_pfm(path: str | Path) -> Float32[np.ndarray, "h w"]:
    """Read a single-channel PFM file in either byte order, and return the top row first.

    Source: Middlebury's variant of the format, with rows from bottom to top and a negative scale for
    little-endian values.

    Raises:
        FormatError: The file is missing, has another format, three channels ('PF'), no pixels, more pixels
            than `read_image` accepts, an invalid scale, or a length that contradicts its header.
    """
    check_kind("path", path, str, Path)
    check_regular(Path(path), "a PFM file")
    with reading(path, "a PFM file"), Path(path).open("rb") as file:
        (width_px, height_px), order, start = _parse_pfm_header(path, file.read(_LONGEST_PFM_HEADER))
        expected, found = 4 * width_px * height_px, file.seek(0, os.SEEK_END) - start
        if found != expected:
            raise FormatError(
                f"{path}: expected {expected} bytes for {width_px}x{height_px} values, found {found}; "
                "is the file truncated?"
            )
        file.seek(start)
        values = np.frombuffer(file.read(), f"{order}f4")
    return values.reshape(height_px, width_px)[::-1].astype(np.float32, order="C")


def _parse_pfm_header(path: str | Path, content: bytes) -> tuple[tuple[int, int], str, int]:
    """Parse a PFM header. Returns the size (width, height), NumPy's byte order and the values' offset."""
    header = _PFM_HEADER.match(content)
    if header is None:
        raise FormatError(
            f"{path}: expected a single-channel PFM header ('Pf', width, height and scale), "
            f"found {content[:12]!r}"
        )
    size_px, scale = (int(header[1]), int(header[2])), float(header[3])
    check_size(path, size_px)
    if 0 in size_px or scale == 0 or not math.isfinite(scale):
        raise FormatError(
            f"{path}: expected a PFM file with at least one pixel and a finite scale other than 0, "
            f"found {size_px[0]}x{size_px[1]} pixels and a scale of {scale:g}"
        )
    return size_px, "<" if scale < 0 else ">", header.end()


def write_pfm(path: str | Path, values: Float[np.ndarray, "h w"]) -> None:
    """Write a single-channel PFM file in little-endian float32; NaN and infinity are kept."""
    _check_map(path, "values", values)
    save_encoded(path, Image.fromarray(values.astype(np.float32)), "PPM")


def write_float_tiff(path: str | Path, values: Float[np.ndarray, "h w"]) -> None:
    """Write a single-channel TIFF file in float32, uncompressed; NaN and infinity are kept."""
    _check_map(path, "values", values)
    save_encoded(path, Image.fromarray(values.astype(np.float32)), "TIFF")


def write_npy(path: str | Path, values: Float[np.ndarray, "h w"]) -> None:
    """Write a NumPy .npy file in float32; NaN and infinity are kept."""
    _check_map(path, "values", values)
    content = BytesIO()  # of a full disk, NumPy would only say how much it wrote
    np.save(content, values.astype(np.float32), allow_pickle=False)
    with replacing(path) as temporary:
        temporary.write_bytes(content.getbuffer())


def _check_map(path: object, name: str, values: object) -> None:
    """Raise a StereoweaveError if a map to write is no plain array of floats, or its path is no path."""
    check_kind("path", path, str, Path)
    check_array(name, values, "f", 2)


def read_pixels(path: str | Path, *modes: str) -> Shaped[np.ndarray, "h w *channels"]:
    """Read a picture's stored values without conversion, for measurements and masks.

    Args:
        path: The picture.
        modes: Accepted Pillow modes, such as "L" (8-bit grey) or "RGB".

    Raises:
        FormatError: The file is missing or damaged, or the picture has another mode.
    """
    expected = f"a picture of mode {' or '.join(modes)}"
    with open_picture(Path(path), expected=expected) as picture:
        if picture.mode not in modes:
            raise FormatError(f"{path}: expected {expected}, found mode {picture.mode} ({picture.format})")
        return decode_values(path, picture)


def read_disparity_png(path: str | Path) -> Float32[np.ndarray, "h w"]:
    """Read disparity in px from a 16-bit PNG; 0 (unknown) becomes NaN.

    The values are px * 256 (KITTI's format), unless text chunks give another scale and an offset, as in the
    files of `write_scaled_disparity_png`.
    """
    check_kind("path", path, str, Path)
    expected = "a 16-bit grey PNG of disparity * 256"
    with open_picture(Path(path), expected=expected) as picture:
        if not picture.mode.startswith("I"):
            raise FormatError(f"{path}: expected {expected}, found mode {picture.mode} ({picture.format})")
        steps = decode_values(path, picture)
        scale_px, offset_px = _read_scale(path, picture.info)
    return np.where(steps > 0, steps * scale_px + offset_px, np.nan).astype(np.float32)


def _read_scale(path: str | Path, texts: Mapping[Any, Any]) -> tuple[float, float]:
    """Return the scale and the offset in px that a PNG's text chunks give."""
    found = texts.get(_SCALE, _STEP_PX), texts.get(_OFFSET, 0)
    try:
        scale_px, offset_px = map(float, found)
    except ValueError:
        scale_px = offset_px = math.nan
    if not (math.isfinite(scale_px) and math.isfinite(offset_px)):
        raise FormatError(
            f"{path}: expected numbers in the text chunks {_SCALE} and {_OFFSET}, "
            f"found {found[0]!r:.30} and {found[1]!r:.30}"
        )
    return scale_px, offset_px


def write_disparity_png(path: str | Path, disparity_px: Float[np.ndarray, "h w"]) -> None:
    """Write disparity as a 16-bit PNG of px * 256 (KITTI's format); NaN and infinity become 0 (unknown).

    Known disparities are written as at least 1/256 px, so that none of them becomes unknown.

    Raises:
        RangeError: A known value is below 0 or above 255.99 px; nothing is written.
    """
    _check_map(path, "disparity_px", disparity_px)
    known = np.isfinite(disparity_px)
    low_px, high_px = _find_range_px(disparity_px)
    if find_scale(low_px, high_px):
        raise RangeError(
            f"{path}: not written; expected disparities of 0 to 255.99 px for a 16-bit PNG, "
            f"found {low_px:.3f} to {high_px:.3f}; use a PFM file"
        )
    steps = np.rint(np.where(known, disparity_px, 0) / _STEP_PX)
    save_picture(path, np.where(known, np.maximum(steps, 1), 0).astype(np.uint16), "PNG")


def find_scale(low_px: float, high_px: float) -> tuple[float, float] | None:
    """Return the scale and the offset in px of a 16-bit PNG with disparities from `low_px` to `high_px`.

    A value means value * scale + offset; no value is 0, which means unknown. The scale is a power of two and
    the offset an integer, so that neither is rounded. None if px * 256 (KITTI's format) can hold the range.
    """
    if round(low_px / _STEP_PX) >= 0 and round(high_px / _STEP_PX) <= _MOST_STEPS:
        return None
    offset_px = math.floor(low_px) - 1.0
    return max(_STEP_PX, 2.0 ** math.ceil(math.log2((high_px - offset_px) / _MOST_STEPS))), offset_px


def format_scale(scale_px: float, offset_px: float) -> str:
    """Return the formula that gives the disparity in px, such as "value / 256 - 45"."""
    return f"value / {1 / scale_px:g} {'-' if offset_px < 0 else '+'} {abs(offset_px):g}"


def write_scaled_disparity_png(path: str | Path, disparity_px: Float[np.ndarray, "h w"]) -> None:
    """Write disparities of any range as a 16-bit PNG; NaN and infinity become 0 (unknown).

    The disparity of a value is value * scale + offset. The text chunks disparity_scale_px and
    disparity_offset_px contain both (`find_scale`; 1/256 and 0 if KITTI's format can hold the range);
    disparity_unknown_value is 0.
    """
    _check_map(path, "disparity_px", disparity_px)
    known = np.isfinite(disparity_px)
    scale_px, offset_px = find_scale(*_find_range_px(disparity_px)) or (_STEP_PX, 0.0)
    steps = np.rint((np.where(known, disparity_px, 0).astype(np.float64) - offset_px) / scale_px)
    steps = np.where(known, np.clip(steps, 1, _MOST_STEPS), 0).astype(np.uint16)
    texts = {_SCALE: repr(scale_px), _OFFSET: repr(offset_px), _UNKNOWN: "0"}
    save_picture(path, steps, "PNG", texts=texts)


def _find_range_px(disparity_px: Float[np.ndarray, "h w"]) -> tuple[float, float]:
    """Return the least and the greatest known disparity; both are 0 if none is known."""
    known_px = disparity_px[np.isfinite(disparity_px)]
    return (float(known_px.min()), float(known_px.max())) if known_px.size else (0.0, 0.0)


def write_depth_png(path: str | Path, depth_m: Float[np.ndarray, "h w"]) -> None:
    """Write depth as a 16-bit PNG in millimetres; unknown depth and depth beyond 65.535 m become 0."""
    _check_map(path, "depth_m", depth_m)
    depth_mm = np.rint(depth_m * 1000)
    save_picture(path, np.where((depth_mm > 0) & (depth_mm <= 65535), depth_mm, 0).astype(np.uint16), "PNG")
