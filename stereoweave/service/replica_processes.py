"""A replica's child processes, which read and match; replaced when they overrun or crash."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from stereoweave.errors import FormatError
from stereoweave.pictures.prepare import Request
from stereoweave.service.answers import BatchAnswerer, ServiceAnswer, ServiceJob, load_measurer
from stereoweave.system.child_process import ChildProcess, ProcessDiedError

# Reading the head of a picture takes milliseconds.
_MEASURING_LIMIT_S = 10
_SAMPLE = Path(__file__).parents[1] / "sample"


@dataclass(frozen=True)
class TimedJob:
    """A job, its megapixels, and its deadline as a value of `time.monotonic`."""

    job: ServiceJob
    megapixels: float
    deadline_s: float

    @property
    def left_s(self) -> float:
        """The seconds until the deadline, at least 0."""
        return max(0.0, self.deadline_s - time.monotonic())


class ReplicaProcesses:
    """Two processes: one measures pictures from their heads, the other decodes and matches them.

    Args:
        load_answerer: Makes the second one's function, such as `partial(load_answerer, Backend())`.
        folder: For the temporary files of both.
    """

    def __init__(self, load_answerer: Callable[[], BatchAnswerer], folder: Path) -> None:
        self._measurer = ChildProcess(load_measurer, folder / "measuring")
        self._answerer = ChildProcess(load_answerer, folder / "answering")

    def close(self) -> None:
        """End the processes."""
        self._measurer.close()
        self._answerer.close()

    def warm_up(self) -> float:
        """Compile all kernels, then measure the seconds per megapixel of an unrefined disparity.

        Raises:
            MatcherError: If the network cannot be loaded.
        """
        pictures = (_SAMPLE / "left.jpg", _SAMPLE / "right.jpg")
        plain = ServiceJob(folder=_SAMPLE, pictures=pictures, file="disparity.png")
        every_option = replace(plain, file="view.png", request=Request(rectify=True), checked=True)
        for job in (every_option, plain):
            start_s = time.perf_counter()
            (answer,) = self._answerer([job], timeout_s=None)
            took_s = time.perf_counter() - start_s
            if isinstance(answer, Exception):
                raise answer
        return took_s / self._measurer(plain, timeout_s=None)

    def measure(self, job: ServiceJob, left_s: float) -> float:
        """The megapixels of a job's pictures, from their heads.

        Raises:
            StereoweaveError: If `check_pixels` raises it, or the process crashed.
            TimeoutError: If it takes longer than `left_s`.
        """
        try:
            return self._measurer(job, min(left_s, _MEASURING_LIMIT_S))
        except TimeoutError as error:
            if left_s < _MEASURING_LIMIT_S:
                raise
            raise FormatError(
                f"expected pictures whose sizes are known within {_MEASURING_LIMIT_S} s, found that it takes "
                "longer; save them again"
            ) from error

    def answer(self, timed_jobs: Sequence[TimedJob]) -> list[ServiceAnswer | Exception]:
        """The answer to each job, or its error.

        At the first deadline, or if the process crashes, it is replaced, and the other jobs start again, one
        by one.
        """
        try:
            jobs = [timed.job for timed in timed_jobs]
            return self._answerer(jobs, min(timed.left_s for timed in timed_jobs))
        except (TimeoutError, ProcessDiedError) as error:
            if len(timed_jobs) == 1:
                return [error]
        return [outcome for timed in timed_jobs for outcome in self.answer([timed])]
