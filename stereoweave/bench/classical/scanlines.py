"""Dynamic programming along scanlines, with occlusions.

It follows "Dynamic programming for multi-view disparity/depth estimation" (Anantrasirichai, Canagarajah,
Redmill and Bull 2006), which the paper cites: windows of adaptive size and place give the costs, and
smoothness is part of the dynamic programming. The recurrence is that of Cox and others ("A maximum likelihood
stereo algorithm", 1996) and Bobick and Intille ("Large occlusion stereo", 1999): each pixel of a row is
matched with a pixel of the right row, in order, or passed over at a fixed cost.
"""

import numpy as np
from jaxtyping import Float32

from stereoweave.bench.classical.costs import mark_holes, match_census_and_colour
from stereoweave.bench.classical.windows import find_window_costs
from stereoweave.stereo import StereoPair

OCCLUSION_COST = 20.0
"""Cost of a pixel without a match, in the unit of the matching costs."""


def match_scanlines(pair: StereoPair) -> Float32[np.ndarray, "h w"]:
    """Return the left disparity in px [H, W] of each row's cheapest alignment; -1 in occluded pixels."""
    from stereoweave.bench.classical.scanline_kernels import align_rows  # it loads LLVM
    from stereoweave.bench.classical.window_kernels import STEPS

    costs = find_window_costs(match_census_and_colour(pair))
    found_px = np.empty(costs.shape[:2], np.float32)
    align_rows(costs, round(STEPS * OCCLUSION_COST), found_px)
    return mark_holes(found_px, found_px >= 0)
