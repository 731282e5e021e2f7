"""Reading and atomic writing of pictures, disparity and depth."""

import math
import os
import re
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

import numpy as np
from jaxtyping import Float, Float32, Shaped, UInt8, UInt16
from PIL import Image

from stereoweave.errors import FormatError, StereoweaveError, reason
from stereoweave.io.decoding import check_regular, check_size, decode_values, open_picture, read_photograph
from stereoweave.io.exif import read_orientation
from stereoweave.stereo import StereoPair

SMALLEST_SIDE_PX = 32
# Real calibrations and training recipes have a few kilobytes.
MOST_SMALL_BYTES = 256 * 1024
_KINDS = {
    ".png": "PNG",
    ".jpg": "JPEG",
    ".jpeg": "JPEG",
    ".tif": "TIFF",
    ".tiff": "TIFF",
    ".webp": "WEBP",
    ".bmp": "BMP",
}
# Temporary names of `replacing`.
_TEMPORARY = re.compile(r"\..*-[0-9a-f]{8}(\.\w+)?")
# Errors that libraries raise for damaged files: OverflowError for infinite sizes, RuntimeError (its
# RecursionError) for deep JSON.
_UNREADABLE = OSError, ValueError, OverflowError, SyntaxError, RuntimeError
# Digits are limited, because Python cannot print an integer of 4,301 digits.
_PFM_HEADER = re.compile(rb"Pf\s+(\d{1,9})\s+(\d{1,9})\s+(\S{1,99})\s")
_LONGEST_PFM_HEADER = 256


class RangeError(StereoweaveError):
    """Disparity outside the range of a 16-bit PNG."""


def read_image(path: str | Path) -> UInt8[np.ndarray, "h w 3"]:
    """Read a picture as uint8 sRGB [H, W, 3], rotated by its EXIF orientation.

    Colour profiles are applied, grey becomes RGB, alpha is dropped, and 16 bits are reduced to 8. An MPO file
    gives its first picture.

    Raises:
        FormatError: The file is missing, truncated, animated or of an unsupported kind; or the picture is
            under 32 pixels or over 32,766 pixels wide or high, or over 65 megapixels.
    """
    photograph = read_photograph(Path(path))
    image = photograph.upright(read_orientation(photograph.tags))
    check_large_enough(path, image)
    return image


