"""Decoding of picture files and their metadata.

All parts of the package decode pictures here, so that formats, limits, colours, orientation and errors are
the same everywhere.
"""

import io
import logging
import stat
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Shaped, UInt8
from PIL import Image, UnidentifiedImageError, features

from stereoweave.errors import FormatError, Remedy, reason
from stereoweave.io import exif, heif, raw, vr180
from stereoweave.io.colour_profiles import make_profile
from stereoweave.io.similar_names import as_typed, describe_missing
from stereoweave.io.unreadable import check_readable
from stereoweave.stereo import LONGEST_SIDE_PX

# 50 megapixels per view are supported; cameras of that class have up to 64. The limit is checked against the
# file's header, before memory is allocated.
MOST_PIXELS = 65_000_000
A_PICTURE = "a picture (PNG, JPEG, TIFF or the like)"
# File extensions by which pictures in a folder are found; a file's format is detected from its content.
ENDINGS = heif.ENDINGS | {
    *(".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp", ".gif", ".jp2", ".pgm", ".ppm", ".avif")
}
# Not all of Pillow's formats: a PostScript file, for example, would run as a program. JPEG includes MPO and
# JPS.
_KINDS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "GIF", "PPM", "AVIF", "JPEG2000")
_ANIMATIONS = ("GIF", "PNG", "WEBP", "AVIF")
_VIDEO_ENDINGS = (".mp4", ".mov", ".mkv", ".mk3d", ".avi", ".webm", ".m4v", ".wmv")
_AVIF_BRANDS = {b"avif", b"avis"}
_MP_ENTRIES, _DISPARITY = 0xB002, "Multi-Frame Image: (Disparity)"
_LONGEST_WORDS = 100
_BITS_PER_SAMPLE = 258  # a TIFF tag
# Values of 16 bits that are all below it are probably of a camera of 12 bits or fewer.
LEAST_OF_SIXTEEN_BITS = 4096
# Modes to which pictures are converted before their ICC profiles are applied, by the pictures' own modes.
_PROFILED = {"RGB": "RGB", "RGBA": "RGB", "P": "RGB", "L": "L", "LA": "L", "CMYK": "CMYK"}

# Pillow logs errors before raising them, and Python writes unhandled log records to stderr.
logging.getLogger("PIL").addHandler(logging.NullHandler())


class DecodedPicture(NamedTuple):
    """A decoded picture in sRGB, not yet turned upright, with its metadata tags and a note on its values."""

    image: Image.Image
    tags: exif.Tags
    note: str | None

    def upright(self, lies: int | None) -> UInt8[np.ndarray, "h w 3"]:
        """Return the pixels, uint8 RGB [H, W, 3], turned upright according to the EXIF orientation `lies`."""
        # A copy: Pillow's read-only pixels would make Numba compile again and PyTorch warn.
        return np.array(exif.turn_upright(self.image, lies))


@contextmanager
def open_picture(
    path: Path, *, views: int = 1, expected: str = A_PICTURE, panorama: bool = False
) -> Iterator[Image.Image]:
    """Open a picture with up to `views` views and check its format and size, without decoding it.

    Of one view, a VR180 picture or a panorama is accepted only if asked for (`panorama`).

    Raises:
        FormatError: The format or the size is unsupported. Damaged content is not detected before decoding.
    """
    check_regular(path, expected)
    check_readable(path, expected)
    with _decoding(path, expected), path.open("rb") as file:
        head = file.read(64)
    brands = _find_brands(head)
    is_raw = raw.is_raw(path, head)
    if not is_raw:
        _refuse_by_name(path, brands)
    if views == 2 and brands & _AVIF_BRANDS and heif.has_stereo_group(path):
        raise FormatError(
            f"{path}: expected {A_PICTURE}, found an AVIF file with a left and a right view, of which Pillow "
            "reads one alone; save both as separate pictures, or as HEIC"
        )
    with _decoding(path, expected):
        picture, sizes_px = _open_any(path, brands, views, is_raw=is_raw)
    with picture:
        # The sizes of all pictures: Pillow allocates memory when it seeks one.
        for size_px in (picture.size, *sizes_px):
            check_size(path, size_px, views=views)
        _refuse_by_content(path, picture, views, panorama)
        yield picture


def read_picture(path: Path, *, panorama: bool = False) -> DecodedPicture:
    """Decode a picture file that holds one view, which may be a `panorama` if asked for."""
    with open_picture(path, panorama=panorama) as picture:
        return decode(path, picture)


