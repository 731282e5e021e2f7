"""Conversion of images in the forms that callers have them to uint8 RGB."""

from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Shaped, UInt8
from PIL import Image

from stereoweave.arguments import is_plain_array
from stereoweave.errors import StereoweaveError
from stereoweave.io.decoding import LEAST_OF_SIXTEEN_BITS
from stereoweave.io.images import read_image

_CHANNELS = (1, 3, 4)
# Tolerance beyond 0..1: less than half a level, so that such a value still rounds to 0 or 255.
_FORGIVEN = 0.4 / 255
# Modes that Pillow cannot convert to RGB in one step.
_BETWEEN = {"La": "LA", "RGBa": "RGBA"}


@runtime_checkable
class Tensor(Protocol):
    """PyTorch tensor, recognised by its methods, so that PyTorch is not imported."""

    def detach(self) -> Any: ...


# Everything that `as_rgb` accepts.
ImageLike = str | Path | Image.Image | np.ndarray | Tensor


def as_rgb(image: ImageLike, name: str = "image") -> UInt8[np.ndarray, "h w 3"]:
    """Convert an image to contiguous uint8 RGB [H, W, 3]; an array already in this form is not copied.

    Grey is repeated in all three channels, and alpha is dropped. Values of uint16, which must use all 16
    bits, are reduced to their upper 8 bits; floats in 0..1 are scaled and rounded. The channels are the
    last axis if its length is 1, 3 or 4, else the first axis, so [3, W, 3] means 3 rows of W pixels. A
    batch of one image loses its leading axis.
    A path is read by `read_image`.

    Channels are taken to be RGB: reverse OpenCV's BGR images with `image[..., ::-1]` first. The EXIF
    orientation of a PIL image is ignored: apply `PIL.ImageOps.exif_transpose` first.

    Args:
        image: NumPy array, PIL image of any colour mode, PyTorch tensor on any device, or path of a picture.
        name: Name of the image in error messages.

    Raises:
        StereoweaveError: The type, shape or dtype is unsupported, a float is outside 0..1, or values of
            uint16 are below 4096; FormatError for a picture that cannot be read.
    """
    if isinstance(image, str | Path):
        return read_image(image)
    if isinstance(image, Image.Image):
        image = _convert_pil(image)
    elif isinstance(image, Tensor):
        tensor = image.detach().cpu()
        # NumPy has no bfloat16.
        image = (tensor.float() if tensor.is_floating_point() else tensor).numpy()
    if isinstance(image, np.matrix):
        image = np.asarray(image)
    if not is_plain_array(image):
        raise StereoweaveError(
            f"{name}: expected a path, a NumPy array, a PIL image or a torch tensor, "
            f"got {describe_kind(image)}"
        )
    levels = _move_channels_last(_to_eight_bits(image, name), name)
    match levels.shape[2]:
        case 1:
            return np.repeat(levels, 3, axis=2)
        case 4:
            return np.ascontiguousarray(levels[..., :3])
    return np.ascontiguousarray(levels)


def describe_kind(image: object) -> str:
    """Name the type of what was passed as an image; for None, with the likely cause and the remedy."""
    if image is None:
        return "None, which cv2.imread returns for a file that it cannot read; check the path"
    return type(image).__name__


def _convert_pil(picture: Image.Image) -> Shaped[np.ndarray, "h w *channels"]:
    if not picture.mode.startswith(("I", "F")):
        direct = picture.convert(_BETWEEN[picture.mode]) if picture.mode in _BETWEEN else picture
        # A copy: Pillow's read-only pixels would make Numba compile again and PyTorch warn.
        return np.array(direct.convert("RGB"))
    values = np.asarray(picture)
    if picture.mode == "I" and values.size and values.min() >= 0 and values.max() <= 65535:
        # Mode I has 32 bits, but holds the 16-bit or 8-bit values of files; `io.read_image` does the same.
        return values.astype(np.uint16 if values.max() > 255 else np.uint8)
    return values


def _to_eight_bits(values: Shaped[np.ndarray, "..."], name: str) -> UInt8[np.ndarray, "..."]:
    if values.dtype == np.uint8:
        return values
    got = f"{values.dtype} {list(values.shape)}"
    if values.dtype.kind == "u" and values.dtype.itemsize == 2:
        if values.size and 0 < values.max() < LEAST_OF_SIXTEEN_BITS:
            raise StereoweaveError(
                f"{name}: expected uint16 values that use 0..65535, got {got} up to {values.max()}; "
                "multiply values of 12 bits by 16, of 10 bits by 64, or, if the image is so dark, give "
                "(image >> 8).astype('uint8')"
            )
        return (values >> 8).astype(np.uint8)
    if values.dtype.kind != "f":
        remedy = "convert values in 0..255 with astype('uint8')"
        if values.dtype.kind == "b":
            remedy = "convert black and white with astype('uint8') * 255"
        raise StereoweaveError(f"{name}: expected uint8, uint16 or floats in 0..1, got {got}; {remedy}")
    # The negated condition also rejects NaN. It precedes the product below, which may overflow.
    if not ((values >= -_FORGIVEN) & (values <= 1 + _FORGIVEN)).all():
        raise StereoweaveError(
            f"{name}: expected floats in 0..1, got {got} from {values.min():g} to {values.max():g}; "
            "divide values in 0..255 by 255, and replace NaN"
        )
    return np.rint(values * 255.0).astype(np.uint8)


def _move_channels_last(levels: UInt8[np.ndarray, "..."], name: str) -> UInt8[np.ndarray, "h w channels"]:
    picture = levels[0] if levels.ndim == 4 and len(levels) == 1 else levels
    if picture.ndim == 2:
        return picture[..., None]
    if picture.ndim == 3 and picture.shape[2] in _CHANNELS:
        return picture
    if picture.ndim == 3 and picture.shape[0] in _CHANNELS:
        return np.moveaxis(picture, 0, 2)
    raise StereoweaveError(
        f"{name}: expected one image of shape [H, W], [H, W, 3], [H, W, 4] or [3, H, W], got "
        f"{list(levels.shape)}; pass one image at a time, channels last"
    )
