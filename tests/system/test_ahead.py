"""Items computed ahead of their use."""

import threading

import pytest

from stereoweave.system.ahead import ahead


def test_items_keep_their_order():
    assert list(ahead(range(7), 3)) == [0, 1, 2, 3, 4, 5, 6]


def test_later_items_are_computed_while_an_earlier_one_is_in_use():
    third = threading.Event()

    def items():
        yield 0
        yield 1
        third.set()
        yield 2

    found = ahead(items(), 2)
    assert next(found) == 0
    assert third.wait(10)


def test_no_more_items_than_asked_for_are_computed_ahead():
    computed = []
    found = ahead((computed.append(number) for number in range(9)), 2)
    next(found)
    found.close()
    assert 1 <= len(computed) <= 3


def test_closing_ends_the_items_too():
    ended = []

    def items():
        try:
            yield from range(9)
        finally:
            ended.append(True)

    found = ahead(ahead(items(), 1), 1)
    next(found)
    found.close()
    assert ended == [True]


def test_an_error_is_raised_at_the_place_of_its_item():
    def items():
        yield 1
        raise ValueError("damaged")

    found = ahead(items(), 4)
    assert next(found) == 1
    with pytest.raises(ValueError, match="damaged"):
        next(found)
