import numpy as np
import pytest

from stereoweave.learn.data.paint_kernels import REACH_PX, draw_outline_field, draw_stroke_field, expose

SQUARE = np.array([[10.0, 10.0], [20.0, 10.0], [20.0, 20.0], [10.0, 20.0]])
LEVELS = np.tile(np.arange(1021, dtype=np.float32) / 4, (3, 1))
STILL = np.zeros((3, 1021), np.float32)


def test_an_outline_field_is_the_signed_distance_to_the_outline():
    field = draw_outline_field((SQUARE - 0.25,), 0, 0, (30, 30))
    # The edges are at 9.75 and 19.75 in x and y; the distance is clamped to 2 px.
    assert field[15, 10] == pytest.approx(0.25)
    assert field[15, 9] == pytest.approx(-0.75)
    assert field[15, 11] == pytest.approx(1.25)
    assert field[15, 15] == REACH_PX
    assert field[15, 2] == -REACH_PX
    assert field[9, 9] == pytest.approx(-0.75 * 2**0.5)


def test_a_contour_within_a_contour_is_a_hole():
    inner = 15 + 0.5 * (SQUARE - 15)
    field = draw_outline_field((SQUARE, inner), 0, 0, (30, 30))
    assert field[15, 15] < 0 < field[15, 11]


def test_a_patch_is_a_part_of_the_whole():
    whole = draw_outline_field((SQUARE,), 0, 0, (30, 30))
    np.testing.assert_allclose(draw_outline_field((SQUARE,), 7, 12, (6, 9)), whole[12:18, 7:16], atol=1e-6)


def test_the_covered_area_is_that_of_the_polygon():
    triangle = np.array([[5.3, 4.1], [52.7, 20.2], [17.9, 55.5]])
    (ax, ay), (bx, by) = triangle[1] - triangle[0], triangle[2] - triangle[0]
    field = draw_outline_field((triangle,), 0, 0, (60, 60))
    assert np.clip(field + 0.5, 0, 1).sum() == pytest.approx(abs(ax * by - ay * bx) / 2, rel=0.003)


def test_a_rod_has_the_requested_thickness():
    rod = np.array([[5.0, 10.3], [40.0, 10.3]])
    field = draw_stroke_field(((rod, 1.5),), 0, 0, (20, 50))
    # The rod extends from row 8.8 to row 11.8.
    np.testing.assert_allclose(field[7:14, 20], [-1.8, -0.8, 0.2, 1.2, 0.8, -0.2, -1.2], atol=1e-5)


def test_an_exposure_without_changes_only_rounds():
    image = np.array([[[0.0, 99.6, 255.0], [17.25, 128.0, 1.0]]], np.float32)
    np.testing.assert_array_equal(expose(image, LEVELS, STILL, image), [[[0, 100, 255], [17, 128, 1]]])


def test_noise_has_the_requested_deviation():
    image = np.full((100, 100, 3), 120, np.float32)
    noise = np.random.default_rng(0).standard_normal(image.shape, np.float32)
    assert expose(image, LEVELS, STILL + 4, noise).std() == pytest.approx(4, rel=0.03)
