"""Pictures as other libraries hold them, NumPy arrays, PIL images, torch tensors, become uint8 RGB."""

import numpy as np
from jaxtyping import Shaped, UInt8
from PIL import Image

from stereoweave.arguments import is_plain_array
from stereoweave.errors import StereoweaveError

_CHANNELS = (1, 3, 4)
# As a share of white: it is less than half a level, so that it rounds to 0 or 255.
_FORGIVEN = 0.4 / 255
# What Pillow cannot turn into RGB in one step.
_BETWEEN = {"La": "LA", "RGBa": "RGBA"}


def as_rgb(image: object, name: str = "image") -> UInt8[np.ndarray, "h w 3"]:
    """The picture as uint8 RGB [H, W, 3], contiguous; an array that is one already is given back as it is.

    Grey is repeated, alpha dropped, 16 bits become the upper 8; a float is a share of white, 0 to 1, and is
    rounded. The axis of 1, 3 or 4 channels is the last one, or, where that has another length, the first. So
    [3, W, 3] counts as 3 rows of W pixels. A leading axis of length 1, a batch of one picture, is dropped.

    The order of the channels cannot be told from an array: what OpenCV reads is BGR, and has to be turned by
    `image[..., ::-1]` first. A PIL image is taken as its pixels lie: `PIL.ImageOps.exif_transpose` turns it
    upright.

    Args:
        image: A NumPy array, a PIL image of any mode that has colours, or a torch tensor on any device.
        name: What an error calls the picture.

    Raises:
        StereoweaveError: Another kind of thing, shape or dtype, or a float outside of 0..1.
    """
    if isinstance(image, Image.Image):
        image = _of_pil(image)
    elif hasattr(image, "detach"):  # a tensor; PyTorch itself is not needed to ask it for its numbers
        tensor = image.detach().cpu()
        # NumPy has no bfloat16.
        image = (tensor.float() if tensor.is_floating_point() else tensor).numpy()
    if isinstance(image, np.matrix):
        image = np.asarray(image)
    if not is_plain_array(image):
        raise StereoweaveError(
            f"{name}: expected a NumPy array, a PIL image or a torch tensor, got {type(image).__name__}; "
            "PIL.Image.open reads a file"
        )
    levels = _channels_last(_eight_bits(image, name), name)
    match levels.shape[2]:
        case 1:
            return np.repeat(levels, 3, axis=2)
        case 4:
            return np.ascontiguousarray(levels[..., :3])
    return np.ascontiguousarray(levels)


def _of_pil(picture: Image.Image) -> Shaped[np.ndarray, "h w *channels"]:
    if not picture.mode.startswith(("I", "F")):
        direct = picture.convert(_BETWEEN[picture.mode]) if picture.mode in _BETWEEN else picture
        # A copy: Pillow lends its pixels read-only, for which Numba compiles anew and PyTorch warns.
        return np.array(direct.convert("RGB"))
    values = np.asarray(picture)
    if picture.mode == "I" and values.size and values.min() >= 0 and values.max() <= 65535:
        # Mode I has 32 bits, and what files hold in it 16 or 8, as `io.read_image` takes it.
        return values.astype(np.uint16 if values.max() > 255 else np.uint8)
    return values


def _eight_bits(values: Shaped[np.ndarray, "..."], name: str) -> UInt8[np.ndarray, "..."]:
    if values.dtype == np.uint8:
        return values
    if values.dtype.kind == "u" and values.dtype.itemsize == 2:
        return (values >> 8).astype(np.uint8)
    got = f"{values.dtype} {list(values.shape)}"
    if values.dtype.kind != "f":
        raise StereoweaveError(
            f"{name}: expected uint8, uint16 or a float in 0..1, got {got}; convert 0..255 by astype('uint8')"
        )
    # Not the opposite comparison, which would let NaN pass; and before the product, which may overflow.
    if not ((values >= -_FORGIVEN) & (values <= 1 + _FORGIVEN)).all():
        raise StereoweaveError(
            f"{name}: expected floats in 0..1, got {got} of {values.min():g} to {values.max():g}; "
            "divide 0..255 by 255, and fill NaN"
        )
    return np.rint(values * 255.0).astype(np.uint8)


def _channels_last(levels: UInt8[np.ndarray, "..."], name: str) -> UInt8[np.ndarray, "h w channels"]:
    picture = levels[0] if levels.ndim == 4 and len(levels) == 1 else levels
    if picture.ndim == 2:
        return picture[..., None]
    if picture.ndim == 3 and picture.shape[2] in _CHANNELS:
        return picture
    if picture.ndim == 3 and picture.shape[0] in _CHANNELS:
        return np.moveaxis(picture, 0, 2)
    raise StereoweaveError(
        f"{name}: expected one picture, [H, W], [H, W, 3], [H, W, 4] or [3, H, W], got "
        f"{list(levels.shape)}; hand in one picture at a time, channels last"
    )
