"""The field of vertical moves: fit, values and inverse."""

import numpy as np
import pytest

from stereoweave.cameras.row_field import RowField, fit_row_field

SIZE = (640, 480)


def bent(places_px):
    """Return vertical errors of up to 4 px that vary slowly over the picture."""
    x, y = (places_px / SIZE).T
    return 2 * np.cos(np.pi * y) + 2 * x * y - 1


@pytest.fixture(scope="module")
def field():
    places_px = np.random.default_rng(0).uniform(0, SIZE, (600, 2))
    lower_px = bent(places_px)
    lower_px[::5] += 30  # wrong matches
    return fit_row_field(places_px, lower_px, SIZE)


def test_the_fit_follows_the_errors_and_ignores_wrong_matches(field):
    places_px = np.random.default_rng(1).uniform(30, np.array(SIZE) - 30, (500, 2))
    assert np.abs(field.measure_lower_px(places_px) - bent(places_px)).max() < 0.15


def test_errors_of_zero_give_no_field():
    places_px = np.random.default_rng(0).uniform(0, SIZE, (100, 2))
    np.testing.assert_allclose(fit_row_field(places_px, np.zeros(100), SIZE).terms_px, 0)


def test_the_first_cosine_is_a_shift():
    terms_px = np.zeros((5, 5))
    terms_px[0, 0] = 3
    field = RowField(terms_px=terms_px, size_px=SIZE)
    np.testing.assert_allclose(field.measure_lower_px(np.array([[0.0, 0], [400, 300]])), 3)
    np.testing.assert_allclose(field.align(np.array([[10.0, 50]])), [[10, 47]])


def test_the_values_everywhere_are_those_at_each_place(field):
    rows, columns = np.mgrid[: SIZE[1] : 7, : SIZE[0] : 7]
    at_places_px = field.measure_lower_px(np.column_stack([columns.ravel(), rows.ravel()]).astype(float))
    everywhere_px = field.measure_everywhere_px()
    assert everywhere_px.shape == SIZE[::-1]
    np.testing.assert_allclose(everywhere_px[::7, ::7].ravel(), at_places_px, atol=1e-5)


def test_aligned_points_take_their_content_from_where_the_points_were(field):
    places_px = np.random.default_rng(2).uniform(0, SIZE, (50, 2))
    aligned_px = field.align(places_px)
    np.testing.assert_array_equal(aligned_px[:, 0], places_px[:, 0])
    np.testing.assert_allclose(
        aligned_px[:, 1] + field.measure_lower_px(aligned_px), places_px[:, 1], atol=1e-6
    )
