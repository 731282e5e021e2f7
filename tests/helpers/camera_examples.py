"""Pairs as imperfect cameras take them, with the places of the same points in both pictures."""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from stereoweave.stereo import StereoPair

# Maps places in the taken picture to places in the original one.
Source = Callable[[Float[np.ndarray, "n 2"]], Float[np.ndarray, "n 2"]]
_INVERSION_STEPS, _INVERSION_STEP = 80, 0.7


class Taken(NamedTuple):
    """A pair, and places in px at which its pictures show the same points."""

    pair: StereoPair
    left_px: Float[np.ndarray, "n 2"]
    right_px: Float[np.ndarray, "n 2"]


def take(original: Taken, left: Source, right: Source) -> Taken:
    """Return the pair as cameras with these mappings take it."""
    images, places_px = [], []
    for image, before_px, source in (
        (original.pair.left, original.left_px, left),
        (original.pair.right, original.right_px, right),
    ):
        images.append(_remap(image, source))
        places_px.append(_invert(before_px, source))
    return Taken(StereoPair(left=images[0], right=images[1]), *places_px)


def turn(size: tuple[int, int], degrees: tuple[float, float, float], scale: float = 1.0) -> Source:
    """Return the mapping of a camera turned about three axes, whose focal length is `scale` widths."""
    width, height = size
    camera = np.array([[width, 0, (width - 1) / 2], [0, width, (height - 1) / 2], [0, 0, 1]])
    zoomed = camera @ np.diag([1 / scale, 1 / scale, 1]) @ np.linalg.inv(camera)
    homography = camera @ cv2.Rodrigues(np.radians(np.float64(degrees)))[0] @ np.linalg.inv(camera) @ zoomed
    return lambda places_px: cv2.perspectiveTransform(places_px[None], homography)[0]


def wide_lens(size: tuple[int, int], strength: float) -> Source:
    """Return the mapping of a lens with barrel distortion that keeps the corners in place."""
    centre_px = (np.array(size) - 1) / 2
    radius_px = np.hypot(*size) / 2

    def source(places_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        away = (places_px - centre_px) / radius_px
        squares = (away**2).sum(1, keepdims=True)
        return centre_px + radius_px * away * (1 - strength) / (1 - strength * squares)

    return source


def rolling_shutter(size: tuple[int, int], sway_px: float) -> Source:
    """Return the mapping of a camera that nodded while the rows were read one after the other."""
    height = size[1]

    def source(places_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        moved_px = places_px.copy()
        moved_px[:, 1] += sway_px * np.sin(2 * np.pi * places_px[:, 1] / height)
        return moved_px

    return source


def _remap(image: UInt8[np.ndarray, "h w 3"], source: Source) -> UInt8[np.ndarray, "h w 3"]:
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    places_px = source(np.column_stack([columns.ravel(), rows.ravel()]).astype(float)).astype(np.float32)
    x, y = (places_px[:, axis].reshape(rows.shape) for axis in (0, 1))
    return cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def _invert(places_px: Float[np.ndarray, "n 2"], source: Source) -> Float[np.ndarray, "n 2"]:
    found_px = places_px.copy()
    for _ in range(_INVERSION_STEPS):
        found_px += _INVERSION_STEP * (places_px - source(found_px))
    return found_px
