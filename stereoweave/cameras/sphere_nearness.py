"""Distances found in a window, as an equirectangular map."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from stereoweave.cameras.sphere_windows import BLIND_DEG, Window
from stereoweave.cameras.spherical import Map, Projection

_BAND_ROWS = 256
# Share of a window's width and height over which its weight rises from 0 at its border.
_RISE = 0.1
# Weight of pixels without any confidence, which nothing better may cover.
_LEAST_WEIGHT = 1e-3


class MatchedWindow(NamedTuple):
    """A window with what was found in it.

    Attributes:
        window: Its geometry.
        nearness: 1 / distance of each pixel, in 1 / baselines.
        confidence: Confidence of each pixel, 0..1.
        seen: Mask of the pixels that both eyes' pictures cover; None if they cover all.
    """

    window: Window
    nearness: Map
    confidence: Map
    seen: Bool[np.ndarray, "h w"] | None = None


class SphereNearness(NamedTuple):
    """Equirectangular maps [H, W]: 1 / distance in 1 / baselines, NaN where unknown, and confidence."""

    nearness: Float32[np.ndarray, "h w"]
    confidence: Float32[np.ndarray, "h w"]


def spread_nearness(
    matched: MatchedWindow, projection: Projection, size_px: tuple[int, int]
) -> SphereNearness:
    """Return what was found in a window, in the directions of an equirectangular image.

    It is unknown outside the window, and where less than a quarter of the baseline is left. Where both ends
    of a circle show the same directions, they are weighted by confidence and by the distance to the border.
    Nearness, and not distance, is averaged: its errors are as large far away as they are near.

    Args:
        matched: The window with what was found in it.
        projection: Equirectangular projection of the result.
        size_px: Width and height of the result.
    """
    nearness = np.full((size_px[1], size_px[0]), np.nan, np.float32)
    confidence = np.zeros_like(nearness)
    for start in range(0, size_px[1], _BAND_ROWS):
        rows = slice(start, start + _BAND_ROWS)
        rays = projection.rays(size_px, rows)
        total, near, sure = (np.zeros(rays.shape[1:], np.float32) for _ in range(3))
        columns, lines = matched.window.find(rays)
        for shift in matched.window.repeats_px:
            weight, found, trust = _sample(matched, columns + shift, lines)
            total += weight
            near += weight * found
            sure += weight * trust
        known = (total > 0) & (matched.window.blindness_deg(rays) <= BLIND_DEG)
        nearness[rows][known] = near[known] / total[known]
        confidence[rows][known] = sure[known] / total[known]
    return SphereNearness(nearness, confidence)


def _sample(matched: MatchedWindow, columns: Map, lines: Map) -> tuple[Map, Map, Map]:
    """Return the weights, the nearness and the confidence of a window's pixels; the weight is 0 outside."""
    width_px, height_px = matched.window.size_px
    across = np.minimum(columns, width_px - 1 - columns) / (_RISE * width_px)
    down = np.minimum(lines, height_px - 1 - lines) / (_RISE * height_px)
    inside = (across > -0.5 / (_RISE * width_px)) & (down > -0.5 / (_RISE * height_px))
    columns, lines = (np.where(inside, values, 0).astype(np.float32) for values in (columns, lines))
    # The nearest pixel: a mean across an edge would be a point in the air.
    layers = matched.nearness, matched.confidence
    found, trust = (cv2.remap(layer, columns, lines, cv2.INTER_NEAREST) for layer in layers)
    if matched.seen is not None:
        inside &= cv2.remap(matched.seen.astype(np.uint8), columns, lines, cv2.INTER_NEAREST) > 0
    border = np.clip(np.minimum(across, down), _LEAST_WEIGHT, 1)
    weight = np.where(inside, border * np.maximum(trust, _LEAST_WEIGHT), 0).astype(np.float32)
    return weight, found, trust
