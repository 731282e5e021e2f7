"""Minimum spanning trees over an image's pixels: one for each area of similar colour."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, Int, Int32, UInt8

SIGMA_LEVELS = 12.0
"""Colour difference at which the similarity of two neighbours falls to 1/e; 25.5 in Yang's paper."""
SPREAD, LEAST_PIXELS, MOST_PIXELS = 2000.0, 100, 5000


class Forest(NamedTuple):
    """Trees over all pixels. Pixels are in places 0..N - 1, tree by tree, each after its parent.

    Attributes:
        order: int32 [N], the pixel at each place; pixels are numbered row by row.
        parents: int32 [N], the place of each place's parent; -1 for a root.
        similarity: float32 [N], similarity to the parent, 0..1; 0 for a root.
        starts: int64 [T + 1], the first place of each tree, and N.
    """

    order: Int32[np.ndarray, " n"]
    parents: Int32[np.ndarray, " n"]
    similarity: Float32[np.ndarray, " n"]
    starts: Int[np.ndarray, " t"]


def grow_forest(image: UInt8[np.ndarray, "h w 3"]) -> Forest:
    """Return the minimum spanning trees of the image's areas.

    The weight of an edge is the greatest difference of its two pixels in a channel, after a 3x3 median (Yang,
    "A non-local cost aggregation method for stereo matching", 2012).
    """
    from stereoweave.bench.classical import tree_kernels as kernels  # it loads LLVM

    ends, weights = _list_edges(cv2.medianBlur(image, 3))
    pixels = image.shape[0] * image.shape[1]
    chosen = np.zeros(len(weights), bool)
    kernels.grow_trees(ends, weights, SPREAD, LEAST_PIXELS, MOST_PIXELS, pixels, chosen)
    order, parents = np.empty((2, pixels), np.int32)
    to_parent = np.empty(pixels, np.uint8)
    kernels.order_trees(ends, weights, chosen, order, parents, to_parent)
    similarity = np.exp(-to_parent.astype(np.float32) / np.float32(SIGMA_LEVELS))
    roots = parents < 0
    similarity[roots] = 0
    return Forest(order, parents, similarity, np.append(np.flatnonzero(roots), pixels))


def _list_edges(
    image: UInt8[np.ndarray, "h w 3"],
) -> tuple[Int32[np.ndarray, "e 2"], UInt8[np.ndarray, " e"]]:
    """Return the pixels at the ends of each edge, and its weight, in ascending order of weight."""
    numbers = np.arange(image.shape[0] * image.shape[1], dtype=np.int32).reshape(image.shape[:2])
    across, down = (np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])
    ends = [np.stack([numbers[one].ravel(), numbers[other].ravel()], 1) for one, other in (across, down)]
    levels = image.astype(np.int16)
    steps = [abs(levels[one] - levels[other]).max(-1).ravel() for one, other in (across, down)]
    weights = np.concatenate(steps).astype(np.uint8)
    order = np.argsort(weights, kind="stable")
    return np.concatenate(ends)[order], weights[order]
