"""Items computed ahead of their use, in a thread of their own."""

from collections import deque
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from itertools import islice
from typing import TypeVar

Item = TypeVar("Item")


def ahead(items: Iterable[Item], count: int) -> Iterator[Item]:
    """Yield the items in order; a thread computes up to `count` of them in advance.

    An error among the items is raised where the item would have been yielded. Once this generator is closed,
    no further item is computed; closing waits for the item at work.
    """
    iterator, context = iter(items), copy_context()

    def compute() -> list[Item]:
        """Return the next item in a list, which is empty after the last one."""
        return context.run(lambda: list(islice(iterator, 1)))

    try:
        with ThreadPoolExecutor(1, thread_name_prefix="ahead") as pool:
            coming = deque(pool.submit(compute) for _ in range(count))
            try:
                while found := coming.popleft().result():
                    coming.append(pool.submit(compute))
                    yield from found
            finally:
                for future in coming:
                    future.cancel()
    finally:
        if isinstance(iterator, Generator):  # such as another `ahead`
            iterator.close()
