import multiprocessing
import os
import threading
from contextvars import ContextVar

import pytest

from stereoweave.errors import StereoweaveError
from stereoweave.system.threads import (
    beyond_ctrl_c,
    in_bands,
    in_even_bands,
    run_together,
    thread_count,
    usable_cores,
)


def test_the_default_number_of_threads_is_the_number_of_usable_cores():
    assert thread_count(3) == 3
    assert thread_count(None) == usable_cores()
    assert 1 <= usable_cores() <= (os.cpu_count() or 1)


@pytest.mark.parametrize("threads", [0, -2])
def test_less_than_one_thread_is_refused(threads):
    with pytest.raises(StereoweaveError, match=f"threads: expected a number from 1 to 1024, got {threads}"):
        thread_count(threads)


def test_work_beyond_ctrl_c_has_a_thread_and_the_caller_s_context():
    chosen = ContextVar("chosen")
    chosen.set(7)
    assert beyond_ctrl_c(lambda: (chosen.get(), threading.current_thread() is threading.main_thread())) == (
        7,
        False,
    )
    with pytest.raises(ZeroDivisionError):
        beyond_ctrl_c(lambda: 1 / 0)


def test_bands_cover_all_rows_once_in_the_caller_s_context():
    chosen, seen = ContextVar("chosen"), []
    chosen.set(7)
    in_bands(lambda first, end: seen.append((first, end, chosen.get())), 10, 4, 3)
    assert sorted(seen) == [(0, 2, 7), (2, 5, 7), (5, 7, 7), (7, 10, 7)]


@pytest.mark.parametrize(
    ("amounts", "threads", "bands"),
    [
        ([2, 2, 2, 2], 2, [(0, 2), (2, 4)]),
        ([0, 0, 6, 1, 1, 4], 2, [(0, 3), (3, 6)]),
        ([9, 1, 1, 1], 3, [(0, 0), (0, 1), (1, 4)]),
        ([0, 0, 0], 2, [(0, 0), (0, 3)]),
        ([5, 1], 1, [(0, 2)]),
    ],
)
def test_even_bands_cover_all_rows_and_have_about_the_same_work(amounts, threads, bands):
    seen = []
    in_even_bands(lambda *rows: seen.append(rows), amounts, threads)
    assert sorted(seen) == bands


def test_functions_that_wait_for_each_other_run_together_and_return_in_order():
    together = threading.Barrier(3)
    works = [lambda number=number: (together.wait(timeout=20), number)[1] for number in range(3)]
    assert run_together(works, 3) == [0, 1, 2]
    assert run_together([lambda: "alone"], 1) == ["alone"]


def meet():
    together = threading.Barrier(3)
    in_bands(lambda *_: together.wait(timeout=20), 3, 3, 3)


def test_as_many_threads_as_asked_work_on_bands_at_once():
    meet()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_a_forked_process_gets_threads_of_its_own():
    meet()
    child = multiprocessing.get_context("fork").Process(target=meet)
    child.start()
    child.join(60)
    assert child.exitcode == 0


def test_one_thread_works_on_bands_in_turn():
    workers = set()
    in_bands(lambda *_: workers.add(threading.get_ident()), 8, 8, 1)
    assert workers == {threading.get_ident()}


def test_bands_within_bands_do_not_wait_for_each_other():
    rows = []

    def work(first, end):
        in_bands(lambda *inner: rows.append((first, *inner)), end - first, 3, 3)

    in_bands(work, 9, 3, 3)
    assert len(rows) == len(set(rows)) == 9


@pytest.mark.parametrize("failing", [0, 1])
def test_the_error_of_any_band_reaches_the_caller_after_all_have_ended(failing):
    together, ended = threading.Barrier(2), []

    def work(first, _):
        together.wait(timeout=20)
        if first == failing:
            raise IndexError(f"row {first}")
        ended.append(first)

    with pytest.raises(IndexError, match=f"row {failing}"):
        in_bands(work, 2, 2, 2)
    assert ended == [1 - failing]
