from fractions import Fraction

import pytest

from stereoweave.video.times import format_frame_time, format_time


@pytest.mark.parametrize(
    ("time_s", "decimals", "shown"),
    [(62.345, 1, "1:02.3"), (62.345, 0, "1:02"), (3605.0, 1, "60:05.0"), (0.04, 2, "0:00.04")],
)
def test_times_are_minutes_and_seconds(time_s, decimals, shown):
    assert format_time(time_s, decimals=decimals) == shown


@pytest.mark.parametrize(
    ("time_s", "shown"), [(Fraction(62345, 1000), "0:01:02.345"), (Fraction(7325), "2:02:05.000")]
)
def test_the_time_of_a_frame_has_hours_and_milliseconds(time_s, shown):
    assert format_frame_time(time_s) == shown


def test_no_time_has_60_seconds():
    assert format_frame_time(Fraction(599_997, 10_000)) == "0:01:00.000"
    assert format_time(59.97) == "1:00.0"
