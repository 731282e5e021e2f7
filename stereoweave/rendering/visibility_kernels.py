"""Kernels that choose the visible surface of each pixel of the new view from both disparity maps."""

import math
import typing

import numpy as np

from stereoweave.rendering.canvas_kernels import (
    NOTHING,
    SAME_SURFACE_PX,
    lies_on,
    sample_linear,
    support_at,
    support_in_row,
)
from stereoweave.system.jit import compiled, inlined

NOISE_LEVELS = 10.0
"""Noise in the difference between the images, summed over the channels, when two surfaces are compared."""
PRIOR = 0.3
"""Weight of a disparity with confidence 0; a disparity with confidence 1 has about four times this weight."""


@compiled
@typing.no_type_check
def choose_row(left, right, confidence, y, landed_left, landed_right, row):
    """Write the visible surface of every pixel in a row; where there are two, write both and their shares.

    A pixel has two surfaces where the maps contradict each other or a nearer surface ends within the pixel.
    """
    front_px, back_px = row.front_px, row.back_px
    width = front_px.shape[0]
    row.share[:] = 1
    for u in range(width):
        a, b = landed_left[u], landed_right[u]
        same = abs(a - b) <= SAME_SURFACE_PX
        front_px[u] = np.float32(0.5) * (a + b) if same else max(a, b)
        back_px[u] = NOTHING if same else min(a, b)
    for u in range(width):
        if back_px[u] > NOTHING:
            a, b = landed_left[u], landed_right[u]
            part = _find_left_share(left, right, confidence, y, u, a, b)
            front_px[u] = a if part > 0 else b
            back_px[u] = b if 0 < part < 1 else NOTHING
            row.share[u] = part if part > 0 else 1.0
        before, after = max(u - 1, 0), min(u + 1, width - 1)
        beside_px = max(
            max(landed_left[before], landed_left[after]), max(landed_right[before], landed_right[after])
        )
        alone = back_px[u] == NOTHING and front_px[u] > NOTHING
        if alone and beside_px > front_px[u] + SAME_SURFACE_PX:
            covered = left.nearness * _measure_coverage(left, y, u, beside_px)
            covered += right.nearness * _measure_coverage(right, y, u, beside_px)
            if covered > 0:
                front_px[u], back_px[u], row.share[u] = beside_px, front_px[u], covered
    support_in_row(left, y, front_px, row.in_left)
    support_in_row(right, y, front_px, row.in_right)


@compiled
@typing.no_type_check
def _measure_coverage(side, y, u, d):
    """Return an image's support, 0..1, for the surface of disparity d at (y, u), ignoring purity.

    The support is 0 outside the image.
    """
    last = side.disparity_px.shape[1] - 1
    x = _column(side.shift, side.offset_px, u, d)
    if x < -0.5 or x > last + 0.5:
        return 0.0
    i = math.floor(x)
    before = lies_on(side.disparity_px[y, max(i, 0)] - d)
    after = lies_on(side.disparity_px[y, min(i + 1, last)] - d)
    return before + (x - i) * (after - before)


@inlined
@typing.no_type_check
def _column(shift, offset_px, u, d):
    """Return an image's fractional column that corresponds to column u of the new view at disparity d."""
    return u - offset_px - shift * d


@compiled
@typing.no_type_check
def _find_left_share(left, right, confidence, y, u, a, b):
    """Return the share, 0..1, of the left map's surface where the maps disagree.

    The right map's surface has the rest. The disparities of the two surfaces are a and b.
    """
    gap_a_px = _find_gap_px(right, y, u, a)
    gap_b_px = _find_gap_px(left, y, u, b)
    # The nearer surface occludes the other one, unless the other camera looks through it.
    if a > b and gap_a_px >= -SAME_SURFACE_PX:
        return 1.0
    if b > a and gap_b_px >= -SAME_SURFACE_PX:
        return 0.0
    trust_a = sample_linear(confidence[y], _column(left.shift, left.offset_px, u, a))
    trust_b = sample_linear(confidence[y], _column(left.shift, left.offset_px, u, b))
    # Confidence refers to the left map, which may differ from b: a nearer surface says nothing about b, and a
    # farther surface contradicts b.
    if gap_b_px > SAME_SURFACE_PX:
        trust_b = 0.5
    elif gap_b_px < -SAME_SURFACE_PX:
        trust_b = 1.0 - trust_b
    mismatch_a = _measure_mismatch(left, right, y, u, a)
    mismatch_b = _measure_mismatch(left, right, y, u, b)
    if min(mismatch_a, mismatch_b) < 0:
        mismatch_a = mismatch_b = 0.0
    score_a = (PRIOR + trust_a) / (NOISE_LEVELS + mismatch_a) * _sum_support(left, right, y, u, a)
    score_b = (PRIOR + trust_b) / (NOISE_LEVELS + mismatch_b) * _sum_support(left, right, y, u, b)
    return score_a / (score_a + score_b) if score_a > 0 else 0.0


@compiled
@typing.no_type_check
def _find_gap_px(side, y, u, d):
    """Return an image's disparity minus d at the column that corresponds to u; 0 outside the image.

    Of the two pixels beside that fractional column, the one whose disparity is closer to d counts.
    """
    last = side.disparity_px.shape[1] - 1
    x = _column(side.shift, side.offset_px, u, d)
    if x < 0 or x > last:
        return 0.0
    i = math.floor(x)
    before = side.disparity_px[y, i] - d
    after = side.disparity_px[y, min(i + 1, last)] - d
    return before if abs(before) < abs(after) else after


@compiled
@typing.no_type_check
def _measure_mismatch(left, right, y, u, d):
    """Return the mean difference between the images over three pixels around u at disparity d.

    The difference is summed over the channels; it is -1 outside the images.
    """
    left_image, right_image = left.image[y], right.image[y]
    last = left_image.shape[0] - 1
    total, count = 0.0, 0
    for column in range(u - 1, u + 2):
        x = _column(left.shift, left.offset_px, column, d)
        z = _column(right.shift, right.offset_px, column, d)
        if min(x, z) < 0 or max(x, z) > last:
            continue
        i, k = int(x), int(z)
        j, m = min(i + 1, last), min(k + 1, last)
        count += 1
        for channel in range(3):
            here = (1 - x + i) * left_image[i, channel] + (x - i) * left_image[j, channel]
            there = (1 - z + k) * right_image[k, channel] + (z - k) * right_image[m, channel]
            total += abs(here - there)
    return total / count if count else -1.0


@compiled
@typing.no_type_check
def _sum_support(left, right, y, u, d):
    """Return the weighted support of both images for the surface of disparity d at (y, u) of the new view."""
    total = 0.0
    for side in (left, right):
        x = _column(side.shift, side.offset_px, u, d)
        total += side.nearness * support_at(side.disparity_px[y], side.nearer_px[y], side.shift, x, d)
    return total
