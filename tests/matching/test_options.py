import numpy as np
import pytest

import stereoweave as sw
from stereoweave.errors import StereoweaveError
from stereoweave.matching.options import MatchOptions


@pytest.mark.parametrize("range_px", [(10, 10), (50, 0), (0, float("nan")), (float("-inf"), 10)])
def test_a_range_of_other_than_two_finite_ascending_numbers_is_refused(range_px):
    with pytest.raises(StereoweaveError, match="range_px: expected the least and the greatest"):
        MatchOptions(range_px=range_px)


@pytest.mark.usefixtures("without_shape_checks")
def test_a_range_that_is_one_number_is_refused_with_the_number():
    with pytest.raises(StereoweaveError, match="such as -20 and 150, got 64; omit it"):
        MatchOptions(range_px=64)


def test_invalid_options_are_refused_first():
    with pytest.raises(StereoweaveError, match="^range_px: "):
        sw.estimate("no picture", "no picture", model="no model", range_px=(5.0, 2.0))
    with pytest.raises(StereoweaveError, match="^raw: cannot be combined with refined"):
        sw.estimate("no picture", "no picture", model="no model", refined=True, raw=True)


@pytest.mark.usefixtures("without_shape_checks")
def test_equal_options_are_one_key_for_any_type_of_range():
    for range_px in ([-8, 96], np.array([-8, 96]), (np.float32(-8), 96.0)):
        options = MatchOptions(range_px=range_px)
        assert {options: "found"}[MatchOptions(range_px=(-8.0, 96.0))] == "found"
        assert repr(options.range_px) == "(-8.0, 96.0)"
