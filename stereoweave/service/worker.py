"""Child processes that read and match for the service; replaced when they overrun or crash."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from stereoweave.errors import FormatError
from stereoweave.pictures.prepare import Request
from stereoweave.service.answers import Answer, Answering, ServiceJob, make_measuring
from stereoweave.system.child_process import ChildProcess, ProcessDiedError

# Reading the head of a picture takes milliseconds.
_MEASURED_WITHIN_S = 10
_SAMPLE = Path(__file__).parents[1] / "sample"


@dataclass(frozen=True)
class Task:
    """A job, its megapixels, and its deadline as a value of `time.monotonic`."""

    job: ServiceJob
    megapixels: float
    deadline_s: float

    @property
    def left_s(self) -> float:
        """The seconds until the deadline, at least 0."""
        return max(0.0, self.deadline_s - time.monotonic())


class Worker:
    """Two processes: one measures pictures from their heads, the other decodes and matches them.

    Args:
        make_answering: Makes the second one's function, such as `partial(make_answering, Backend())`.
        folder: For the temporary files of both.
    """

    def __init__(self, make_answering: Callable[[], Answering], folder: Path) -> None:
        self._measuring = ChildProcess(make_measuring, folder / "measuring")
        self._answering = ChildProcess(make_answering, folder / "answering")

    def close(self) -> None:
        """End the processes."""
        self._measuring.close()
        self._answering.close()

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
            (answer,) = self._answering([job], timeout_s=None)
            took_s = time.perf_counter() - start_s
            if isinstance(answer, Exception):
                raise answer
        return took_s / self._measuring(plain, timeout_s=None)

    def measure(self, job: ServiceJob, left_s: float) -> float:
        """The megapixels of a job's pictures, from their heads.

        Raises:
            StereoweaveError: If `check_pixels` raises it, or the process crashed.
            TimeoutError: If it takes longer than `left_s`.
        """
        try:
            return self._measuring(job, min(left_s, _MEASURED_WITHIN_S))
        except TimeoutError as error:
            if left_s < _MEASURED_WITHIN_S:
                raise
            raise FormatError(
                f"expected pictures whose sizes are known within {_MEASURED_WITHIN_S} s, found that it takes "
                "longer; save them again"
            ) from error

    def answer(self, tasks: Sequence[Task]) -> list[Answer | Exception]:
        """The answer to each task, or its error.

        At the first deadline, or if the process crashes, it is replaced, and the other tasks start again, one
        by one.
        """
        try:
            return self._answering([task.job for task in tasks], min(task.left_s for task in tasks))
        except (TimeoutError, ProcessDiedError) as error:
            if len(tasks) == 1:
                return [error]
        return [outcome for task in tasks for outcome in self.answer([task])]
