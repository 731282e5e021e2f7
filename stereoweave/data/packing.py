"""Packing of a pair and its ground truth into the bytes of a few files.

    left.webp, right.webp, view_0.50.webp           lossless
    disparity.png, right_disparity.png              16 bits: pixels * steps_per_px; 65535 is unknown
    occluded.png, right_occluded.png                1 bit
    camera.json                                     the camera in pixels and metres, and steps_per_px

A rendered 640x480 pair takes 0.4 to 1.2 MB, or 0.87 MB on average (17 pairs from all scenes). On one core,
packing takes 25 to 60 ms and unpacking takes 22 ms.

KITTI's PNG format is unsuitable, because 0 means unknown in that format, but the sky has a known disparity of
0.
"""

import io
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8
from PIL import Image

from stereoweave.errors import StereoweaveError
from stereoweave.io.decoding import decode_packed_values
from stereoweave.stereo import Sample, StereoCamera

_UNKNOWN = 65535
# The rounding error is at most half a step, 0.0005 px; each doubling costs 20 kB per map.
_MOST_STEPS_PER_PX = 1024
# Data type and channels of a pixel.
_Kind = tuple[type[np.generic], tuple[int, ...]]
_RGB: _Kind = np.uint8, (3,)
_STEPS: _Kind = np.uint16, ()
_MASK: _Kind = np.bool_, ()

# Mean of four pictures of 640x480 on one core: 379 kB in 7 ms. Method 1 takes 31 ms for 365 kB, method 4
# takes 96 ms for 352 kB, and PNG takes 8 to 23 ms for 434 to 466 kB.
_WEBP = {"lossless": True, "method": 0, "quality": 0}
# Mean of four rendered disparity maps, 512 steps per pixel: 145 kB in 10 ms. Level 6 takes 26 ms for 129 kB,
# and OpenCV's default takes 6 ms for 246 kB. A float32 TIFF would be exact, but takes 27 ms for 378 kB.
_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 3, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB)


def pack(sample: Sample, views: Mapping[float, UInt8[np.ndarray, "h w 3"]]) -> dict[str, bytes]:
    """Pack a pair into files, and return the contents of the files by name.

    Args:
        sample: The pair and its ground truth, with disparities of 0 or more; NaN means unknown.
        views: Additional views by position.
    """
    disparities_px = {
        "disparity.png": sample.disparity_px,
        "right_disparity.png": sample.right_disparity_px,
    }
    pictures = {"left.webp": sample.left, "right.webp": sample.right}
    pictures |= {f"view_{position:.2f}.webp": image for position, image in views.items()}
    masks = {"occluded.png": sample.occluded, "right_occluded.png": sample.right_occluded}
    steps_per_px = _choose_steps_per_px(disparities_px.values())
    facts = {"steps_per_px": steps_per_px, "camera": asdict(sample.camera) if sample.camera else None}
    return {
        **{name: _encode(image, "WEBP", **_WEBP) for name, image in pictures.items()},
        **{name: _encode_disparity(values, steps_per_px) for name, values in disparities_px.items()},
        **{name: _encode(mask, "PNG") for name, mask in masks.items()},
        "camera.json": json.dumps(facts, indent=1).encode(),
    }


def unpack(files: Mapping[str, bytes]) -> Sample:
    """Unpack a sample from the files that `pack` makes.

    Raises:
        ValueError: A file is missing or invalid.
    """
    steps_per_px, camera = _parse_camera(_require_file(files, "camera.json"))
    left = _decode(files, "left.webp", _RGB)

    def require_size(name: str, kind: _Kind) -> Shaped[np.ndarray, "h w *channels"]:
        values = _decode(files, name, kind)
        if values.shape[:2] != left.shape[:2]:
            raise ValueError(
                f"{name}: expected the same size as left.webp, found {values.shape[1]}x{values.shape[0]} px"
            )
        return values

    def disparity_px(name: str) -> Float[np.ndarray, "h w"]:
        steps = require_size(name, _STEPS)
        return np.where(steps == _UNKNOWN, np.nan, steps / steps_per_px).astype(np.float32)

    return Sample(
        left=left,
        right=require_size("right.webp", _RGB),
        disparity_px=disparity_px("disparity.png"),
        right_disparity_px=disparity_px("right_disparity.png"),
        occluded=require_size("occluded.png", _MASK),
        right_occluded=require_size("right_occluded.png", _MASK),
        camera=camera,
    )


def unpack_views(files: Mapping[str, bytes]) -> dict[float, UInt8[np.ndarray, "h w 3"]]:
    """Unpack the additional views, by position, from the files that `pack` makes.

    Raises:
        ValueError: A view is invalid.
    """
    names = sorted(name for name in files if name.startswith("view_"))
    return {float(name[len("view_") : -len(".webp")]): _decode(files, name, _RGB) for name in names}


def _parse_camera(content: bytes) -> tuple[int, StereoCamera | None]:
    """Parse the content of camera.json; return the steps per pixel and the camera."""
    try:
        match json.loads(content):
            case {"steps_per_px": int(steps), "camera": None} if 0 < steps <= _MOST_STEPS_PER_PX:
                return steps, None
            case {"steps_per_px": int(steps), "camera": dict(camera)} if 0 < steps <= _MOST_STEPS_PER_PX:
                return steps, StereoCamera(**{name: float(value) for name, value in camera.items()})
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise ValueError(f"camera.json cannot be parsed: {error}") from error
    raise ValueError("camera.json: steps_per_px or camera is missing or invalid")


def _choose_steps_per_px(disparities_px: Iterable[Float[np.ndarray, "h w"]]) -> int:
    """Return the largest number of steps per pixel for which all disparities fit in 16 bits.

    The number is a power of two, which makes division exact, and at most 1024.
    """
    known_px = np.concatenate([values[~np.isnan(values)] for values in disparities_px])
    least_px, most_px = known_px.min(initial=0), known_px.max(initial=0)
    if least_px < 0 or most_px >= _UNKNOWN:
        raise StereoweaveError(
            f"pair to pack: expected disparities from 0 to {_UNKNOWN - 1} px, or NaN where unknown, "
            f"found disparities from {least_px:g} to {most_px:g} px"
        )
    return min(_MOST_STEPS_PER_PX, 2 ** int(math.log2((_UNKNOWN - 1) / max(most_px, 1))))


def _encode_disparity(disparity_px: Float[np.ndarray, "h w"], steps_per_px: int) -> bytes:
    steps = np.rint(disparity_px * steps_per_px)
    done, png = cv2.imencode(".png", np.where(np.isnan(steps), _UNKNOWN, steps).astype(np.uint16), _PNG)
    assert done
    return png.tobytes()


def _encode(image: UInt8[np.ndarray, "h w 3"] | Bool[np.ndarray, "h w"], kind: str, **options: Any) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, kind, **options)
    return stream.getvalue()


def _require_file(files: Mapping[str, bytes], name: str) -> bytes:
    if name not in files:
        raise ValueError(f"{name} is missing")
    return files[name]


def _decode(files: Mapping[str, bytes], name: str, kind: _Kind) -> Shaped[np.ndarray, "h w *channels"]:
    """Decode a picture, and require the given data type and number of channels."""
    values = decode_packed_values(name, _require_file(files, name))
    if (values.dtype.type, values.shape[2:]) != kind:
        raise ValueError(f"{name} has an unexpected data type or number of channels")
    return values
