"""Plain reference of `bench.classical.median_kernels`."""

import numpy as np


def plain_medians(image, disparity_px, filled):
    """Return the disparities [H, W] in which filled pixels have the weighted median around them."""
    found_px = disparity_px.copy()
    height, width = filled.shape
    for y, x in np.argwhere(filled):
        around = np.s_[max(y - 17, 0) : min(y + 18, height), max(x - 17, 0) : min(x + 18, width)]
        unlike = abs(image[around].astype(int) - image[y, x].astype(int)).sum(-1).ravel()
        quarters = np.floor(disparity_px[around].ravel() * 4 + 0.5)
        order = np.argsort(quarters, kind="stable")
        below = np.cumsum(np.exp(-unlike[order] / 10))
        found_px[y, x] = quarters[order][np.searchsorted(below, below[-1] / 2)] / 4
    return found_px
