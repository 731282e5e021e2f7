"""Camera raw files, which rawpy (LibRaw) develops: colours, size and orientation."""

import os
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from PIL import Image
from PIL.ExifTags import Base

from stereoweave.errors import FormatError, Remedy, StereoweaveError, require_extra

ENDINGS = frozenset(
    {
        *(".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dng", ".erf", ".iiq", ".kdc", ".mrw", ".nef", ".nrw"),
        *(".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw", ".x3f"),
    }
)
FORMAT = "RAW"
# Of Fujifilm, Panasonic, Olympus (three), Sigma and Minolta.
_BEGINNINGS = (b"FUJIFILMCCD-RAW", b"IIU\0", b"IIRO", b"IIRS", b"MMOR", b"FOVb", b"\0MRM")
_TIFF = (b"II*\0", b"MM\0*")
# Tags of TIFF and DNG, and the value of a colour filter array.
_SUBFILE_TYPE, _PHOTOMETRIC, _SUBDIRECTORIES, _DNG_VERSION, _FILTER_ARRAY = 254, 262, 330, 50706, 32803
# The exponent and the slope of sRGB's curve.
_SRGB_CURVE = (2.4, 12.92)
# LibRaw's turns by a quarter have this bit.
_QUARTER_TURN = 4
_EXIF, _LONGEST_SEGMENT = b"Exif\0\0", 65_533  # of a JPEG
_LAST_ROWS_SHARE = 32
# Two threads that discard at once would restore each other's discarding.
_STDERR, _MUTED = 2, threading.Lock()


def is_raw(path: Path, head: bytes) -> bool:
    """Return whether a file is a raw one, by its ending, its first 64 bytes or, of a TIFF file, its tags."""
    if path.suffix.lower() in ENDINGS or head.startswith(_BEGINNINGS):
        return True
    is_canon = head[6:14] == b"HEAPCCDR" or head[8:10] == b"CR" or head[4:12] == b"ftypcrx "
    return is_canon or (head.startswith(_TIFF) and _has_raw_tags(path))


def _has_raw_tags(path: Path) -> bool:
    """Return whether a TIFF file is a raw file, of which Pillow would open a preview, if anything.

    It is DNG, or a colour filter array, or its first picture is a smaller copy of one in a subdirectory.
    """
    tags = Image.Exif()
    # Damaged tags may raise any exception, and warnings; the file is then opened as an ordinary TIFF file.
    with suppress(Exception), warnings.catch_warnings(action="ignore"), path.open("rb") as file:
        tags.load_from_fp(file)
        is_preview = tags.get(_SUBFILE_TYPE) == 1 and _SUBDIRECTORIES in tags
        return _DNG_VERSION in tags or tags.get(_PHOTOMETRIC) == _FILTER_ARRAY or is_preview
    return False


class RawImage(Image.Image):
    """A raw file as an image of Pillow's, RGB, upright, which is developed when it is loaded.

    Attributes:
        sensor_size_px: Width and height of the stored values, borders included.
    """

    format = FORMAT

    def __init__(self, path: Path, raw: Any) -> None:
        super().__init__()
        sizes = raw.sizes
        size_px = sizes.width, sizes.height
        self._mode = "RGB"
        self._size = size_px[::-1] if sizes.flip & _QUARTER_TURN else size_px
        self.sensor_size_px = sizes.raw_width, sizes.raw_height
        self._path, self._raw, self._is_loaded = path, raw, False

    def load(self) -> Any:
        """Develop the picture: the camera's white balance, sRGB, 8 bits, turned upright.

        Raises:
            FormatError: The file is damaged.
        """
        if not self._is_loaded:
            with _muting():
                _calling_libraw(self._path, self._raw.unpack)
            self._check_complete()
            # Brightening each picture by its own histogram, as is usual, would make the two views unlike.
            pixels = _calling_libraw(
                self._path,
                lambda: self._raw.postprocess(use_camera_wb=True, no_auto_bright=True, gamma=_SRGB_CURVE),
            )
            developed = Image.fromarray(pixels)
            self.im, self._size, self._is_loaded = developed.im, developed.size, True
        return super().load()

    def _check_complete(self) -> None:
        """Raise a FormatError if the last rows are empty: LibRaw reads a file that was cut off to its end."""
        import rawpy

        if self._raw.raw_type != rawpy.RawType.Flat:
            return
        rows = self._raw.raw_image
        if not rows[-max(len(rows) // _LAST_ROWS_SHARE, 1) :].any():
            raise FormatError(
                f"{self._path}: expected a picture, found a camera raw file whose last rows are empty",
                remedy=Remedy("copy it again"),
            )

    def getexif(self) -> Image.Exif:
        """Return the tags of the file or, if it is no TIFF file, of its preview, without an orientation."""
        tags = Image.Exif()
        try:
            with self._path.open("rb") as file:
                tags.load_from_fp(file)
        except SyntaxError:  # the file is no TIFF
            preview = bytes(self._raw.extract_thumb().data)
            start = preview.index(_EXIF)
            tags.load(preview[start : start + _LONGEST_SEGMENT])
        tags.pop(Base.Orientation, None)
        return tags

    def __exit__(self, *error: object) -> None:
        self._raw.close()


def open_raw(path: Path) -> RawImage:
    """Open a raw file without developing it.

    Raises:
        FormatError: rawpy is not installed, or LibRaw cannot read the file.
    """
    try:
        with require_extra("raw", f"{path}: expected a picture, found a camera raw file, which needs rawpy"):
            import rawpy
    except StereoweaveError as missing:
        raise FormatError.from_error(missing) from missing
    raw = rawpy.RawPy()
    with _muting():
        _calling_libraw(path, lambda: raw.open_file(str(path)))
    return RawImage(path, raw)


@contextmanager
def _muting() -> Iterator[None]:
    """Discard what is written to stderr: LibRaw itself writes a line about damage there, beside our error."""
    with _MUTED:
        try:
            kept = os.dup(_STDERR)
        except OSError:  # a process without stderr
            yield
            return
        with Path(os.devnull).open("wb") as nowhere:
            os.dup2(nowhere.fileno(), _STDERR)
        try:
            yield
        finally:
            os.dup2(kept, _STDERR)
            os.close(kept)


def _calling_libraw(path: Path, call: Any) -> Any:
    """Return what a call of LibRaw returns. Raises FormatError for an error of LibRaw."""
    import rawpy

    try:
        return call()
    except rawpy.LibRawError as error:
        words = error.args[0] if error.args else ""
        said = words.decode(errors="replace") if isinstance(words, bytes) else str(words)
        raise FormatError(
            f"{path}: expected a picture, found a camera raw file that LibRaw cannot read ({said}); "
            "convert it to DNG, TIFF or JPEG"
        ) from error
