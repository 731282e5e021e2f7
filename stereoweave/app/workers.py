"""Child processes that do the visitors' long work; a visitor's work ends at once on request."""

import asyncio
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from stereoweave.system.child_process import ChildProcess

Done = TypeVar("Done")
# Called with the finished share, from 0 to 1, and the name of the next step.
Report = Callable[[float, str], None]
# Work is pickled, so it is a module's function or a `functools.partial` of one.
Work = Callable[[Report], Done]

# With the visitors' limits of the page, at most this many processes work at once.
MOST_WORKERS = 4
_POLL_S = 0.2


class Workers:
    """Processes for long work, one job at a time each, which can be stopped in mid-job.

    A thread cannot be stopped, so in the page's own process a cancelled job would keep the cores busy until
    its end. A process stays for later jobs.

    Args:
        folder: Folder for the processes' temporary files.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._started = folder, 0
        self._threads = ThreadPoolExecutor(MOST_WORKERS)
        self._idle: list[ChildProcess] = []
        self._busy: dict[ChildProcess, str] = {}

    def __enter__(self) -> "Workers":
        """Start the first process, so that the first visitor does not wait for it."""
        self._idle.append(self._start())
        return self

    def __exit__(self, *error: object) -> None:
        """Stop all processes."""
        for process in (*self._busy, *self._idle):
            process.kill()
        self._threads.shutdown()
        for process in (*self._busy, *self._idle):
            process.close()

    async def run(self, visitor: str, work: Work[Done], report: Report) -> Done:
        """Do a visitor's work in a process, and return its result.

        If the awaiting task is cancelled, the process is killed.

        Raises:
            ProcessDiedError: If `stop` stopped the work, or the process crashed.
            Exception: Any error of the work.
        """
        with self._taking(visitor) as process:
            shown = self._folder / f"progress-{process.pid}"
            loop = asyncio.get_running_loop()
            call = loop.run_in_executor(self._threads, process, (work, shown), None)
            try:
                while not call.done():
                    await asyncio.wait([call], timeout=_POLL_S)
                    _pass_on(shown, report)
            except asyncio.CancelledError:
                process.kill()
                await asyncio.gather(call, return_exceptions=True)  # it replaces the process
                raise
            finally:
                shown.unlink(missing_ok=True)
            return call.result()

    def stop(self, visitor: str) -> None:
        """Stop all work of a visitor."""
        for process, owner in list(self._busy.items()):  # another thread may change it
            if owner == visitor:
                process.kill()

    @contextmanager
    def _taking(self, visitor: str) -> Iterator[ChildProcess]:
        process = self._idle.pop() if self._idle else self._start()
        self._busy[process] = visitor
        try:
            process.renew()
            yield process
        finally:
            del self._busy[process]
            self._idle.append(process)

    def _start(self) -> ChildProcess:
        self._started += 1
        return ChildProcess(_make_worker, self._folder / f"worker-{self._started}")


def _pass_on(shown: Path, report: Report) -> None:
    """Report the last progress that the process has written, if any."""
    try:
        share, _, what = shown.read_text(encoding="utf-8").partition(" ")
        report(float(share), what)
    except (OSError, ValueError):  # nothing is written yet, or not all of it
        return


def _make_worker() -> Callable[[Any], Any]:
    import stereoweave.app.session  # noqa: F401 - loads the libraries before the first job comes

    return _work


def _work(task: tuple[Work[Any], Path]) -> Any:
    work, shown = task
    return work(partial(_write_progress, shown))


def _write_progress(shown: Path, share: float, what: str) -> None:
    shown.write_text(f"{share} {what}", encoding="utf-8")
