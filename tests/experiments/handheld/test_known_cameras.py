from dataclasses import replace

import numpy as np

from experiments.handheld.known_cameras import draw_pair, score_pair, summarize_known_cameras


def test_distances_of_a_known_camera_are_right_and_rows_as_close_as_without(original):
    row = score_pair(*draw_pair(original, 0))
    assert row.vertical_error_before_px > 2
    assert row.vertical_error_px < max(0.1, 1.5 * row.unknown_camera_px)
    assert row.distance_error_percent < 3
    lost = replace(row, distance_error_percent=float("nan"), vertical_error_px=0.3)
    assert summarize_known_cameras([replace(row, distance_error_percent=2.0), lost]).startswith(
        "1 of 2 pairs keep metres; distances are off by 2.00 % in the median, 2.00 % at worst; rows by "
    )


def test_a_true_distance_is_measured_from_the_camera(original):
    made, _, camera = draw_pair(original, 0)
    # Twice the focal length at the same disparities is twice the distance: the score then sees an error.
    row = score_pair(made, replace(original, focal_px=2 * original.focal_px), camera)
    assert not row.distance_error_percent < 5
    assert np.isfinite(row.vertical_error_px)