def decode(path: str | Path, picture: Image.Image) -> DecodedPicture:
    """Decode an open picture, or the current frame if it has several."""
    hdr = heif.name_hdr(picture) if picture.format == heif.FORMAT else None
    if hdr:
        return _decode_hdr(Path(path), picture, hdr)
    stated_px = picture.size
    with _decoding(path):
        # Load before reading the tags, because loading turns a TIFF upright and updates its orientation tag.
        picture.load()
    if picture.format == heif.FORMAT:
        _check_decoded(path, stated_px, picture.size)
    tags = exif.read_tags(picture)
    if picture.mode.startswith(("I", "F")):
        grey, note = _to_eight_bits(path, picture)
        return DecodedPicture(grey, tags, note)
    image, note = _convert_to_srgb(picture)
    with _decoding(path):
        return DecodedPicture(image if image.mode == "RGB" else image.convert("RGB"), tags, note)


def _decode_hdr(path: Path, picture: Image.Image, name: str) -> DecodedPicture:
    """Decode the current picture of an open HEIC file of high dynamic range."""
    with _decoding(path):
        deep = heif.decode_deep(path, picture)
    height_px, width_px = deep.stored.shape[:2]
    _check_decoded(path, picture.size, (width_px, height_px))
    image = Image.fromarray(heif.map_deep(deep))
    return DecodedPicture(image, exif.read_tags(picture), f"HDR ({name}), tone-mapped to SDR (BT.709)")


def _check_decoded(path: str | Path, stated_px: tuple[int, int], found_px: tuple[int, int]) -> None:
    """Raise a FormatError if a decoded picture has another size than its header states."""
    if stated_px != found_px:
        raise FormatError(
            f"{path}: expected {_format_size(stated_px)} pixels, as its header states, found "
            f"{_format_size(found_px)}",
            remedy=Remedy("copy it again"),
        )


def decode_values(path: str | Path, picture: Image.Image) -> Shaped[np.ndarray, "h w *channels"]:
    """Decode the stored values of an open picture, such as measurements or a mask."""
    with _decoding(path):
        picture.load()
        return np.array(picture)


def decode_packed_values(name: str, content: bytes) -> Shaped[np.ndarray, "h w *channels"]:
    """Decode the stored values of a picture embedded in another file; error messages call it `name`."""
    return decode_values(name, _open_embedded(name, content))


def decode_embedded(name: str, content: bytes) -> DecodedPicture:
    """Decode a picture embedded in another file, with its colours; error messages call it `name`."""
    return decode(name, _open_embedded(name, content))


def measure_embedded(name: str, content: bytes) -> tuple[int, int]:
    """Return the width and height of a picture embedded in another file, without decoding it."""
    return _open_embedded(name, content).size


def _open_embedded(name: str, content: bytes) -> Image.Image:
    with _decoding(name):
        picture = _open(name, io.BytesIO(content), 1)
    check_size(name, picture.size)
    return picture


def check_regular(path: Path, expected: str) -> None:
    """Raise a FormatError unless the path is a regular file; pipes may block, and devices may be endless."""
    try:
        mode = path.stat().st_mode
    except FileNotFoundError as error:
        raise FormatError(f"{as_typed(path)}: expected {expected}, found {describe_missing(path)}") from error
    except (OSError, ValueError) as error:  # ValueError: a name with a zero byte
        raise FormatError(f"{path}: expected {expected}, found {reason(error)}") from error
    if not stat.S_ISREG(mode):
        found = (
            "a folder; give the files in it"
            if stat.S_ISDIR(mode)
            else "a pipe or a device; copy it into a file first"
        )
        raise FormatError(f"{path}: expected {expected}, found {found}")


def check_size(path: str | Path, size_px: tuple[int, int], *, views: int = 1) -> None:
    """Raise a FormatError if the width, the height or the number of pixels exceeds its limit."""
    width_px, height_px = size_px
    if width_px * height_px > views * MOST_PIXELS:
        raise FormatError(
            f"{path}: expected {_format_limit(views)}, found {width_px}x{height_px}; scale it down"
        )
    if max(size_px) > views * LONGEST_SIDE_PX:
        raise FormatError(
            f"{path}: expected at most {views * LONGEST_SIDE_PX} pixels per side, "
            f"found {width_px}x{height_px}; scale it down or crop it"
        )


@contextmanager
def _decoding(path: str | Path, expected: str = A_PICTURE) -> Iterator[None]:
    """Turn any exception from Pillow into a one-line FormatError.

    Pillow's decoders raise undocumented exceptions for damaged files, such as IndexError, KeyError,
    TypeError, struct.error and zlib.error; a list of them would never be complete. Wrap only calls to Pillow,
    because bugs in this package must not be reported as damaged files.
    """
    try:
        # Pillow warns about odd tags before it fails; the error below is enough.
        with warnings.catch_warnings(action="ignore"):
            yield
    except FormatError:
        raise
    except UnidentifiedImageError as error:
        raise FormatError(f"{path}: expected {expected}, found {_describe_other(path)}") from error
    except Exception as error:
        # The system's errors have a text of their own; any other one comes from damaged content.
        by_system = isinstance(error, OSError) and error.strerror
        advice = None if by_system or isinstance(error, MemoryError) else Remedy("copy it again")
        raise FormatError(f"{path}: expected {expected}, found {reason(error)}", remedy=advice) from error