def check_large_enough(path: str | Path, image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Raise a FormatError if a view is under 32 pixels wide or high."""
    if min(image.shape[:2]) < SMALLEST_SIDE_PX:
        raise FormatError(
            f"{path}: expected at least {SMALLEST_SIDE_PX}x{SMALLEST_SIDE_PX} pixels, found {_size(image)}"
        )


def read_pair(left: str | Path, right: str | Path) -> StereoPair:
    """Read a pair; raises FormatError as `read_image` does, or if the sizes differ."""
    return pair_of(left, read_image(left), right, read_image(right))


def pair_of(
    left: str | Path,
    left_image: UInt8[np.ndarray, "h w 3"],
    right: str | Path,
    right_image: UInt8[np.ndarray, "h2 w2 3"],
) -> StereoPair:
    """Make a pair of two named images; raises FormatError if one is too small or the sizes differ."""
    for path, image in ((left, left_image), (right, right_image)):
        check_large_enough(path, image)
    if left_image.shape != right_image.shape:
        raise FormatError(
            f"expected left and right pictures of the same size, found {left} of {_size(left_image)} "
            f"and {right} of {_size(right_image)}; crop or rescale one of them"
        )
    return StereoPair(left=left_image, right=right_image)


def write_image(path: str | Path, image: UInt8[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w"]) -> None:
    """Write an RGB or grey image; the file name's ending sets the format, such as .png or .jpg."""
    _save(path, image, picture_kind(path))


def picture_kind(path: str | Path) -> str:
    """Return Pillow's format name for the ending of `path`; raises StereoweaveError for an unknown one."""
    ending = Path(path).suffix
    if ending.lower() not in _KINDS:
        raise StereoweaveError(
            f"{path}: expected a picture file ending, {', '.join(_KINDS)}, found {ending!r}"
        )
    return _KINDS[ending.lower()]


def read_pfm(path: str | Path) -> Float32[np.ndarray, "h w"]:
    """Read a single-channel PFM file of either byte order, top row first.

    Source: Middlebury's variant of the format: rows from the bottom up, a negative scale for little-endian.

    Raises:
        FormatError: The file is missing or of another format, has three channels ('PF'), no pixel or more
            than `read_image` accepts, an invalid scale, or a length that contradicts its header.
    """
    check_regular(Path(path), "a PFM file")
    with reading(path, "a PFM file"), Path(path).open("rb") as file:
        (width_px, height_px), order, start = _pfm_header(path, file.read(_LONGEST_PFM_HEADER))
        expected, found = 4 * width_px * height_px, file.seek(0, os.SEEK_END) - start
        if found != expected:
            raise FormatError(
                f"{path}: expected {expected} bytes for {width_px}x{height_px} values, found {found}; "
                "is the file truncated?"
            )
        file.seek(start)
        values = np.frombuffer(file.read(), f"{order}f4")
    return values.reshape(height_px, width_px)[::-1].astype(np.float32, order="C")


def _pfm_header(path: str | Path, content: bytes) -> tuple[tuple[int, int], str, int]:
    """Parse a PFM header: width and height in px, NumPy's byte order, and the offset of the values."""
    header = _PFM_HEADER.match(content)
    if header is None:
        raise FormatError(
            f"{path}: expected a single-channel PFM file, 'Pf', width, height and scale, "
            f"found {content[:12]!r}"
        )
    size_px, scale = (int(header[1]), int(header[2])), float(header[3])
    check_size(path, size_px)
    if 0 in size_px or scale == 0 or not math.isfinite(scale):
        raise FormatError(
            f"{path}: expected a PFM file of at least one pixel and with a scale other than 0, "
            f"found {size_px[0]}x{size_px[1]} and {scale:g}"
        )
    return size_px, "<" if scale < 0 else ">", header.end()


def write_pfm(path: str | Path, values: Float[np.ndarray, "h w"]) -> None:
    """Write a single-channel PFM file, float32 and little-endian; NaN and infinity are kept."""
    with replacing(path) as temporary:
        Image.fromarray(values.astype(np.float32)).save(temporary, "PPM")


def write_float_tiff(path: str | Path, values: Float[np.ndarray, "h w"]) -> None:
    """Write a single-channel TIFF file, float32 and uncompressed; NaN and infinity are kept."""
    with replacing(path) as temporary, checking_format_size(path, values.shape):
        Image.fromarray(values.astype(np.float32)).save(temporary, "TIFF")


def write_npy(path: str | Path, values: Float[np.ndarray, "h w"]) -> None:
    """Write a NumPy .npy file in float32; NaN and infinity are kept."""
    with replacing(path) as temporary:
        np.save(temporary, values.astype(np.float32), allow_pickle=False)


def read_pixels(path: str | Path, *modes: str) -> Shaped[np.ndarray, "h w *channels"]:
    """Read a picture's stored values without conversion, for measurements and masks.

    Args:
        path: The picture.
        modes: Accepted Pillow modes, such as "L", 8-bit grey, or "RGB".

    Raises:
        FormatError: The file is missing or damaged, or the picture has another mode.
    """
    expected = f"a picture of mode {' or '.join(modes)}"
    with open_picture(Path(path), expected=expected) as picture:
        if picture.mode not in modes:
            raise FormatError(f"{path}: expected {expected}, found {picture.format} of mode {picture.mode}")
        return decode_values(path, picture)


def read_disparity_png(path: str | Path) -> Float32[np.ndarray, "h w"]:
    """Read disparity in px from a 16-bit PNG of px * 256 (KITTI's format); 0, unknown, becomes NaN."""
    expected = "a 16-bit grey PNG of disparity * 256"
    with open_picture(Path(path), expected=expected) as picture:
        if not picture.mode.startswith("I"):
            raise FormatError(f"{path}: expected {expected}, found {picture.format} of mode {picture.mode}")
        steps = decode_values(path, picture)
    return np.where(steps > 0, steps / 256, np.nan).astype(np.float32)


def write_disparity_png(path: str | Path, disparity_px: Float[np.ndarray, "h w"]) -> None:
    """Write disparity as a 16-bit PNG of px * 256 (KITTI's format); NaN and infinity become 0, unknown.

    Known disparities are written as at least 1/256 px, so that none becomes unknown.

    Raises:
        RangeError: A known value is below 0 or above 255.99 px; nothing is written.
    """
    known = np.isfinite(disparity_px)
    steps = np.rint(np.where(known, disparity_px, 0) * 256)
    if steps.min() < 0 or steps.max() > 65535:
        raise RangeError(
            f"{path}: not written; expected disparities of 0 to 255.99 px for a 16-bit PNG, "
            f"found {disparity_px[known].min():.3f} to {disparity_px[known].max():.3f}; use a PFM file"
        )
    _save(path, np.where(known, np.maximum(steps, 1), 0).astype(np.uint16), "PNG")


def write_depth_png(path: str | Path, depth_m: Float[np.ndarray, "h w"]) -> None:
    """Write depth as a 16-bit PNG of millimetres; unknown depth and depth beyond 65.535 m become 0."""
    depth_mm = np.rint(depth_m * 1000)
    _save(path, np.where((depth_mm > 0) & (depth_mm <= 65535), depth_mm, 0).astype(np.uint16), "PNG")


def read_small(path: str | Path) -> bytes:
    """Read a regular file of at most 256 KB, such as a calibration.

    Raises:
        FormatError: The file is larger, or a pipe or a device, which may be endless.
        OSError: The file cannot be read; `reading` turns this into a FormatError.
    """
    mode = Path(path).stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):  # opening a folder fails with its own error
        raise FormatError(f"{path}: expected a regular file, found a pipe or a device; save it to a file")
    with Path(path).open("rb") as file:
        content = file.read(MOST_SMALL_BYTES + 1)
    if len(content) > MOST_SMALL_BYTES:
        raise FormatError(f"{path}: expected a file of at most {MOST_SMALL_BYTES} bytes, found more")
    return content


