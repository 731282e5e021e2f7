"""Timestamps of a stream, worked out by hand."""

from array import array
from types import SimpleNamespace

from stereoweave.video.timestamps import fill_missing, number_by_rank, separate_duplicates


def test_a_duplicate_is_delayed_by_one_frame_if_there_is_room():
    assert separate_duplicates([0, 40, 40, 200, 200], frame_steps=40) == (
        array("q", [0, 40, 80, 200, 240]),
        [2, 4],
    )


def test_times_increase_even_without_room_between_duplicates():
    steps, moved = separate_duplicates([0, 5, 5, 5, 6, 9], frame_steps=4)
    assert list(steps) == [0, 5, 6, 7, 8, 9]
    assert moved == [2, 3]


def test_a_missing_time_stamp_is_replaced_by_the_previous_one():
    assert fill_missing([None, 40, None, 120]) == [40, 40, 40, 120]


def test_with_b_frames_a_lost_frame_is_noticed_at_the_next_key_frame():
    # The file contains I0 P1 B2 B3 P4 I5 P6, and B3 is lost.
    shown = [SimpleNamespace(opaque=rank, key_frame=rank in (0, 5)) for rank in (0, 2, 1, 4, 5, 6)]
    decoder = SimpleNamespace(codec_context=SimpleNamespace(has_b_frames=True))
    assert [number for number, _ in number_by_rank(iter(shown), decoder)] == [0, 1, 2, 3, 5, 6]