def _describe_other(path: str | Path) -> str:
    """Return what a file is that Pillow does not recognise as a picture."""
    try:
        is_empty = Path(path).stat().st_size == 0
    except OSError:  # the content is part of another file
        is_empty = False
    return "an empty file; copy it again" if is_empty else "another type of file; save it as PNG or JPEG"


def _open_any(
    path: Path, brands: set[bytes], views: int, *, is_raw: bool
) -> tuple[Image.Image, list[tuple[int, int]]]:
    """Open a picture; return it, and the sizes that it states beside its own."""
    if is_raw:
        picture = raw.open_raw(path)
        return picture, [picture.sensor_size_px]
    if not brands & _AVIF_BRANDS and brands & heif.BRANDS:
        return heif.open_heif(path), heif.read_sizes(path)
    return _open(path, path, views), []


def _open(path: str | Path, source: Path | io.BytesIO, views: int) -> Image.Image:
    try:
        return Image.open(source, formats=_KINDS)
    except Image.DecompressionBombError as error:
        raise FormatError(
            f"{path}: expected {_format_limit(views)}, found more ({error}); scale it down"
        ) from error


def _format_size(size_px: tuple[int, int]) -> str:
    return f"{size_px[0]}x{size_px[1]}"


def _format_limit(views: int) -> str:
    return f"at most {views * MOST_PIXELS // 1_000_000} megapixels"


def _find_brands(head: bytes) -> set[bytes]:
    """Return the brands in the first bytes of a file in boxes (ISO/IEC 14496-12); empty for other files."""
    return {head[start : start + 4] for start in (8, *range(16, 64, 4))} if head[4:8] == b"ftyp" else set()


def _refuse_by_name(path: Path, brands: set[bytes]) -> None:
    """Raise a FormatError for an unsupported format, detected from the file name or the brands."""
    ending = path.suffix.lower()
    if brands & _AVIF_BRANDS:
        if not features.check("avif"):
            raise FormatError(
                f"{path}: expected {A_PICTURE}, found AVIF, which the installed Pillow cannot read"
            )
    elif not brands & heif.BRANDS and (brands or ending in _VIDEO_ENDINGS):
        raise FormatError(
            f"{path}: expected {A_PICTURE}, found a video", remedy=Remedy("convert it as such", ("video",))
        )


def _refuse_by_content(path: Path, picture: Any, views: int, panorama: bool) -> None:
    """Raise a FormatError for a panorama as one view, or an animation of more frames than views."""
    if views == 1 and not panorama and vr180.is_panorama(vr180.read_xmp(picture)):
        raise FormatError(
            f"{path}: expected an ordinary picture, found a VR180 picture or a 360-degree panorama "
            "(according to its XMP metadata)",
            remedy=Remedy("give it alone if it holds both eyes, or choose the projection", ("projection",)),
        )
    count = _count_frames(path, picture)
    if count > views:
        wanted = "one picture" if views == 1 else "one picture, or an animation of two frames, left and right"
        raise FormatError(
            f"{path}: expected {wanted}, found an animation of {count} frames; "
            "save its two views as separate pictures"
        )


def holds_depth(picture: Any) -> bool:
    """Return whether an open picture holds a depth map, as portraits of telephones do."""
    words = vr180.read_xmp(picture)
    # Google's depth map metadata, and Dynamic Depth 1.0.
    in_xmp = b"GDepth:" in words or b"http://ns.google.com/photos/dd/1.0/" in words
    return in_xmp or bool(picture.info.get("depth_images"))


def count_frames(path: Path) -> int:
    """Return the number of frames of an animation, or 1. Raises FormatError."""
    with _decoding(path), Image.open(path, formats=_KINDS) as picture:
        return _count_frames(path, picture)


def _count_frames(path: Path, picture: Any) -> int:
    """Return the number of frames of an animation, or 1; other formats hold other pictures in more frames."""
    if picture.format not in _ANIMATIONS:
        return 1
    with _decoding(path):
        return int(picture.n_frames)


