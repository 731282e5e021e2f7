import cv2
import numpy as np
import pytest
from learn_examples import box_before_a_wall
from matplotlib.colors import to_rgb

from experiments.paper import figures
from stereoweave.io.images import read_image

LARGEST_BYTES = 300_000
CURVES = {
    "p = 1": [[(10, 0.3), (20, 0.2)], [(10, 0.1), (20, 0.1), (30, 0.1)]],
    "p = 1.5": [[(10, 0.1), (20, 0.05)]],
}


def pixels_of(picture, rgb):
    """Return the number of pixels of a colour in a PNG."""
    return int((picture == np.round(np.array(rgb) * 255)).all(2).sum())


def drawn(path, draw, *arguments):
    draw(path, *arguments)
    assert path.read_bytes().startswith(b"\x89PNG")
    assert path.stat().st_size < LARGEST_BYTES
    return read_image(path)


def test_every_exponent_has_its_curve_in_its_own_colour(tmp_path):
    picture = drawn(tmp_path / "curves.png", figures.draw_exponent_curves, [1, 1.5])
    blue, orange, green = (pixels_of(picture, to_rgb(colour)) for colour in ("#0072B2", "#D55E00", "#009E73"))
    assert min(blue, orange) > 300
    assert green == 0


def test_the_histogram_stands_behind_the_curves_where_its_counts_are(tmp_path):
    near = drawn(tmp_path / "near.png", figures.draw_exponent_curves, [1.0], np.array([0, 0, 0, 4]))
    bars = (near[near.shape[0] * 2 // 3] == round(0.88 * 255)).all(1)
    # The axes begin at about a tenth of the picture's width, and their last quarter at three quarters of it.
    assert bars[-bars.size // 4 :].sum() > 0.8 * bars.size // 4
    assert bars[: bars.size * 7 // 10].sum() < 10


def test_the_mean_of_the_seeds_is_over_the_steps_that_all_have():
    steps, losses = figures._mean_curve(CURVES["p = 1"])
    assert steps == [10, 20]
    assert losses == pytest.approx([0.2, 0.15])


def test_a_setting_has_one_colour_and_losses_move_its_curve(tmp_path):
    one = drawn(tmp_path / "one.png", figures.draw_validation, CURVES)
    other = drawn(
        tmp_path / "other.png", figures.draw_validation, CURVES | {"p = 1.5": [[(10, 0.1), (20, 0.3)]]}
    )
    assert min(pixels_of(one, to_rgb(colour)) for colour in ("#0072B2", "#D55E00")) > 300
    assert one.shape == other.shape
    assert (one != other).any(2).sum() > 300


def test_the_iterations_stand_between_the_left_image_and_the_truth_in_its_colours(tmp_path, rng):
    sample = box_before_a_wall(rng)
    wall, box = np.full_like(sample.disparity_px, 4), np.full_like(sample.disparity_px, 12)
    rows = [(sample, {"10 iterations": wall, "50 iterations": box})]
    picture = drawn(tmp_path / "iterations.png", figures.draw_iterations, rows)
    row = picture[int(0.58 * picture.shape[0])]
    places = [row[round(share * picture.shape[1])] for share in (3 / 8, 5 / 8, 7 / 8)]
    # At the sampled place, the truth shows the box, as the second estimate does.
    assert (places[0] != places[1]).any()
    np.testing.assert_array_equal(places[1], places[2])
    ends = cv2.applyColorMap(np.array([[0, 255]], np.uint8), cv2.COLORMAP_TURBO)[0, :, ::-1]
    np.testing.assert_array_equal(places[:2], ends)


def test_the_views_show_black_where_nothing_lands(tmp_path, rng):
    sample = box_before_a_wall(rng)
    nowhere = np.full_like(sample.disparity_px, np.nan)
    moved = drawn(tmp_path / "moved.png", figures.draw_views, [(sample, {"ours": sample.disparity_px})])
    black = drawn(tmp_path / "black.png", figures.draw_views, [(sample, {"ours": nowhere})])
    assert moved.shape == black.shape
    quarter = moved.shape[1] // 4
    # The columns before the last are the same in both rows; the last one is black in the second row.
    np.testing.assert_array_equal(moved[:, : 3 * quarter], black[:, : 3 * quarter])
    middle = np.s_[moved.shape[0] // 2, 3 * quarter + 20 : -20]
    assert moved[middle].any()
    assert not black[middle].any()


def test_rows_may_be_pictures_of_different_shapes(tmp_path, rng):
    tall, wide = box_before_a_wall(rng, (96, 64)), box_before_a_wall(rng, (64, 96))
    picture = drawn(tmp_path / "views.png", figures.draw_views, [(tall, {}), (wide, {})])
    # Three columns of 2.2 inches at 130 dots; heights 3.3 and 1.47 inches and the names.
    assert picture.shape[1] == 858
    assert picture.shape[0] == pytest.approx(130 * (3.3 + 2.2 * 2 / 3 + 0.3), abs=1)
