"""3DMST: aggregation of costs over minimum spanning trees, for labels that are planes.

Li, Yu, Zhang, Zhao and Zhang, "3D cost aggregation with multiple minimum spanning trees for stereo matching",
Applied Optics 56 (2017). A pixel's support is a minimum spanning tree in place of a square, and its label is
a plane in place of a disparity. There are too many planes to try them all: each area of the image has a tree
of its own, to which a random search in the manner of PatchMatch proposes planes.

This is written from the paper's abstract, because its text is not public, and from what it builds on: Yang
(2012) for trees and aggregation, Felzenszwalb and Huttenlocher (2004) for the areas, Bleyer, Rhemann and
Rother ("PatchMatch stereo", 2011) for proposals and the left-right check. Known differences:

- The first labels are the best of all whole disparities, not random ones, because these are fast to try: all
  candidates are aggregated at once.
- Some proposals are planes through the disparities of three of the tree's pixels.
- Pixels that fail the left-right check stay holes, which `bench pairs` fills as for all matchers. PatchMatch
  stereo extends planes and takes a weighted median.
- Matching costs are census and colour. The paper's are those of MC-CNN.
"""

import numpy as np
from jaxtyping import Float32, Int64, UInt8

from stereoweave.bench.classical.costs import keep_agreed, match_census_and_colour, see_from_right
from stereoweave.bench.classical.trees import Forest, grow_forest
from stereoweave.stereo import StereoPair

SWEEPS = 8
CHANGED = 7
"""Number of changed labels that a sweep proposes to each tree."""


def match_spanning_trees(pair: StereoPair) -> Float32[np.ndarray, "h w"]:
    """Return the left disparity in px [H, W] by 3DMST; -1 where the right view disagrees."""
    from stereoweave.bench.classical.label_kernels import OUTSIDE  # it loads LLVM

    costs = match_census_and_colour(pair)
    draw = np.random.default_rng(0)
    planes = find_planes(pair.left, costs, draw)
    right_planes = find_planes(pair.right, see_from_right(costs, int(OUTSIDE)), draw)
    most_px = costs.shape[2] - 1
    return keep_agreed(_at_pixels(planes, most_px), _at_pixels(right_planes, most_px))


def find_planes(
    image: UInt8[np.ndarray, "h w 3"], costs: UInt8[np.ndarray, "h w d"], draw: np.random.Generator
) -> Float32[np.ndarray, "h w 3"]:
    """Return each pixel's plane (a, b, c) of disparity a * x + b * y + c [H, W, 3].

    Args:
        image: The view, uint8 RGB [H, W, 3].
        costs: Its matching costs [H, W, D], at most 119.
        draw: Source of the random proposals.
    """
    from stereoweave.bench.classical import label_kernels as kernels  # it loads LLVM

    forest = grow_forest(image)
    tree = forest.parents, forest.similarity, forest.starts
    ordered = costs.reshape(-1, costs.shape[2])[forest.order]
    labels, least = np.empty((len(ordered), 3), np.float32), np.empty(len(ordered), np.float32)
    kernels.label_fronts(ordered, *tree, labels, least)
    places, at_pixel = _list_places(forest, image.shape[:2])
    proposals = kernels.FROM_NEARBY + kernels.FROM_PLANES + CHANGED
    for _ in range(SWEEPS):
        draws = draw.random((len(forest.starts) - 1, proposals, kernels.DRAWS))
        kernels.search_labels(ordered, places, at_pixel, *tree, draws, labels, least)
    return labels[at_pixel]


def _list_places(
    forest: Forest, size: tuple[int, int]
) -> tuple[Float32[np.ndarray, "n 2"], Int64[np.ndarray, "h w"]]:
    """Return the row and column of the pixel at each place, and the place of each pixel [H, W]."""
    places = np.stack(np.divmod(forest.order, size[1]), 1).astype(np.float32)
    at_pixel = np.empty(len(places), np.int64)
    at_pixel[forest.order] = np.arange(len(places))
    return places, at_pixel.reshape(size)


def _at_pixels(planes: Float32[np.ndarray, "h w 3"], most_px: int) -> Float32[np.ndarray, "h w"]:
    """Return each pixel's disparity on its own plane, 0..most_px."""
    rows, columns = (np.arange(length, dtype=np.float32) for length in planes.shape[:2])
    found_px = planes[..., 0] * columns + planes[..., 1] * rows[:, None] + planes[..., 2]
    return found_px.clip(0, most_px)
