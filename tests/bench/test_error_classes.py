import math

import numpy as np
import pytest

from stereoweave.bench.error_classes import ALL, CLASSES, class_errors, classify, find_covered
from stereoweave.bench.metrics import bad_percent, epe_px


def wall_and_box():
    """Return the disparity of a wall at 2 px, with a box at 8 px in columns 20 to 35 of all 80 rows."""
    truth_px = np.full((80, 48), 2.0, np.float32)
    truth_px[:, 20:36] = 8
    return truth_px


def columns(mask, row):
    return mask[row].nonzero()[0].tolist()


def ramps():
    """Return a grey image: constant in rows 0 to 19, rising by 1.5 levels per row, and by 4 from row 50."""
    levels = np.concatenate([np.zeros(20), 1.5 * np.arange(1, 31), 45 + 4 * np.arange(1, 31)])
    return np.broadcast_to(levels.astype(np.uint8)[:, None, None], (80, 48, 3)).copy()


def test_each_class_is_where_it_was_worked_out_by_hand():
    masks = classify(ramps(), wall_and_box())
    assert tuple(masks) == CLASSES
    # The wall's match is at x - 2; the box is seen in the right columns 12 to 27, so it covers x = 14 to 19.
    for row in (10, 35, 65):
        assert columns(masks["outside"], row) == [0, 1]
        assert columns(masks["occluded"], row) == [14, 15, 16, 17, 18, 19]
        assert columns(masks["thin_or_edge"], row) == [20, 21, 22, 33, 34, 35, 36, 37, 38]
    others = [*range(2, 14), *range(23, 33), *range(39, 48)]
    assert [columns(masks[name], 10) for name in CLASSES[3:]] == [others, [], []]
    assert [columns(masks[name], 35) for name in CLASSES[3:]] == [[], others, []]
    assert [columns(masks[name], 65) for name in CLASSES[3:]] == [[], [], others]


def test_a_known_occlusion_mask_replaces_the_one_found_by_warping():
    occluded = np.zeros((80, 48), bool)
    occluded[:, :5] = True  # also outside, which comes first
    masks = classify(ramps(), wall_and_box(), occluded)
    assert columns(masks["outside"], 10) == [0, 1]
    assert columns(masks["occluded"], 10) == [2, 3, 4]
    assert columns(masks["thin_or_edge"], 10) == [17, 18, 19, 20, 21, 22, 33, 34, 35, 36, 37, 38]


@pytest.mark.parametrize(("width", "is_thin"), [(14, True), (15, False)])
def test_a_rod_less_than_15_px_wide_is_thin_to_its_middle(width, is_thin):
    truth_px = np.zeros((60, 60), np.float32)
    truth_px[:, 20 : 20 + width] = 5
    occluded = np.zeros(truth_px.shape, bool)
    for truth in (truth_px, truth_px.T.copy()):
        thin = classify(np.zeros((60, 60, 3), np.uint8), truth, occluded)["thin_or_edge"]
        middle = thin[30] if truth is truth_px else thin[:, 30]
        inside = list(range(17, 23 + width)) if is_thin else [*range(17, 23), *range(17 + width, 23 + width)]
        assert middle.nonzero()[0].tolist() == inside


def test_a_pixel_over_one_px_farther_in_the_same_right_column_is_covered():
    # Matches at columns 0, 1, 1, 3: the second pixel's is covered where the third is over 1 px nearer.
    np.testing.assert_array_equal(
        find_covered(np.array([[0.0, 0.0, 1.2, 0.0]])), [[False, True, False, False]]
    )
    assert not find_covered(np.array([[0.0, 0.0, 1.0, 0.0]])).any()
    assert not find_covered(np.array([[0.0, 0.0, np.nan, 0.0]])).any()
    # Both match outside the picture, so nothing covers them.
    assert not find_covered(np.array([[1.0, 5.0, 0.0, 0.0]])).any()


def test_a_surface_at_half_a_pixel_covers_every_column_behind_it():
    truth_px = np.zeros((1, 40))
    truth_px[0, 20:30] = 10.5
    np.testing.assert_array_equal(np.flatnonzero(find_covered(truth_px)), np.arange(10, 20))


@pytest.mark.parametrize("unknown", [np.nan, np.inf])
def test_each_known_pixel_is_in_one_class_and_no_unknown_one_in_any(unknown):
    rng = np.random.default_rng(3)
    truth_px = np.where(rng.random((80, 48)) < 0.2, unknown, wall_and_box()).astype(np.float32)
    masks = classify(rng.integers(0, 256, (80, 48, 3), dtype=np.uint8), truth_px)
    np.testing.assert_array_equal(sum(mask.astype(int) for mask in masks.values()), np.isfinite(truth_px))


def test_errors_of_a_class_are_given_in_points_of_the_whole_and_in_percent_of_the_class():
    truth_px = np.zeros((1, 10))
    truth_px[0, 9] = np.nan
    truth_px[0, 8] = np.inf  # of the 8 known pixels, the class has 4
    estimate_px = np.array([[0.5, 1.5, 2.5, 9.5, 0, 0, 0, 4, 100, 100]])
    masks = {"first": np.arange(10)[None] < 4, "empty": np.zeros((1, 10), bool)}
    found = class_errors(estimate_px, truth_px, masks)
    assert list(found) == ["first", "empty", ALL]
    first, everything = found["first"], found[ALL]
    assert (first.share_percent, first.bad1_percent, first.bad2_percent) == (50, 37.5, 25)
    assert (first.bad1_within_percent, first.bad2_within_percent, first.epe_px) == (75, 50, 3.5)
    assert (everything.share_percent, everything.bad1_percent, everything.epe_px) == (100, 50, 2.25)
    empty = found["empty"]
    assert (empty.share_percent, empty.bad1_percent, empty.bad2_percent) == (0, 0, 0)
    assert math.isnan(empty.bad1_within_percent)
    assert math.isnan(empty.bad2_within_percent)
    assert math.isnan(empty.epe_px)


def test_points_of_all_classes_add_up_to_the_whole_estimate():
    truth_px = wall_and_box()
    estimate_px = truth_px + np.random.default_rng(5).normal(0, 2, truth_px.shape).astype(np.float32)
    estimate_px[3, 4] = np.nan  # bad, but not part of a mean
    found = class_errors(estimate_px, truth_px, classify(ramps(), truth_px))
    classes = [found[name] for name in CLASSES]
    assert sum(errors.share_percent for errors in classes) == pytest.approx(100)
    assert sum(errors.bad1_percent for errors in classes) == pytest.approx(
        bad_percent(estimate_px, truth_px, 1)
    )
    assert sum(errors.bad2_percent for errors in classes) == pytest.approx(found[ALL].bad2_percent)
    estimate_px[3, 4] = 0
    found = class_errors(estimate_px, truth_px, classify(ramps(), truth_px))
    means_px = [found[name].share_percent / 100 * found[name].epe_px for name in CLASSES]
    assert sum(means_px) == pytest.approx(epe_px(estimate_px, truth_px))


def test_without_known_pixels_every_number_is_nan():
    truth_px = np.full((8, 16), np.nan)
    found = class_errors(np.zeros((8, 16)), truth_px, classify(np.zeros((8, 16, 3), np.uint8), truth_px))
    assert all(math.isnan(errors.share_percent) and math.isnan(errors.epe_px) for errors in found.values())
