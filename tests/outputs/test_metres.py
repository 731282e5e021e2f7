"""Depths as users read them."""

import math

import pytest

from stereoweave.outputs.metres import format_metres


@pytest.mark.parametrize(
    ("depth_m", "text"),
    [
        (0.5, "0.500 m"),
        (7.514, "7.51 m"),
        (99.94, "99.9 m"),
        (99.96, "100 m"),
        (9_999.4, "9999 m"),
        (10_000, "over 10 km"),
        (math.inf, "infinity"),
        (None, "infinity"),
    ],
)
def test_a_depth_has_three_digits_up_to_100_m_and_is_only_far_beyond_10_km(depth_m, text):
    assert format_metres(depth_m) == text
