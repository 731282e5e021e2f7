"""The stereo method of MC-CNN's paper (section 4), from the vectors of both views to disparities.

Where the paper is silent, this does what the authors' program does (github.com/jzbontar/mc-cnn): an arm of
the cross has at least one pixel; an occluded pixel without correct ones to its left takes the next to its
right; the fraction of a pixel is at most 1 px and comes from the last costs; the bilateral filter compares
disparities, within three standard deviations.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float32, Int32, UInt8

from stereoweave.bench.mc_cnn import cross_kernels as cross
from stereoweave.bench.mc_cnn import outlier_kernels as outliers
from stereoweave.bench.mc_cnn import path_kernels as paths
from stereoweave.bench.mc_cnn import refinement_kernels as refinement
from stereoweave.bench.mc_cnn import volume_kernels as volumes

Costs = Float32[np.ndarray, "h w d"]
Grey = Float32[np.ndarray, "h w"]


@dataclass(frozen=True, kw_only=True)
class DescribedView:
    """A view: levels with mean 0 and standard deviation 1 [H, W], and vectors of unit length [H, W, C]."""

    grey: Float32[np.ndarray, "h w"]
    vectors: Float32[np.ndarray, "h w c"]


@dataclass(frozen=True, kw_only=True)
class StereoSettings:
    """Settings of the stereo method, in parentheses the paper's names.

    Attributes:
        cross_intensity: Least difference of levels that ends an arm (cbca_intensity).
        cross_distance_px: Length that an arm does not reach (cbca_distance).
        cross_iterations: Aggregations before and after semi-global matching (cbca_num_iterations).
        small_penalty: Penalty for a disparity step of 1 px (sgm_P1).
        large_penalty: Penalty for a larger step (sgm_P2).
        one_edge: Divisor of the penalties at a strong gradient in one view (sgm_Q1).
        two_edges: Divisor of the penalties at a strong gradient in both views (sgm_Q2).
        vertical: Divisor of small_penalty in vertical paths (sgm_V).
        gradient: Least difference of levels that is a strong gradient (sgm_D).
        blur_px: Standard deviation of the bilateral filter (blur_sigma).
        blur_step_px: Least difference of disparities that it keeps (blur_threshold).
    """

    cross_intensity: float
    cross_distance_px: int
    cross_iterations: tuple[int, int]
    small_penalty: float
    large_penalty: float
    one_edge: float
    two_edges: float
    vertical: float
    gradient: float
    blur_px: float
    blur_step_px: float


FAST = StereoSettings(
    cross_intensity=0.0,
    cross_distance_px=0,
    cross_iterations=(0, 0),
    small_penalty=2.3,
    large_penalty=55.9,
    one_edge=4.0,
    two_edges=8.0,
    vertical=1.5,
    gradient=0.08,
    blur_px=6.0,
    blur_step_px=2.0,
)
"""The paper's choice for the fast architecture on Middlebury, which leaves out cross-based aggregation."""

AGGREGATED = replace(FAST, cross_intensity=0.02, cross_distance_px=14, cross_iterations=(2, 16))
"""FAST with the cross-based aggregation that the paper chose for its accurate architecture on Middlebury."""


def find_nearest_vectors(
    left: DescribedView, right: DescribedView, candidates: int
) -> Float32[np.ndarray, "h w"]:
    """Return the left disparity in whole px [H, W] whose vectors are most similar, without other steps.

    Candidates are 0 to `candidates` - 1 px; those outside the right view are never chosen.
    """
    return _choose(_compare(left, right, candidates)).astype(np.float32)


def find_disparity(
    left: DescribedView, right: DescribedView, candidates: int, settings: StereoSettings
) -> Float32[np.ndarray, "h w"]:
    """Return the left disparity in px [H, W] after all steps of the paper.

    Args:
        left: Left view.
        right: Right view, of the same size.
        candidates: Number of candidate disparities, from 0 px on.
        settings: Settings of the steps.
    """
    right_px = _choose(find_costs(_mirror(right), _mirror(left), candidates, settings))[:, ::-1]
    costs = find_costs(left, right, candidates, settings)
    whole_px = replace_outliers(_choose(costs), np.ascontiguousarray(right_px), candidates)
    disparity_px = np.empty(whole_px.shape, np.float32)
    refinement.fit_parabolas(costs, whole_px, disparity_px)
    return smooth(cv2.medianBlur(disparity_px, 5), settings)


def find_costs(left: DescribedView, right: DescribedView, candidates: int, settings: StereoSettings) -> Costs:
    """Return the costs [H, W, D] after aggregation, semi-global matching and aggregation again."""
    first, second = settings.cross_iterations
    costs = _compare(left, right, candidates)
    aggregate(costs, left.grey, right.grey, settings, first)
    costs = sum_paths(costs, left.grey, right.grey, settings)
    aggregate(costs, left.grey, right.grey, settings, second)
    return costs


