"""The time that a request will take, estimated before its pictures are decoded; too much of it is refused."""

import math
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from statistics import median

from stereoweave.errors import StereoweaveError
from stereoweave.service.answers import Order, TooLargeError

# What large pictures take longer, for each of their pixels, and what full resolution takes longer. Checks and
# rectification take a fraction of a second whatever the size.
_LARGE_FROM_MEGAPIXELS, _LARGE, _REFINED = 2, 2.5, 1.3
# Speeds that are remembered: an odd request or two do not change their median.
_LATEST = 9


class BusyError(StereoweaveError):
    """A request that can be done, but not in time after those that were accepted before it."""

    def __init__(self, message: str, retry_after_s: int = 1) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s


class Budget:
    """The work that one process has accepted, and the seconds that each unit of `work_of` takes it.

    A request that could not be done in time at the best speed so far is refused for good. One that has to
    wait for others is refused for now if their work and its own take too long at the usual speed, the median
    of the last few.
    """

    def __init__(self, seconds_each: float) -> None:
        self._accepted: list[float] = []
        self._best_each_s = seconds_each
        self._latest_each_s = deque([seconds_each], _LATEST)

    @contextmanager
    def admit(self, order: Order, megapixels: float, left_s: float) -> Iterator[None]:
        """Within the block the order counts as accepted.

        Raises:
            TooLargeError: It takes longer than the `left_s` seconds that are left for it.
            BusyError: It does after what was accepted before it.
        """
        work = work_of(order, megapixels)
        least_s = work * self._best_each_s
        if least_s > left_s:
            raise TooLargeError(
                f"expected a request that takes at most {left_s:.0f} s, found {megapixels:.1f} megapixels, "
                f"which take {least_s:.0f} s with its options; send smaller pictures, or fewer options"
            )
        late_s = (sum(self._accepted) + work) * median(self._latest_each_s) - left_s
        if self._accepted and late_s > 0:
            raise BusyError(
                f"expected at most {left_s:.0f} s of work, found {late_s:.0f} s more; come again",
                retry_after_s=math.ceil(late_s),
            )
        self._accepted.append(work)
        try:
            yield
        finally:
            self._accepted.remove(work)

    def learn(self, work: float, took_s: float, *, finished: bool = True) -> None:
        """Take into account how long an amount of work took, or after how long it was stopped unfinished."""
        each_s = took_s / work
        if finished:
            self._best_each_s = min(self._best_each_s, each_s)
        else:  # it would have taken longer than that
            each_s = max(each_s, median(self._latest_each_s))
        self._latest_each_s.append(each_s)


def work_of(order: Order, megapixels: float) -> float:
    """The work of an order: as many megapixels of a plain disparity of small pictures take as long."""
    large = _LARGE if megapixels > _LARGE_FROM_MEGAPIXELS else 1
    refined = _REFINED if order.refined or order.is_view else 1
    return megapixels * large * refined
