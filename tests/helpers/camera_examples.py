"""Pairs as imperfect cameras take them, with the places of the same points in both pictures."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from experiments.handheld.warps import Source, invert, remap
from stereoweave.stereo import StereoPair


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
        images.append(remap(image, source))
        places_px.append(invert(before_px, source))
    return Taken(StereoPair(left=images[0], right=images[1]), *places_px)


def turn(size: tuple[int, int], degrees: tuple[float, float, float], scale: float = 1.0) -> Source:
    """Return the mapping of a camera turned about three axes, whose focal length is `scale` widths."""
    width, height = size
    camera = np.array([[width, 0, (width - 1) / 2], [0, width, (height - 1) / 2], [0, 0, 1]])
    zoomed = camera @ np.diag([1 / scale, 1 / scale, 1]) @ np.linalg.inv(camera)
    homography = camera @ cv2.Rodrigues(np.radians(np.float64(degrees)))[0] @ np.linalg.inv(camera) @ zoomed
    return lambda places_px: cv2.perspectiveTransform(places_px[None], homography)[0]