def aggregate(costs: Costs, left: Grey, right: Grey, settings: StereoSettings, times: int) -> None:
    """Replace the costs by their means over cross-shaped regions, several times."""
    if not times:
        return
    arms = _find_arms(left, settings), np.ascontiguousarray(_find_arms(right, settings)[..., ::-1])
    height, width, count = costs.shape
    sums, areas = np.empty_like(costs), np.ones_like(costs)
    along_rows, along_columns = np.empty((width + 1) * count), np.empty((height + 1) * count)
    for volume in (areas, *times * [costs]):
        cross.sum_rows(volume, *arms, along_rows, sums)
        cross.sum_columns(sums, *arms, along_columns, volume)
        if volume is costs:
            costs /= areas


def sum_paths(costs: Costs, left: Grey, right: Grey, settings: StereoSettings) -> Costs:
    """Return the mean of the costs over paths from the left, right, top and bottom.

    The costs of candidates outside the right view stay OUTSIDE.
    """
    divisors = np.array([1, settings.one_edge, settings.two_edges])
    small = (settings.small_penalty / divisors).astype(np.float32)
    large = (settings.large_penalty / divisors).astype(np.float32)
    flatter = (small / settings.vertical).astype(np.float32)
    totals = np.zeros_like(costs)
    for axis, run, penalty in ((1, paths.along_rows, small), (0, paths.along_columns, flatter)):
        own, other = (_find_edges(grey, axis, settings.gradient) for grey in (left, right))
        run(costs, own, np.ascontiguousarray(other[:, ::-1]), penalty, large, totals)
    totals /= 4
    for x in range(min(costs.shape[1:])):
        totals[:, x, x + 1 :] = volumes.OUTSIDE
    return totals


def replace_outliers(
    left_px: Int32[np.ndarray, "h w"], right_px: Int32[np.ndarray, "h w"], candidates: int
) -> Int32[np.ndarray, "h w"]:
    """Return the left disparities, with those that fail the left-right check replaced by correct ones."""
    labels, filled_px = np.empty(left_px.shape, np.uint8), np.empty_like(left_px)
    outliers.label(left_px, right_px, candidates, labels)
    outliers.replace(left_px, labels, filled_px)
    return filled_px


def smooth(disparity_px: Float32[np.ndarray, "h w"], settings: StereoSettings) -> Float32[np.ndarray, "h w"]:
    """Return disparities smoothed by the bilateral filter."""
    offsets = np.arange(-np.ceil(3 * settings.blur_px), np.ceil(3 * settings.blur_px) + 1)
    weights = np.exp(-(offsets**2 + offsets[:, None] ** 2) / (2 * settings.blur_px**2))
    smoothed_px = np.empty_like(disparity_px)
    refinement.smooth(disparity_px, weights.astype(np.float32), settings.blur_step_px, smoothed_px)
    return smoothed_px


def rehearse_mc_cnn() -> None:
    """Find the disparity of a small pair, to compile all kernels (`release.kernels`)."""
    view = DescribedView(grey=np.zeros((8, 12), np.float32), vectors=np.zeros((8, 12, 2), np.float32))
    find_disparity(view, view, 4, AGGREGATED)


def _compare(left: DescribedView, right: DescribedView, candidates: int) -> Costs:
    costs = np.empty((*left.grey.shape, candidates), np.float32)
    volumes.compare(left.vectors, right.vectors, costs)
    return costs


def _choose(costs: Costs) -> Int32[np.ndarray, "h w"]:
    disparity_px = np.empty(costs.shape[:2], np.int32)
    volumes.pick(costs, disparity_px)
    return disparity_px


def _mirror(view: DescribedView) -> DescribedView:
    grey, vectors = (np.ascontiguousarray(values[:, ::-1]) for values in (view.grey, view.vectors))
    return DescribedView(grey=grey, vectors=vectors)


def _find_arms(grey: Grey, settings: StereoSettings) -> Int32[np.ndarray, "4 h w"]:
    arms = np.empty((4, *grey.shape), np.int32)
    cross.find_arms(grey, settings.cross_distance_px, settings.cross_intensity, arms)
    return arms


def _find_edges(grey: Grey, axis: int, gradient: float) -> UInt8[np.ndarray, "h w"]:
    """Return 1 where the level differs strongly from the previous one along the axis, or has none before."""
    steps = np.diff(grey, axis=axis, prepend=np.inf)
    return (np.abs(steps) >= gradient).astype(np.uint8)