def _to_eight_bits(path: str | Path, picture: Image.Image) -> tuple[Image.Image, str | None]:
    """Convert a loaded 16-bit grey picture, or a 32-bit one with 16-bit values, to 8-bit RGB.

    Returns it, with a note if its values seem to have fewer bits than the file says.
    """
    with _decoding(path):
        values = np.asarray(picture)
    if picture.mode == "F" or values.min() < 0 or values.max() > 65535:
        raise FormatError(
            f"{path}: expected {A_PICTURE}, found one with more than 16 bits per channel or with negative "
            f"values (mode {picture.mode}), which cannot be read"
        )
    bits = _count_bits(picture, values)
    note = None
    if bits == 16 and 0 < values.max() < LEAST_OF_SIXTEEN_BITS:
        note = f"nearly black: 16 bits with values up to {values.max()}; multiply values of 12 bits by 16"
    # Keep the upper byte, as Pillow does for 16-bit colour.
    return Image.fromarray((values >> (bits - 8)).astype(np.uint8)).convert("RGB"), note


def _count_bits(picture: Any, values: np.ndarray) -> int:
    """Return the number of bits of a grey picture's values: a 32-bit file may hold 8, a TIFF states 12."""
    if picture.mode == "I" and values.max() <= 255:
        return 8
    stated = picture.tag_v2.get(_BITS_PER_SAMPLE, (16,))[0] if picture.format == "TIFF" else 16
    return stated if 8 < stated < 16 else 16


def _convert_to_srgb(picture: Image.Image) -> tuple[Image.Image, str | None]:
    """Convert a picture to sRGB. Returns it, with a note if its colour profile was damaged or not sRGB."""
    profile = picture.info.get("icc_profile") or make_profile(picture.info.get("nclx_profile"))
    mode = _PROFILED.get(picture.mode)
    if not profile or mode is None:
        return picture, None
    from PIL import ImageCms

    try:
        stored = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        name = _clean_text(ImageCms.getProfileDescription(stored)) or "a profile without a name"
        if "srgb" in name.lower():
            return picture, None
        converted = ImageCms.profileToProfile(
            picture.convert(mode),
            stored,
            ImageCms.createProfile("sRGB"),
            renderingIntent=ImageCms.Intent.RELATIVE_COLORIMETRIC,
            outputMode="RGB",
            flags=ImageCms.Flags.BLACKPOINTCOMPENSATION,
        )
    except Exception as error:  # a damaged profile may raise any exception, as in `_decoding`
        return (
            picture,
            f"the colour profile cannot be used, so colours are taken to be sRGB ({_clean_text(str(error))})",
        )
    return converted or picture, f"colours converted from {name}"


def _clean_text(text: str) -> str:
    """Return text from a file in a form that is safe to show on one line."""
    return "".join(filter(str.isprintable, " ".join(text.split())))[:_LONGEST_WORDS]


def find_view_frames(path: Path, picture: Any) -> list[int]:
    """Return the indices of the frames that hold the views: of an MPO or HEIC file, or of a short animation.

    The left view of a HEIC file comes first. The list is empty if there is only one view.
    """
    if picture.format == heif.FORMAT:
        with _decoding(path):
            return heif.find_views(picture)
    if picture.format in _ANIMATIONS:
        return [0, 1] if _count_frames(path, picture) == 2 else []
    if picture.format != "MPO":
        return []
    with _decoding(path):
        entries = picture.mpinfo[_MP_ENTRIES]
        views = [index for index, entry in enumerate(entries) if entry["Attribute"]["MPType"] == _DISPARITY]
    if len(views) >= 2:
        return views[:2]
    size_px = picture.size
    for index in range(1, len(entries)):
        _seek(path, picture, index)
        if picture.size == size_px:
            return [0, index]
    _seek(path, picture, 0)
    return []


def read_frame(path: Path, picture: Image.Image, index: int) -> DecodedPicture:
    """Decode a frame of an MPO or HEIC file or an animation."""
    _seek(path, picture, index)
    check_size(path, picture.size)
    decoded = decode(path, picture)
    # A copy: Pillow reuses the memory for the next frame.
    return decoded._replace(image=decoded.image.copy())


def _seek(path: Path, picture: Image.Image, index: int) -> None:
    """Seek to a frame, and drop the tags and the profile of the previous one."""
    if picture.tell() == index:
        return
    # The frames of an MPO file have their own. Those of an animation share the file's, and a HEIC file
    # replaces them by itself.
    for key in ("mp", "icc_profile") if picture.format == "MPO" else ():
        picture.info.pop(key, None)
    try:
        with warnings.catch_warnings(action="ignore"):
            picture.seek(index)
    except Exception as error:  # a damaged file may raise any exception, as in `_decoding`
        raise FormatError(
            f"{path}: expected an undamaged {picture.format} file, found that picture {index + 1} is "
            f"truncated or damaged ({_clean_text(str(error))})"
        ) from error