def make_folder(path: str | Path) -> Path:
    """Make a folder and check that it is writable, so that a long run does not fail at its end."""
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError as error:
        raise StereoweaveError(
            f"{path}: expected a folder that can be written, found {reason(error)}"
        ) from error


def make_parent_folder(*files: Path) -> Path:
    """Check that files of one folder can be written; raises StereoweaveError otherwise.

    Returns the nearest existing parent folder, which is checked in place of missing ones.
    """
    for file in files:
        if file.is_dir():
            raise StereoweaveError(f"{file}: expected a file that can be written, found a folder")
    # A dangling link counts as existing, because no folder can be made in its place.
    return make_folder(next(path for path in files[0].parents if path.exists() or path.is_symlink()))


@contextmanager
def reading(path: str | Path, expected: str) -> Iterator[None]:
    """Turn errors of reading `path` into a one-line FormatError: expected, found."""
    try:
        yield
    except FormatError:
        raise
    except _UNREADABLE as error:
        raise FormatError(f"{path}: expected {expected}, found {reason(error)}") from error


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Write a file atomically: yields a temporary name, which replaces `path` at the end.

    The temporary name is beside `path`, has its ending, and is removed on an error. Missing folders are made.

    Raises:
        StereoweaveError: The folder or the file cannot be written.
    """
    target = Path(path)
    temporary = make_folder(target.parent) / f".{target.stem}-{uuid4().hex[:8]}{target.suffix}"
    try:
        yield temporary
        temporary.replace(target)
    except OSError as error:
        raise StereoweaveError(
            f"{path}: expected a file that can be written, found {reason(error)}"
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def checking_format_size(path: str | Path, shape: tuple[int, ...]) -> Iterator[None]:
    """Turn Pillow's error for a size that the format does not support into a StereoweaveError."""
    try:
        yield
    except ValueError as error:
        raise StereoweaveError(
            f"{path}: expected a size that {Path(path).suffix} supports, found {shape[1]}x{shape[0]} px "
            f"({error}); .png supports any"
        ) from error


def is_leftover(path: Path) -> bool:
    """Whether a file is a temporary one of `replacing` that a killed program left."""
    return _TEMPORARY.fullmatch(path.name) is not None


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files that killed programs left in a folder and below; nobody may be writing there."""
    for path in filter(is_leftover, folder.rglob(".*")):
        path.unlink(missing_ok=True)


def _save(
    path: str | Path, values: UInt8[np.ndarray, "h w *channels"] | UInt16[np.ndarray, "h w"], kind: str
) -> None:
    with replacing(path) as temporary, checking_format_size(path, values.shape):
        # Level 3 takes a third of the time of Pillow's 6, for 5 % more bytes (a photograph of 741x500).
        Image.fromarray(values).save(temporary, kind, quality=95, compress_level=3)


def _size(image: UInt8[np.ndarray, "h w 3"]) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"
