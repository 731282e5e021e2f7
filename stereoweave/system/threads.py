"""How many threads a call may use, and rows shared out among them."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from stereoweave.arguments import check_whole_number
from stereoweave.errors import StereoweaveError

_MOST_THREADS = 1024


def thread_count(threads: int | None) -> int:
    """The number asked for, or `usable_cores` where none is; StereoweaveError for what is no such number."""
    if threads is not None:
        check_whole_number("threads", threads)
        if not 1 <= threads <= _MOST_THREADS:
            raise StereoweaveError(f"threads: expected 1 or more, got {threads}; {_MOST_THREADS} at most")
    return threads or usable_cores()


def usable_cores() -> int:
    """The cores that this process may run on, which can be fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_bands(work: Callable[[int, int], None], height: int, count: int, threads: int) -> None:
    """Do the work on that many bands of rows, from one row to before another, in threads."""
    ends = [height * band // count for band in range(count + 1)]
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, ends[:-1], ends[1:]))
