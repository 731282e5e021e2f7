import math

import numpy as np
import pytest

from stereoweave.bench.edge_metrics import edge_bad_percent, edge_epe_px, flying_percent, near_edge

BEHIND_PX, BEFORE_PX = 10.0, 20.0


def step_between_columns_7_and_8():
    truth_px = np.full((5, 16), BEHIND_PX)
    truth_px[:, 8:] = BEFORE_PX
    return truth_px


def plain_flying_percent(estimate_px, truth_px):
    flying = []
    for row, column in np.argwhere(near_edge(truth_px)):
        around_px = truth_px[max(row - 3, 0) : row + 4, max(column - 3, 0) : column + 4]
        flying.append(not (np.abs(around_px - estimate_px[row, column]) <= 2).any())
    return 100 * np.mean(flying)


def test_three_columns_on_either_side_of_a_step_are_near_it():
    near = near_edge(step_between_columns_7_and_8())
    assert near.any(axis=0).nonzero()[0].tolist() == [5, 6, 7, 8, 9, 10]
    assert near.all(axis=0).sum() == 6
    np.testing.assert_array_equal(near_edge(step_between_columns_7_and_8().T), near.T)


def test_around_a_single_dot_all_but_the_corners_of_a_square_of_7_are_near_it():
    truth_px = np.zeros((15, 15))
    truth_px[7, 7] = 10
    expected = np.zeros((15, 15), bool)
    expected[4:11, 4:11] = True
    expected[[4, 4, 10, 10], [4, 10, 4, 10]] = False
    np.testing.assert_array_equal(near_edge(truth_px), expected)


def test_a_step_of_two_pixels_is_no_edge_and_a_larger_one_is():
    truth_px = np.zeros((1, 20))
    truth_px[0, 10:] = 2
    assert not near_edge(truth_px).any()
    truth_px[0, 10:] = 2.01
    assert near_edge(truth_px).any()


@pytest.mark.parametrize("unknown", [np.nan, np.inf])
def test_unknown_pixels_are_neither_a_side_of_an_edge_nor_near_one(unknown):
    truth_px = step_between_columns_7_and_8()
    truth_px[:, 8] = unknown
    assert not near_edge(truth_px).any()
    truth_px = step_between_columns_7_and_8()
    truth_px[:, 9] = unknown
    assert near_edge(truth_px)[0].nonzero()[0].tolist() == [5, 6, 7, 8, 10]


def test_errors_are_those_of_the_six_columns_near_the_edge():
    truth_px = step_between_columns_7_and_8()
    estimate_px = truth_px.copy()
    estimate_px[:, [0, 5, 6]] += [50, 3, -0.5]
    assert edge_epe_px(estimate_px, truth_px) == pytest.approx(3.5 / 6)
    assert edge_bad_percent(estimate_px, truth_px, 1) == pytest.approx(100 / 6)
    assert edge_bad_percent(estimate_px, truth_px, 0.4) == pytest.approx(200 / 6)


def test_a_pixel_flies_when_it_is_over_2_px_from_both_sides_of_its_edge():
    truth_px = step_between_columns_7_and_8()
    estimate_px = truth_px.copy()
    # On its own side, on the other, between, too far back, 2 px off, too far in front; column 0 is not near.
    estimate_px[:, 5:11] = [10, 20, 15, 7.9, 12, 22.1]
    estimate_px[:, 0] = 15
    assert flying_percent(estimate_px, truth_px) == pytest.approx(50)


def test_a_slanted_side_has_no_flying_pixels():
    truth_px = step_between_columns_7_and_8()
    truth_px[:, 8:] += 1.5 * np.arange(8)
    assert near_edge(truth_px)[0].sum() == 6
    assert flying_percent(truth_px, truth_px) == 0
    assert flying_percent(np.roll(truth_px, 1, axis=1), truth_px) == 0


def test_a_third_surface_in_the_window_is_a_surface_too():
    truth_px = step_between_columns_7_and_8()
    truth_px[:, 10:] = 40
    assert flying_percent(truth_px, truth_px) == 0


def test_interpolation_over_an_edge_makes_flying_pixels_and_a_moved_edge_does_not():
    truth_px = step_between_columns_7_and_8()
    ramp_px = np.broadcast_to(np.interp(np.arange(16), [5, 10], [BEHIND_PX, BEFORE_PX]), truth_px.shape)
    # The six columns near the edge become 10, 12, 14, 16, 18 and 20.
    assert flying_percent(ramp_px, truth_px) == pytest.approx(100 * 2 / 6)
    assert flying_percent(np.roll(truth_px, 2, axis=1)[:, 2:], truth_px[:, 2:]) == 0


def test_an_estimate_of_nan_is_flying():
    truth_px = step_between_columns_7_and_8()
    assert flying_percent(np.full_like(truth_px, np.nan), truth_px) == 100


@pytest.mark.parametrize("truth_px", [np.full((4, 9), 7.0), np.full((4, 9), np.nan)])
def test_without_an_edge_every_metric_is_nan(truth_px):
    estimate_px = np.zeros((4, 9))
    assert math.isnan(edge_epe_px(estimate_px, truth_px))
    assert math.isnan(edge_bad_percent(estimate_px, truth_px, 1))
    assert math.isnan(flying_percent(estimate_px, truth_px))


def test_flying_pixels_are_those_of_the_plain_definition(rng):
    truth_px = np.kron(rng.uniform(0, 12, (8, 10)), np.ones((5, 4))).astype(np.float32)
    truth_px[rng.random(truth_px.shape) < 0.1] = np.nan
    estimate_px = (np.nan_to_num(truth_px) + rng.normal(0, 4, truth_px.shape)).astype(np.float32)
    expected = plain_flying_percent(estimate_px.astype(float), truth_px.astype(float))
    assert 1 < expected < 50
    assert flying_percent(estimate_px, truth_px) == pytest.approx(expected, abs=1e-9)
