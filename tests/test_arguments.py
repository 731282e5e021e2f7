"""Choices of a setting, what is suggested for a wrong one, and numbers of any kind."""

from fractions import Fraction

import numpy as np
import pytest

from stereoweave.arguments import check_choice, check_number, check_whole_number
from stereoweave.errors import MatcherError, StereoweaveError

LAYOUTS = ["side_by_side", "side_by_side_half", "top_bottom", "wiggle"]


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("side-by-side", "side_by_side"),
        ("Top Bottom", "top_bottom"),
        ("wigle", "wiggle"),
        ("side", "side_by_side or side_by_side_half"),
        ("sbs", "side_by_side"),
        ("TB", "top_bottom"),
    ],
)
def test_the_name_that_was_probably_meant_is_suggested(typed, meant):
    with pytest.raises(StereoweaveError) as refused:
        check_choice("layout", typed, LAYOUTS)
    assert str(refused.value) == (
        "layout: expected one of side_by_side, side_by_side_half, top_bottom, wiggle, "
        f"found {typed!r}; did you mean {meant}?"
    )


@pytest.mark.parametrize("typed", ["gpu", "xyz", "", None, 3, ["horse"]])
def test_nothing_is_suggested_for_what_resembles_no_name(typed):
    with pytest.raises(MatcherError) as refused:
        check_choice("layout", typed, LAYOUTS, MatcherError)
    assert str(refused.value) == (
        f"layout: expected one of side_by_side, side_by_side_half, top_bottom, wiggle, found {typed!r}"
    )


def test_an_array_of_names_is_no_choice():
    with pytest.raises(StereoweaveError, match=r"^layout: expected one of .*, found ndarray of <U6 \[\]$"):
        check_choice("layout", np.array("wiggle"), LAYOUTS)


def test_a_choice_is_accepted():
    check_choice("layout", "wiggle", LAYOUTS)


@pytest.mark.parametrize("half", [0.5, np.float16(0.5), np.longdouble(0.5), Fraction(1, 2)])
def test_a_number_of_any_kind_becomes_a_float(half):
    number = check_number("strength", half)
    assert (type(number), number) == (float, 0.5)


@pytest.mark.parametrize("two", [2, np.int8(2), np.uint64(2)])
def test_a_whole_number_of_any_kind_becomes_an_int(two):
    number = check_whole_number("threads", two)
    assert (type(number), number) == (int, 2)
