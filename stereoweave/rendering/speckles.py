"""Speckles and edges of a disparity map.

A speckle is a small part whose disparity differs from all around it; most are wrong matches.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from stereoweave.rendering.canvas_kernels import NOTHING, SAME_SURFACE_PX

_MEDIAN_PX = 5
# Largest area of a speckle: pixels, and share of the map.
_LARGEST_PX, _LARGEST_SHARE = 30, 1e-4
# Steps per pixel, and the largest level, of the integers in which speckles are searched.
_STEPS, _MOST_LEVEL = 16, 32_000


def remove_speckles(disparity_px: Float[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Return the map with smooth outlines, and with the disparity beside each speckle in its place."""
    smooth_px = cv2.medianBlur(np.ascontiguousarray(disparity_px, np.float32), _MEDIAN_PX)
    return smooth_px[find_nearest(~find_speckles(smooth_px))]


def find_speckles(disparity_px: Float32[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the mask of speckles; pixels of disparity NOTHING are a surface of their own."""
    known = disparity_px > NOTHING
    if not known.any():
        return known
    low_px, high_px = float(disparity_px[known].min()), float(disparity_px[known].max())
    low_px -= 2 * float(SAME_SURFACE_PX)
    steps = min(_STEPS, _MOST_LEVEL / (high_px - low_px))
    levels = np.rint((np.maximum(disparity_px, low_px) - low_px) * steps).astype(np.int16)
    largest_px = max(_LARGEST_PX, round(_LARGEST_SHARE * disparity_px.size))
    cv2.filterSpeckles(levels, -1, largest_px, float(SAME_SURFACE_PX) * steps)
    return levels < 0


def find_nearest(
    kept: Bool[np.ndarray, "h w"],
) -> tuple[Int[np.ndarray, "h w"], Int[np.ndarray, "h w"]]:
    """Return row and column of the kept pixel nearest to each pixel; its own if no pixel is kept."""
    rows, columns = np.nonzero(kept)
    if not len(rows):
        rows, columns = np.mgrid[: kept.shape[0], : kept.shape[1]]
        return rows, columns
    _, labels = cv2.distanceTransformWithLabels(
        (~kept).view(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    which = np.empty(labels.max() + 1, np.int64)
    which[labels[rows, columns]] = np.arange(len(rows))
    return rows[which[labels]], columns[which[labels]]


def find_nearer_px(disparity_px: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Return how much nearer the surface beyond an edge is, at pixels up to 2 px behind one; 0 elsewhere.

    These pixels may carry the nearer surface's colour.
    """
    window = np.ones((3, 3), np.uint8)
    around_px = cv2.dilate(disparity_px, window)
    edge_px = around_px - disparity_px
    edge_px[edge_px <= SAME_SURFACE_PX] = 0
    behind = cv2.dilate(around_px, window) - disparity_px > SAME_SURFACE_PX
    return np.where(behind, cv2.dilate(edge_px, window), np.float32(0))
