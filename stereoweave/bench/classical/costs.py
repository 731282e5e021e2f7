"""What the classical matchers share: matching costs, the right view's costs, and the left-right check."""

import numpy as np
from jaxtyping import Bool, Float32, Shaped, UInt8

from stereoweave.bench.opencv_matchers import DISPARITIES, LEAST_PX
from stereoweave.matching.left_right_check import OCCLUSION_STEP_PX, measure_disagreement
from stereoweave.matching.refine import find_matching_costs
from stereoweave.stereo import StereoPair

HOLE = np.float32(-1)
"""Disparity of a pixel that has none."""


def match_census_and_colour(pair: StereoPair) -> UInt8[np.ndarray, "h w d"]:
    """Return the left view's matching costs, as the networks' refinement uses them, 0..108 [H, W, 192].

    Candidate i is a disparity of i px, and low is good.
    A cost is half the difference in colour, which is insensitive to sampling (Birchfield and Tomasi 1998) and
    limited to 60, plus two for each of the 24 pixels around that the census compares otherwise.
    """
    return find_matching_costs(pair, DISPARITIES)


def see_from_right(costs: Shaped[np.ndarray, "h w d"], outside: int) -> Shaped[np.ndarray, "h w d"]:
    """Return the costs of the right view: candidate i of column x is that of column x + i of the left view.

    Candidates outside the left image cost `outside`.
    """
    count = costs.shape[2]
    padded = np.pad(costs, ((0, 0), (0, count - 1), (0, 0)), constant_values=outside)
    rows, columns, candidates = padded.strides
    return np.lib.stride_tricks.as_strided(
        padded, costs.shape, (rows, columns, columns + candidates), writeable=False
    ).copy()


def keep_agreed(
    disparity_px: Float32[np.ndarray, "h w"], right_disparity_px: Float32[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Return the left disparity, with a hole where the right view disagrees by more than 1 px."""
    disagreement_px, inside = measure_disagreement(disparity_px, right_disparity_px)
    agreed = inside & (np.abs(disagreement_px) <= OCCLUSION_STEP_PX)
    return mark_holes(disparity_px, agreed)


def mark_holes(
    disparity_px: Float32[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Return the disparity, at least LEAST_PX, with a hole where it is not known."""
    return np.where(known, np.maximum(disparity_px, LEAST_PX), HOLE)
