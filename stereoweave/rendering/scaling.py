"""Scaling of a pair together with its estimate and camera."""

import cv2
import numpy as np

from stereoweave.stereo import Estimate, StereoPair, scale_camera


def fit_size(shape: tuple[int, ...], largest_px: tuple[int, int]) -> tuple[int, int]:
    """Return width and height of an image scaled down, never up, to fit a width and a height."""
    height, width = shape[:2]
    scale = min(1.0, largest_px[0] / width, largest_px[1] / height)
    return max(1, round(width * scale)), max(1, round(height * scale))


def scale_down(pair: StereoPair, estimate: Estimate, size_px: tuple[int, int]) -> tuple[StereoPair, Estimate]:
    """Return the pair and its estimate at a smaller size, with disparities and camera scaled along.

    Args:
        pair: The pair.
        estimate: The pair's estimate.
        size_px: Width and height of the result, in the pair's proportions and not above its size.
    """
    height, width = pair.left.shape[:2]
    if size_px == (width, height):
        return pair, estimate
    scale_x, scale_y = size_px[0] / width, size_px[1] / height
    left, right = (
        cv2.resize(image, size_px, interpolation=cv2.INTER_AREA) for image in (pair.left, pair.right)
    )
    seen = [None if x is None else resize_nearest(x, size_px) for x in (pair.left_seen, pair.right_seen)]
    camera = None if pair.camera is None else scale_camera(pair.camera, scale_x, scale_y)
    small = StereoPair(left=left, right=right, camera=camera, left_seen=seen[0], right_seen=seen[1])
    return small, Estimate(
        disparity_px=resize_nearest(estimate.disparity_px, size_px) * np.float32(scale_x),
        right_disparity_px=resize_nearest(estimate.right_disparity_px, size_px) * np.float32(scale_x),
        confidence=resize_nearest(estimate.confidence, size_px),
        occluded=resize_nearest(estimate.occluded, size_px),
    )


def resize_nearest(values: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """Resize a map to a width and height by nearest neighbour.

    Means across depth edges would lie on no surface.
    """
    numbers = values.view(np.uint8) if values.dtype == bool else values
    return cv2.resize(numbers, size_px, interpolation=cv2.INTER_NEAREST_EXACT).view(values.dtype)
