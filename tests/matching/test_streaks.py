import numpy as np

from stereoweave.matching.streaks import smooth_streaks
from stereoweave.stereo import Estimate

HEIGHT, WIDTH = 24, 40


def smooth(left_px, right_px):
    estimate = Estimate(
        disparity_px=left_px,
        right_disparity_px=right_px,
        confidence=np.ones_like(left_px),
        occluded=np.zeros(left_px.shape, bool),
    )
    smoothed = smooth_streaks(estimate)
    return smoothed.disparity_px, smoothed.right_disparity_px


def plane(disparity_px=10.0):
    return np.full((HEIGHT, WIDTH), disparity_px, np.float32)


def test_a_streak_vanishes_where_nothing_can_match_and_stays_where_something_can():
    left_px, right_px = plane(), plane()
    left_px[8:11], right_px[14:17] = 14, 14
    smoothed_left_px, smoothed_right_px = smooth(left_px, right_px)
    # Columns 0 to 13 of a disparity of 14 px have no match.
    assert (smoothed_left_px[:, :14] == 10).all()
    assert np.array_equal(smoothed_left_px[:, 14:], left_px[:, 14:])
    assert (smoothed_right_px[:, -14:] == 10).all()
    assert np.array_equal(smoothed_right_px[:, :-14], right_px[:, :-14])


def test_a_surface_of_six_rows_or_more_keeps_its_edges():
    left_px = plane()
    left_px[:12] = 14
    assert np.array_equal(smooth(left_px, plane())[0], left_px)


def test_negative_disparities_match_everywhere_in_the_left_border():
    left_px = plane(-3.0)
    left_px[5] = -4
    assert np.array_equal(smooth(left_px, left_px)[0], left_px)


def test_smoothed_pixels_are_the_medians_of_the_eleven_pixels_of_their_columns(rng):
    left_px, right_px = rng.uniform(-5, WIDTH, (2, HEIGHT, WIDTH)).astype(np.float32)
    found = smooth(left_px, right_px)
    matches = np.arange(WIDTH) - left_px, np.arange(WIDTH)[::-1] - right_px
    for given_px, found_px, column in zip((left_px, right_px), found, matches, strict=True):
        around = np.pad(given_px, ((5, 5), (0, 0)), mode="edge")
        medians_px = [np.median(around[y : y + 11], axis=0) for y in range(HEIGHT)]
        np.testing.assert_array_equal(found_px, np.where(column < 0, medians_px, given_px))
