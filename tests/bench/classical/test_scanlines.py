import numpy as np
import pytest
from plain_scanlines import plain_alignment

from stereoweave.bench.classical.scanline_kernels import align_rows

HOLE = -1


def align(costs, occlusion_cost):
    found_px = np.empty(costs.shape[:2], np.float32)
    align_rows(costs, occlusion_cost, found_px)
    return found_px


def row_of(true_px):
    """Return costs [1, W, 3] of 0 at the true disparity of each pixel, and of 10 elsewhere."""
    costs = np.full((1, len(true_px), 3), 10, np.uint16)
    for x, disparity_px in enumerate(true_px):
        if disparity_px >= 0:
            costs[0, x, disparity_px] = 0
    return costs


@pytest.mark.parametrize(
    ("occlusion_cost", "expected"),
    [
        # Two left pixels and two right pixels without a match cost 12; to match all at disparity 0 costs 40.
        (3, [0, 0, HOLE, HOLE, 2, 2, 0, 0]),
        # Now they would cost 44.
        (11, [0, 0, 0, 0, 0, 0, 0, 0]),
    ],
)
def test_a_stick_before_a_wall_is_found_if_occlusions_are_cheaper_than_mismatches(occlusion_cost, expected):
    # The stick in columns 4 and 5 covers columns 2 and 3 of the right row, where the wall would be seen.
    assert align(row_of([0, 0, HOLE, HOLE, 2, 2, 0, 0]), occlusion_cost).tolist() == [expected]


def test_a_row_may_begin_and_end_at_any_disparity_at_no_cost():
    assert align(row_of([2, 2, 2, 2]), 100).tolist() == [[2, 2, 2, 2]]


def test_the_fast_alignment_equals_the_plain_one(rng):
    costs = rng.integers(0, 20, (40, 12, 6), dtype=np.uint16)
    for occlusion_cost in (0, 1, 7, 30):
        plain = [plain_alignment(row, occlusion_cost) for row in costs]
        np.testing.assert_array_equal(align(costs, occlusion_cost), plain)
