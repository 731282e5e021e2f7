import numpy as np
import pytest
from learn_examples import box_before_a_wall

from stereoweave.bench.projection import fill_from_rows, project_right
from stereoweave.errors import StereoweaveError
from stereoweave.stereo import View


def grey(levels):
    return np.repeat(np.array(levels, np.uint8)[..., None], 3, axis=2)


def plain_projection(left, disparity_px):
    """Project pixel by pixel; a pixel is replaced by one that is nearer."""
    height, width = disparity_px.shape
    image, nearest_px = np.zeros_like(left), np.full((height, width), -np.inf)
    for y in range(height):
        for x in range(width):
            if np.isfinite(disparity_px[y, x]):
                column = int(np.floor(x - disparity_px[y, x] + 0.5))
                if 0 <= column < width and disparity_px[y, x] > nearest_px[y, column]:
                    image[y, column], nearest_px[y, column] = left[y, x], disparity_px[y, x]
    return image, nearest_px > -np.inf


def plain_fill(image, drawn):
    filled = np.zeros_like(image)
    for y in range(len(image)):
        seen = np.flatnonzero(drawn[y])
        if len(seen) == 0:
            filled[y] = filled[y - 1] if y else 0
            continue
        for x in range(image.shape[1]):
            to_the_right = seen[seen >= x]
            filled[y, x] = image[y, to_the_right[0] if len(to_the_right) else seen[-1]]
    return filled


def test_a_pixel_goes_to_the_nearest_column_to_the_left_by_its_disparity():
    view = project_right(grey([[10, 20, 30, 40, 50]]), np.array([[0.0, 0.4, 0.6, 2.5, 1.0]]))
    # They land at 0, 0.6, 1.4, 0.5 and 3: in columns 0, 1, 1, 1 and 3.
    np.testing.assert_array_equal(view.image, grey([[10, 40, 0, 50, 0]]))
    np.testing.assert_array_equal(view.drawn, [[True, True, False, True, False]])


@pytest.mark.parametrize("far_px", [-1.0, 0.0, 0.6])
def test_the_nearer_surface_wins(far_px):
    # The far pixel of column 1 lands on column 2, 1 or 0, and the near ones of columns 2 and 3 with it.
    column = round(1 - far_px)
    view = project_right(grey([[10, 20, 30, 40]]), np.array([[99.0, far_px, 2.0 - column, 3.0 - column]]))
    np.testing.assert_array_equal(np.flatnonzero(view.drawn), [column])
    assert (view.image[0, column] == 40).all()


def test_pixels_that_leave_the_picture_are_dropped():
    view = project_right(grey([[10, 20, 30]]), np.array([[1.0, 0.0, -1.0]]))
    np.testing.assert_array_equal(view.image, grey([[0, 20, 0]]))


def test_halves_keep_every_column():
    view = project_right(grey([[10, 20, 30, 40]]), np.full((1, 4), 0.5))
    np.testing.assert_array_equal(view.image, grey([[10, 20, 30, 40]]))


def test_pixels_of_unknown_disparity_are_not_projected():
    view = project_right(grey([[10, 20, 30, 40]]), np.array([[np.nan, 1.0, np.inf, -np.inf]]))
    np.testing.assert_array_equal(view.drawn, [[True, False, False, False]])
    np.testing.assert_array_equal(view.image, grey([[20, 0, 0, 0]]))


def test_projection_equals_the_plain_one(rng):
    left = rng.integers(1, 256, (12, 30, 3), dtype=np.uint8)
    disparity_px = rng.uniform(-4, 12, (12, 30)).astype(np.float32)
    disparity_px[rng.random(disparity_px.shape) < 0.2] = np.nan
    view = project_right(left, disparity_px)
    image, drawn = plain_projection(left, disparity_px)
    np.testing.assert_array_equal(view.image, image)
    np.testing.assert_array_equal(view.drawn, drawn)


def test_true_disparity_gives_the_right_photograph_wherever_it_has_a_source(rng):
    sample = box_before_a_wall(rng)
    view = project_right(sample.left, sample.disparity_px)
    np.testing.assert_array_equal(view.drawn, ~sample.right_occluded)
    np.testing.assert_array_equal(view.image[view.drawn], sample.right[view.drawn])


def test_a_hole_takes_the_next_colour_to_its_right_else_the_last_to_its_left():
    drawn = np.array([[0, 1, 0, 0, 1, 0], [0, 0, 0, 0, 0, 0], [1, 0, 0, 0, 0, 0]], bool)
    # 99 is the value in holes; it must not show.
    image = grey(np.where(drawn, [[0, 20, 0, 0, 50, 0], [0] * 6, [70] * 6], 99))
    filled = fill_from_rows(View(image=image, drawn=drawn))
    np.testing.assert_array_equal(
        filled, grey([[20, 20, 50, 50, 50, 50], [20, 20, 50, 50, 50, 50], [70] * 6])
    )


def test_rows_above_the_first_colour_are_black():
    drawn = np.array([[False, False], [False, True]])
    filled = fill_from_rows(View(image=grey([[99, 99], [99, 7]]), drawn=drawn))
    np.testing.assert_array_equal(filled, grey([[0, 0], [7, 7]]))


def test_the_area_that_a_box_uncovers_is_filled_with_the_wall_behind_it(rng):
    sample = box_before_a_wall(rng)
    filled = fill_from_rows(project_right(sample.left, sample.disparity_px))
    # The box spans columns 24..71 and moves by 12 to 12..59; the wall behind begins at 72 - 4 = 68.
    assert (filled[32, 60:68] == sample.right[32, 68]).all()


@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 1.0])
def test_filling_equals_the_plain_one(rng, share):
    image = rng.integers(0, 256, (20, 30, 3), dtype=np.uint8)
    drawn = rng.random((20, 30)) < share
    np.testing.assert_array_equal(fill_from_rows(View(image=image, drawn=drawn)), plain_fill(image, drawn))


@pytest.mark.usefixtures("without_shape_checks")
def test_a_disparity_of_another_size_is_refused():
    with pytest.raises(StereoweaveError, match=r"expected the left image's shape \(2, 3\), found \(2, 1\)"):
        project_right(grey([[1, 2, 3], [4, 5, 6]]), np.zeros((2, 1)))
