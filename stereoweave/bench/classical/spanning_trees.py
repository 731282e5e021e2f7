"""3DMST: aggregation of costs over minimum spanning trees, for labels that are planes.

Li, Yu, Zhang, Zhao and Zhang, "3D cost aggregation with multiple minimum spanning trees for stereo matching",
Applied Optics 56 (2017). A pixel's support is a minimum spanning tree in place of a square, and its label is
a plane in place of a disparity. There are too many planes to try them all: each area of the image has a tree
of its own, to which a random search in the manner of PatchMatch proposes planes.

This is written from the paper's abstract, because its text is not public, and from what it builds on: Yang
(2012) for trees and aggregation, Felzenszwalb and Huttenlocher (2004) for the areas, Bleyer, Rhemann and
Rother ("PatchMatch stereo", 2011) for proposals and post-processing. Known differences:

- The first labels are the best of all whole disparities, not random ones, because these are fast to try: all
  candidates are aggregated at once.
- Some proposals are planes through the disparities of three of the tree's pixels.
- Matching costs are census and colour. The paper's are those of MC-CNN; `find_costs` takes any others.
"""

import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8

from stereoweave.bench.classical.costs import (
    HOLE,
    CostFunction,
    keep_agreed,
    match_census_and_colour,
    see_from_right,
)
from stereoweave.bench.classical.trees import Forest, grow_forest
from stereoweave.stereo import StereoPair

SWEEPS = 8
CHANGED = 7
"""Number of changed labels that a sweep proposes to each tree."""
COLOUR_LEVELS = 10.0
"""Sum of the channels' differences at which a neighbour's weight in the median falls to 1/e (Bleyer 2011)."""


def match_spanning_trees(
    pair: StereoPair, find_costs: CostFunction = match_census_and_colour, seed: int = 0
) -> Float32[np.ndarray, "h w"]:
    """Return the left disparity in px [H, W] by 3DMST, filled where the right view disagrees.

    Args:
        pair: The pair to match.
        find_costs: Matching costs of the left view, at most 119.
        seed: Random seed.
    """
    costs = find_costs(pair)
    draw = np.random.default_rng(seed)
    planes = find_planes(pair.left, costs, draw)
    right_planes = find_planes(pair.right, see_from_right(costs), draw)
    most_px = costs.shape[2] - 1
    disparity_px = _at_pixels(planes, most_px)
    seen_px = keep_agreed(disparity_px, _at_pixels(right_planes, most_px))
    return _fill(pair.left, planes, disparity_px, seen_px != HOLE)


def find_planes(
    image: UInt8[np.ndarray, "h w 3"], costs: UInt8[np.ndarray, "h w d"], draw: np.random.Generator
) -> Float32[np.ndarray, "h w 3"]:
    """Return each pixel's plane (a, b, c) of disparity a * x + b * y + c [H, W, 3].

    Args:
        image: The view, uint8 RGB [H, W, 3].
        costs: Its matching costs [H, W, D].
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


def _list_places(forest: Forest, size: tuple[int, int]) -> tuple[Float32[np.ndarray, "n 2"], np.ndarray]:
    """Return the row and column of the pixel at each place, and the place of each pixel [H, W]."""
    places = np.stack(np.divmod(forest.order, size[1]), 1).astype(np.float32)
    at_pixel = np.empty(len(places), np.int64)
    at_pixel[forest.order] = np.arange(len(places))
    return places, at_pixel.reshape(size)


def _at_pixels(planes: Float32[np.ndarray, "h w 3"], most_px: int) -> Float32[np.ndarray, "h w"]:
    """Return each pixel's disparity on its own plane, 0..most_px."""
    rows, columns = np.indices(planes.shape[:2])
    return _on_planes(planes, rows, columns).clip(0, most_px)


def _on_planes(
    planes: Float32[np.ndarray, "h w 3"], rows: Int[np.ndarray, "h w"], columns: Int[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    disparity_px = planes[..., 0] * columns + planes[..., 1] * rows + planes[..., 2]
    return disparity_px.astype(np.float32)


def _fill(
    image: UInt8[np.ndarray, "h w 3"],
    planes: Float32[np.ndarray, "h w 3"],
    disparity_px: Float32[np.ndarray, "h w"],
    known: Bool[np.ndarray, "h w"],
) -> Float32[np.ndarray, "h w"]:
    """Return the disparity with unknown pixels filled as in PatchMatch stereo.

    A pixel takes the smaller disparity of the planes of the nearest known pixels to its left and right, then
    the median around it, weighted by similarity of colour.
    """
    from stereoweave.bench.classical.median_kernels import weigh_medians  # it loads LLVM

    known = known | ~known.any(axis=1, keepdims=True)  # a row of which nothing is known stays as it is
    width = known.shape[1]
    rows, columns = np.indices(known.shape)
    last = np.maximum.accumulate(np.where(known, columns, -1), axis=1)
    following = np.minimum.accumulate(np.where(known, columns, width)[:, ::-1], axis=1)[:, ::-1]
    extended_px = (
        np.where(
            (beside >= 0) & (beside < width),
            _on_planes(planes[rows, beside.clip(0, width - 1)], rows, columns),
            np.inf,
        )
        for beside in (last, following)
    )
    smaller_px = np.minimum(*extended_px).clip(0, disparity_px.max())
    filled_px = np.where(known, disparity_px, smaller_px).astype(np.float32)
    weights = np.exp(-np.arange(3 * 255 + 1, dtype=np.float32) / np.float32(COLOUR_LEVELS))
    found_px = filled_px.copy()
    weigh_medians(image, filled_px, ~known, weights, found_px)
    return found_px
