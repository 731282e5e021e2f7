"""Block matching with an adaptive window.

Size and place of a window are chosen for each pixel and candidate, as the dynamic programming does that the
paper cites (`scanlines`):

- The cost of a window is that of Veksler ("Fast variable window for stereo correspondence using integral
  images", 2003): the mean of the matching costs, plus a share of their variance, which is large in windows
  across a depth edge, plus a penalty that falls with the size, which prefers large windows on plain surfaces.
- A pixel may be at the centre of the window, in a corner or in the middle of a side (the nine shiftable
  windows of Bobick and Intille, "Large occlusion stereo", 1999).

The window of least cost decides. Veksler searches rectangles; here are squares of four sizes.
"""

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from stereoweave.bench.classical.costs import keep_agreed, match_census_and_colour, see_from_right
from stereoweave.stereo import StereoPair

RADII_PX = (2, 4, 7, 12)
VARIANCE_WEIGHT = 0.1
PENALTY, PENALTY_OFFSET_PX = 10.0, -2.0


def find_window_costs(costs: UInt8[np.ndarray, "h w d"]) -> UInt16[np.ndarray, "h w d"]:
    """Return the cost of each pixel's best window for each candidate, in 1/32 of the matching costs' unit."""
    from stereoweave.bench.classical import window_kernels as kernels  # it loads LLVM

    windows = np.empty(costs.shape, np.uint16)
    least = np.full(costs.shape, np.iinfo(np.uint16).max, np.uint16)
    for radius in RADII_PX:
        penalty = PENALTY / (2 * radius + 1 + PENALTY_OFFSET_PX)
        kernels.rate_windows(costs, radius, VARIANCE_WEIGHT, penalty, windows)
        kernels.shift_windows(windows, radius, least)
    return least


def match_windows(pair: StereoPair) -> Float32[np.ndarray, "h w"]:
    """Return the left disparity in px [H, W] of the best windows; -1 where the right view disagrees."""
    costs = find_window_costs(match_census_and_colour(pair))
    outside = np.iinfo(costs.dtype).max
    return keep_agreed(_pick(costs), _pick(see_from_right(costs, outside)))


def _pick(costs: UInt16[np.ndarray, "h w d"]) -> Float32[np.ndarray, "h w"]:
    from stereoweave.matching.refine_kernels import pick

    found_px = np.empty(costs.shape[:2], np.float32)
    pick(costs, 0, 0, len(costs), found_px)
    return found_px
