from dataclasses import replace

import numpy as np
import pytest

from experiments.handheld.pairs import take_again
from experiments.handheld.scoring import score, summarize
from stereoweave.stereo import StereoPair


@pytest.mark.parametrize("index", range(4))
def test_a_hand_held_pair_ends_under_half_a_pixel_and_keeps_nine_tenths(original, index):
    row = score(take_again(original, index))
    assert row.vertical_error_before_px > 5
    assert row.vertical_error_px < 0.5
    assert row.vertical_error_95_px < 1.5
    assert row.lost_percent < 10
    assert row.refused == ""


def test_a_pair_of_two_scenes_is_refused_and_counts_as_failed(original):
    made = take_again(original, 0)
    noise = np.random.default_rng(0).integers(0, 256, made.pair.left.shape, np.uint8)
    row = score(replace(made, pair=StereoPair(left=made.pair.left, right=noise)))
    assert row.refused.startswith("rectify: expected at least 40 feature matches")
    assert summarize([row, score(made)]) == (
        "1 of 2 pairs end under 0.5 px, and 1 of these lose at most 10 %"
    )
