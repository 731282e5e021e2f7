"""Admission of requests by estimated processing time, before the pictures are decoded."""

import math
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from statistics import median

from stereoweave.errors import StereoweaveError
from stereoweave.service.answers import ServiceJob, TooLargeError

# Factors by which large pictures and refinement increase the time per pixel. Checks and rectification are not
# counted, because they take a fraction of a second at any size.
_LARGE_FROM_MEGAPIXELS, _LARGE, _REFINED = 2, 2.5, 1.3
# Number of recent speeds to keep; with this many, one or two outliers hardly change the median.
_LATEST = 9


class BusyError(StereoweaveError):
    """Error for a request that would be late, but need not be if it is sent again."""

    def __init__(self, message: str, retry_after_s: int = 1) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s


class Budget:
    """The work that one process has accepted, and the time that it takes per unit of work.

    A request is refused permanently if it could not finish within the time limit even at the best speed so
    far. It is refused temporarily if too much of its time has passed, or if, at the median of recent speeds,
    it would be late after all accepted requests.

    Args:
        seconds_each: Seconds per unit of work.
        limit_s: Time limit of a request.
        refines: Whether the model always refines (`Matcher.refines`), so that the option adds no work.
    """

    def __init__(self, seconds_each: float, limit_s: float, *, refines: bool = False) -> None:
        self._limit_s, self._refines = limit_s, refines
        self._accepted: list[float] = []
        self._best_each_s = seconds_each
        self._latest_each_s = deque([seconds_each], _LATEST)

    @contextmanager
    def admit(self, job: ServiceJob, megapixels: float, left_s: float) -> Iterator[None]:
        """Accept a job, and count its work until the end of the block.

        Raises:
            TooLargeError: If the job alone would take longer than the time limit.
            BusyError: If the job would take longer than `left_s`, alone or after the accepted jobs.
        """
        work = self.estimate_work(job, megapixels)
        least_s = work * self._best_each_s
        if least_s > self._limit_s:
            raise TooLargeError(
                f"expected a request that takes at most {self._limit_s:.0f} s, found {megapixels:.1f} "
                f"megapixels that take {least_s:.0f} s with these options; send smaller pictures or use "
                "fewer options"
            )
        if least_s > left_s:
            raise BusyError(
                f"expected more than {least_s:.1f} s for this request, found {left_s:.1f} s left; try again, "
                "send smaller pictures or use fewer options"
            )
        late_s = (sum(self._accepted) + work) * median(self._latest_each_s) - left_s
        if self._accepted and late_s > 0:
            raise BusyError(
                f"pending requests would make this request {late_s:.0f} s late; try again later",
                retry_after_s=math.ceil(late_s),
            )
        self._accepted.append(work)
        try:
            yield
        finally:
            self._accepted.remove(work)

    def learn(self, work: float, took_s: float, *, finished: bool = True) -> None:
        """Update the speeds with the duration of work that was finished or stopped."""
        each_s = took_s / work
        if finished:
            self._best_each_s = min(self._best_each_s, each_s)
        else:  # all the work would have taken longer
            each_s = max(each_s, median(self._latest_each_s))
        self._latest_each_s.append(each_s)

    def estimate_work(self, job: ServiceJob, megapixels: float) -> float:
        """Return the amount of work in a job. One unit is a megapixel of small pictures, without options."""
        large = _LARGE if megapixels > _LARGE_FROM_MEGAPIXELS else 1
        refined = _REFINED if job.match_options.refined and not self._refines else 1
        return megapixels * large * refined
