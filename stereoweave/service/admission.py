"""Admission of requests by their estimated time, before their pictures are decoded."""

import math
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from statistics import median

from stereoweave.errors import StereoweaveError
from stereoweave.service.answers import ServiceJob, TooLargeError

# Factors of time per pixel for large pictures, and for full resolution. Checks and rectification take a
# fraction of a second at any size.
_LARGE_FROM_MEGAPIXELS, _LARGE, _REFINED = 2, 2.5, 1.3
# The number of recent speeds; one or two outliers do not change their median.
_LATEST = 9


class BusyError(StereoweaveError):
    """A request that would be late only because of those accepted before it."""

    def __init__(self, message: str, retry_after_s: int = 1) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s


class Budget:
    """The accepted work of one process, and its time per unit of `estimate_work`.

    A request is refused permanently if it could not finish in time at the best speed so far. It is refused
    temporarily if it would be late after the accepted ones at the usual speed, the median of the last few.
    """

    def __init__(self, seconds_each: float) -> None:
        self._accepted: list[float] = []
        self._best_each_s = seconds_each
        self._latest_each_s = deque([seconds_each], _LATEST)

    @contextmanager
    def admit(self, job: ServiceJob, megapixels: float, left_s: float) -> Iterator[None]:
        """Count the job as accepted within the block.

        Raises:
            TooLargeError: If the job alone takes longer than `left_s`.
            BusyError: If it takes longer than that after the accepted ones.
        """
        work = estimate_work(job, megapixels)
        least_s = work * self._best_each_s
        if least_s > left_s:
            raise TooLargeError(
                f"expected a request that takes at most {left_s:.0f} s, found {megapixels:.1f} megapixels, "
                f"which take {least_s:.0f} s with its options; send smaller pictures, or fewer options"
            )
        late_s = (sum(self._accepted) + work) * median(self._latest_each_s) - left_s
        if self._accepted and late_s > 0:
            raise BusyError(
                f"expected at most {left_s:.0f} s of work, found {late_s:.0f} s more; try again later",
                retry_after_s=math.ceil(late_s),
            )
        self._accepted.append(work)
        try:
            yield
        finally:
            self._accepted.remove(work)

    def learn(self, work: float, took_s: float, *, finished: bool = True) -> None:
        """Update the speeds with the time that work took, or after which it was stopped unfinished."""
        each_s = took_s / work
        if finished:
            self._best_each_s = min(self._best_each_s, each_s)
        else:  # it would have taken longer
            each_s = max(each_s, median(self._latest_each_s))
        self._latest_each_s.append(each_s)


def estimate_work(job: ServiceJob, megapixels: float) -> float:
    """The work of a job, in megapixels of unrefined disparity of small pictures that take as long."""
    large = _LARGE if megapixels > _LARGE_FROM_MEGAPIXELS else 1
    refined = _REFINED if job.match_options.refined else 1
    return megapixels * large * refined
