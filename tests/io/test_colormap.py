import numpy as np

from stereoweave.io.colormap import (
    OCCLUDED_RGB,
    colour_confidence,
    colour_disparity,
    find_colour_range_px,
    legend_colours,
)


def test_a_few_outliers_do_not_reduce_the_contrast():
    disparity_px = np.linspace(10, 50, 1000, dtype=np.float32).reshape(20, 50)
    disparity_px[0, 0], disparity_px[19, 49] = -900, 900
    low_px, high_px = find_colour_range_px(disparity_px)
    assert 10 <= low_px < 10.3
    assert 49.7 < high_px <= 50


def test_a_flat_disparity_has_a_range_of_a_pixel():
    assert find_colour_range_px(np.full((4, 4), 7, np.float32)) == (7.0, 8.0)


def test_far_is_bluer_and_near_is_redder():
    far, near = colour_disparity(np.array([[12, 38]], np.float32), (10.0, 40.0))[0].astype(int)
    assert far[2] > far[0]
    assert near[0] > near[2]


def test_disparities_beyond_the_range_get_its_end_colours():
    below, low, high, above = colour_disparity(np.array([[-50, 0, 10, 99]], np.float32), (0.0, 10.0))[0]
    assert (below == low).all()
    assert (above == high).all()


def test_confidence_is_grey_and_occluded_pixels_are_not():
    picture = colour_confidence(
        np.array([[0, 0.2, 1, 1]], np.float32), np.array([[False, False, False, True]])
    )
    assert picture[0].tolist() == [[0, 0, 0], [51, 51, 51], [255, 255, 255], list(OCCLUDED_RGB)]


def test_the_legend_runs_through_the_colours_of_the_picture():
    ends = colour_disparity(np.array([[3, 8]], np.float32), (3.0, 8.0))[0].tolist()
    legend = legend_colours(7)
    assert len(legend) == 7
    assert [legend[0], legend[-1]] == [f"rgb({red},{green},{blue})" for red, green, blue in ends]
