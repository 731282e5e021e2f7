"""Camera raw files, which rawpy (LibRaw) develops: colours, size and orientation."""

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
# The exponent and the slope of sRGB's curve.
_SRGB_CURVE = (2.4, 12.92)
# LibRaw's turns by a quarter have this bit.
_QUARTER_TURN = 4
_EXIF, _LONGEST_SEGMENT = b"Exif\0\0", 65_533  # of a JPEG
_LAST_ROWS_SHARE = 32


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
    _calling_libraw(path, lambda: raw.open_file(str(path)))
    return RawImage(path, raw)


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
