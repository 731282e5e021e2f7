"""Child processes in which a replica matches pictures; they are replaced after a timeout or a crash."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from stereoweave.errors import FormatError
from stereoweave.matching.options import MatchOptions
from stereoweave.pictures.prepare import Request
from stereoweave.service.answers import BatchAnswerer, ServiceAnswer, ServiceJob, load_measurer
from stereoweave.system.child_process import ChildProcess, NotStartedError, ProcessDiedError

# Reading a picture's header takes milliseconds.
_MEASURING_LIMIT_S = 10
_SAMPLE = Path(__file__).parents[1] / "sample"


@dataclass(frozen=True)
class TimedJob:
    """A job, its size in megapixels, and its deadline on the clock of `time.monotonic`."""

    job: ServiceJob
    megapixels: float
    deadline_s: float

    @property
    def left_s(self) -> float:
        """Seconds until the deadline, at least 0."""
        return max(0.0, self.deadline_s - time.monotonic())


class ReplicaProcesses:
    """A child process that reads the sizes of pictures from their headers, and one that matches pictures.

    Args:
        load_answerer: Function that is called in the second process, and returns the function that answers
            jobs. An example is `partial(load_answerer, Backend())`.
        folder: Folder for the temporary files of both processes.
    """

    def __init__(self, load_answerer: Callable[[], BatchAnswerer], folder: Path) -> None:
        self._measurer = ChildProcess(load_measurer, folder / "measuring")
        self._answerer = ChildProcess(load_answerer, folder / "answering")

    def close(self) -> None:
        """Stop both processes."""
        self._measurer.close()
        self._answerer.close()

    def warm_up(self) -> float:
        """Compile all kernels, and return the time in seconds per megapixel for a disparity map.

        Raises:
            MatcherError: If the network cannot be loaded.
        """
        pictures = (_SAMPLE / "left.jpg", _SAMPLE / "right.jpg")
        plain = ServiceJob(folder=_SAMPLE, pictures=pictures, file="disparity.png")
        every_option = replace(
            plain,
            file="view.png",
            request=Request(rectify=True),
            options=MatchOptions(refined=True),
            checked=True,
        )
        for job in (every_option, plain):
            start_s = time.perf_counter()
            (answer,) = self._answerer([job], timeout_s=None)
            took_s = time.perf_counter() - start_s
            if isinstance(answer, Exception):
                raise answer
        return took_s / self._measurer(plain, timeout_s=None)

    @property
    def starting(self) -> bool:
        """Whether the process that matches pictures is still starting, or has ended and must be started."""
        return self._answerer.starting or self._answerer.has_ended

    def measure(self, job: ServiceJob, left_s: float) -> float:
        """Return the size of a job's pictures in megapixels, read from their headers.

        Raises:
            StereoweaveError: If `check_pixels` raises an error, or the process crashes.
            NotStartedError: If the process is still starting after half of `left_s`.
            TimeoutError: If this takes longer than `left_s`.
        """
        deadline_s = time.monotonic() + left_s
        self._measurer.renew()
        self._measurer.wait_for_start(left_s)
        left_s = deadline_s - time.monotonic()
        try:
            return self._measurer(job, min(left_s, _MEASURING_LIMIT_S))
        except TimeoutError as error:
            if left_s < _MEASURING_LIMIT_S:
                raise
            raise FormatError(
                f"the sizes of the pictures could not be read within {_MEASURING_LIMIT_S} s; "
                "save the pictures again"
            ) from error

    def answer(self, timed_jobs: Sequence[TimedJob]) -> list[ServiceAnswer | Exception]:
        """Return each job's answer or error.

        If the jobs miss the earliest of their deadlines, or the process crashes, the process is replaced and
        the jobs are retried one by one. If it is still starting, they are not retried.
        """
        self._answerer.renew()
        try:
            jobs = [timed.job for timed in timed_jobs]
            return self._answerer(jobs, min(timed.left_s for timed in timed_jobs))
        except NotStartedError as error:
            return [error] * len(timed_jobs)
        except (TimeoutError, ProcessDiedError) as error:
            if len(timed_jobs) == 1:
                return [error]
        return [outcome for timed in timed_jobs for outcome in self.answer([timed])]
