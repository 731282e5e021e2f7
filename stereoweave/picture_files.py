"""One file of a picture as a camera or an editor left it: refused by its name, or decoded, with its tags."""

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError, features

from stereoweave import exif
from stereoweave.errors import FormatError, reason

# 50 megapixels a view are supported, and cameras of that class have up to 64. Known from the file's head,
# before memory is spent.
MOST_PIXELS = 65_000_000
# Not all that Pillow opens: PostScript, for one, would run as a program. Of JPEG are MPO and JPS.
_KINDS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "GIF", "PPM", "AVIF", "JPEG2000")
A_PICTURE = "a picture (PNG, JPEG, TIFF or the like)"
_RAW_ENDINGS = {
    *(".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dng", ".erf", ".iiq", ".kdc", ".mrw", ".nef", ".nrw", ".orf"),
    *(".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw", ".x3f"),
}
_VIDEO_ENDINGS = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v", ".wmv")
_HEIF_BRANDS = {b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"}
_AVIF_BRANDS = {b"avif", b"avis"}
_MP_ENTRIES, _DISPARITY = 0xB002, "Multi-Frame Image: (Disparity)"
# How the colours of a mode are stored, where a profile can say what they mean.
_PROFILED = {"RGB": "RGB", "RGBA": "RGB", "P": "RGB", "L": "L", "LA": "L", "CMYK": "CMYK"}


# What Pillow says of a damaged file: an OverflowError of an infinite size, its AVIF a RuntimeError.
_UNREADABLE = (
    *(OSError, ValueError, OverflowError, SyntaxError, RuntimeError),
    Image.DecompressionBombError,
)


class Photograph(NamedTuple):
    """A decoded picture as it lies in its file, in sRGB; its tags; what was done to its colours."""

    image: Image.Image
    tags: exif.Tags
    note: str | None

    def upright(self, lies: int | None) -> UInt8[np.ndarray, "h w 3"]:
        """Its pixels, turned upright if it lies so."""
        return rgb(exif.turned(self.image, lies))


@contextmanager
def decoding(path: str | Path, expected: str) -> Iterator[None]:
    """Turns what goes wrong while a picture is decoded into a FormatError of one line."""
    try:
        # Pillow warns about odd tags before it gives up on a file; the error below says it in one line.
        with warnings.catch_warnings(action="ignore"):
            yield
    except FormatError:
        raise
    except UnidentifiedImageError as error:
        raise FormatError(f"{path}: expected {expected}, found something else") from error
    except _UNREADABLE as error:
        raise FormatError(f"{path}: expected {expected}, found {reason(error)}") from error


@contextmanager
def opening(path: Path, *, views: int) -> Iterator[Image.Image]:
    """An opened picture of one or two views, not yet decoded, whose size and kind can be worked with.

    Raises:
        FormatError: It cannot; or whatever goes wrong while the picture is open.
    """
    most = f"at most {views * MOST_PIXELS // 1_000_000} megapixels"
    with decoding(path, A_PICTURE):
        _refuse_by_name(path)
        try:
            picture = Image.open(path, formats=_KINDS)
        except Image.DecompressionBombError as error:
            raise FormatError(f"{path}: expected {most}, found more ({error}); scale it down") from error
        with picture:
            width_px, height_px = picture.size
            if width_px * height_px > views * MOST_PIXELS:
                raise FormatError(f"{path}: expected {most}, found {width_px}x{height_px}; scale it down")
            _refuse_by_content(path, picture)
            yield picture


def _refuse_by_name(path: Path) -> None:
    """Raise a FormatError for a kind that is not read, by the ending of the name or by the first bytes."""
    ending = path.suffix.lower()
    if ending in _RAW_ENDINGS:
        raise FormatError(
            f"{path}: expected {A_PICTURE}, found a camera's raw file; develop it to one of these first"
        )
    with path.open("rb") as file:
        head = file.read(64)
    brands = {head[start : start + 4] for start in (8, *range(16, 64, 4))} if head[4:8] == b"ftyp" else set()
    if brands & _AVIF_BRANDS:
        if not features.check("avif"):
            raise FormatError(f"{path}: expected {A_PICTURE}, found AVIF, which this Pillow does not read")
    elif brands & _HEIF_BRANDS:
        raise FormatError(
            f"{path}: expected {A_PICTURE}, found HEIC, such as a spatial photograph, which is not read; "
            "export it as two JPEG files, or as one with both views side by side"
        )
    elif brands or ending in _VIDEO_ENDINGS:
        raise FormatError(f"{path}: expected {A_PICTURE}, found a video; 'stereoweave video' takes those")


def _refuse_by_content(path: Path, picture: Any) -> None:
    """Raise a FormatError for a picture that is no plain photograph, or more than one."""
    description = picture.info.get("xmp", b"")
    words = description if isinstance(description, bytes) else str(description).encode()
    if b"GImage:" in words or b"equirectangular" in words.lower():
        raise FormatError(
            f"{path}: expected a photograph, found VR180 or a panorama of 360 degrees, by its XMP, "
            "which is not read; export two plain views from it"
        )
    if picture.format in ("GIF", "PNG", "WEBP", "AVIF") and picture.n_frames > 1:
        raise FormatError(
            f"{path}: expected one picture, found an animation of {picture.n_frames}; save its two views"
        )


def read_photograph(path: Path) -> Photograph:
    """The picture of a file that holds one view."""
    with opening(path, views=1) as picture:
        return decode(picture)


def decode(picture: Image.Image) -> Photograph:
    """The picture that was opened, or the frame of it at hand."""
    # First, since TIFF is turned upright by this, and then says so in its tags.
    picture.load()
    tags = exif.read_tags(picture)
    if picture.mode.startswith(("I", "F")):
        # Here, where a value that no photograph has is told with the file's name.
        return Photograph(Image.fromarray(rgb(picture)), tags, None)
    image, note = _in_srgb(picture)
    return Photograph(image, tags, note)


def rgb(picture: Image.Image) -> UInt8[np.ndarray, "h w 3"]:
    """The pixels of an opened picture in RGB: grey is repeated, alpha dropped, 16 bits become 8."""
    if not picture.mode.startswith(("I", "F")):
        # A copy: Pillow lends its pixels read-only, for which Numba compiles anew and PyTorch warns.
        return np.array(picture.convert("RGB"))
    values = np.asarray(picture)
    if picture.mode == "F" or values.min() < 0 or values.max() > 65535:
        raise ValueError(f"more than 16 bits a channel or values below 0, mode {picture.mode}")
    # The upper byte, as Pillow reduces colour pictures of 16 bits; a file of 32 bits may hold 8 of them.
    bits = 8 if picture.mode != "I" or values.max() > 255 else 0
    return np.repeat((values >> bits).astype(np.uint8)[..., None], 3, axis=2)


def _in_srgb(picture: Image.Image) -> tuple[Image.Image, str | None]:
    """The picture with its colours in sRGB, and in words what was done for that, if anything."""
    profile, mode = picture.info.get("icc_profile"), _PROFILED.get(picture.mode)
    if not profile or mode is None:
        return picture, None
    from PIL import ImageCms

    try:
        stored = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        name = " ".join(ImageCms.getProfileDescription(stored).split()) or "a profile without a name"
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
    except (ImageCms.PyCMSError, OSError) as error:
        return picture, f"the colour profile cannot be used, colours are taken as sRGB ({error})"
    return converted or picture, f"colours converted from {name}"


def view_frames(path: Path, picture: Any) -> list[int]:
    """The numbers of the two frames of an MPO file that are its views; none if the others are previews."""
    if picture.format != "MPO":
        return []
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


def read_frame(path: Path, picture: Image.Image, index: int) -> Photograph:
    """One of the pictures of an MPO file."""
    _seek(path, picture, index)
    if picture.width * picture.height > MOST_PIXELS:
        raise FormatError(
            f"{path}: expected at most {MOST_PIXELS // 1_000_000} megapixels a view, "
            f"found {picture.width}x{picture.height}; scale it down"
        )
    photograph = decode(picture)
    # A copy: Pillow decodes the next frame into the same place.
    return photograph._replace(image=photograph.image.copy())


def _seek(path: Path, picture: Image.Image, index: int) -> None:
    """Goes to a frame of an MPO file, whose tags and profile are then its own, and not of one before it."""
    if picture.tell() == index:
        return
    for key in ("mp", "icc_profile"):
        picture.info.pop(key, None)
    try:
        picture.seek(index)
    except (OSError, ValueError, SyntaxError) as error:
        raise FormatError(
            f"{path}: expected an MPO file of whole pictures, found number {index + 1} cut off or damaged "
            f"({error})"
        ) from error
