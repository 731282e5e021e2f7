"""Numbers of threads, and work on bands of rows in threads."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from stereoweave.arguments import check_whole_number
from stereoweave.errors import StereoweaveError

_MOST_THREADS = 1024


def thread_count(threads: int | None) -> int:
    """The requested number of threads, default: all cores; raises StereoweaveError if it is out of range."""
    if threads is not None:
        check_whole_number("threads", threads)
        if not 1 <= threads <= _MOST_THREADS:
            raise StereoweaveError(
                f"expected 1 or more, got {threads}; {_MOST_THREADS} at most", setting="threads"
            )
    return threads or usable_cores()


def usable_cores() -> int:
    """The number of cores that this process may use, at most those of the machine."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_bands(work: Callable[[int, int], None], height: int, count: int, threads: int) -> None:
    """Call `work(first_row, end_row)` for each of `count` bands of rows, in threads."""
    ends = [height * band // count for band in range(count + 1)]
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, ends[:-1], ends[1:]))
