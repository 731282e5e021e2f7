"""The number of threads to use, and work in parallel: on bands of rows, or by several functions."""

import os
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextvars import copy_context
from itertools import accumulate, pairwise
from typing import Any, TypeVar

from stereoweave.arguments import check_whole_number
from stereoweave.errors import StereoweaveError

Result = TypeVar("Result")

_MOST_THREADS = 1024
_pool = ThreadPoolExecutor(_MOST_THREADS)


def _renew_pool() -> None:
    global _pool
    _pool = ThreadPoolExecutor(_MOST_THREADS)


# A forked child has none of its parent's threads.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew_pool)


def thread_count(threads: int | None) -> int:
    """Return the number of threads to use: the requested number, or one per usable core by default.

    Raises:
        StereoweaveError: The requested number is out of range.
    """
    if threads is not None:
        threads = check_whole_number("threads", threads)
        if not 1 <= threads <= _MOST_THREADS:
            raise StereoweaveError(
                f"expected a number from 1 to {_MOST_THREADS}, got {threads}", setting="threads"
            )
    return threads or usable_cores()


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_bands(work: Callable[[int, int], None], height: int, count: int, threads: int) -> None:
    """Call `work(first_row, end_row)` for each of `count` bands of rows, in this and other threads.

    The other threads are kept for the next call, because to start one may take longer than a band. They may
    be at work for other callers; this thread then works through the bands alone.
    """
    _work_through(work, [height * band // count for band in range(count + 1)], threads)


def in_even_bands(work: Callable[[int, int], None], amounts: Sequence[float], threads: int) -> None:
    """Call `work` for one band per thread, as `in_bands` does; all bands have about the same work.

    Args:
        work: Function of the first and the end row of a band.
        amounts: The amount of work in each row.
        threads: Number of threads.
    """
    # A row belongs to the band in which the middle of its work lies.
    middles = [done - amount / 2 for done, amount in zip(accumulate(amounts), amounts, strict=True)]
    total = sum(amounts)
    inner = [bisect_left(middles, total * band / threads) for band in range(1, threads)]
    _work_through(work, [0, *inner, len(amounts)], threads)


def _work_through(work: Callable[[int, int], None], ends: Sequence[int], threads: int) -> None:
    bands = deque(pairwise(ends))

    def work_off() -> None:
        while True:
            try:
                band = bands.popleft()
            except IndexError:
                return
            work(*band)

    # With the caller's context variables, such as the listener to its steps.
    others: list[Future[None]] = []
    try:
        for _ in range(min(threads, len(bands)) - 1):
            others.append(_pool.submit(copy_context().run, work_off))
        work_off()
    finally:
        bands.clear()  # after an error
        started = [other for other in others if not other.cancel()]
        wait(started)
    for other in started:
        other.result()


def run_together(functions: Sequence[Callable[[], Any]], threads: int) -> list[Any]:
    """Return what each function returns; up to `threads` of them run at once."""
    results: list[Any] = [None] * len(functions)

    def run(first: int, end: int) -> None:
        for index in range(first, end):
            results[index] = functions[index]()

    in_bands(run, len(functions), len(functions), threads)
    return results


def beyond_ctrl_c(work: Callable[[], Result]) -> Result:
    """Return what `work` returns, from a thread of its own. An interrupt waits until `work` has ended.

    Python raises KeyboardInterrupt in the main thread alone. There, it may come between the taking of a lock
    and the block that releases it; the lock is then held for as long as anyone holds the error.
    """
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(copy_context().run, work).result()
