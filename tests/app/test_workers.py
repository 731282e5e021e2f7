"""The page's long work is done in processes of its own, which a cancelled or stopped job does not keep."""

import asyncio
import os
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest
from page_jobs import fail, name_process, wait_forever

from stereoweave.app.workers import Workers
from stereoweave.system.child_process import ProcessDiedError

pytestmark = pytest.mark.system


@pytest.fixture
def workers(tmp_path) -> Iterator[Workers]:
    with Workers(tmp_path) as workers:
        yield workers


def unheard(share: float, what: str) -> None:
    pass


def is_alive(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()


class Waiting:
    """A visitor's work without end; `pid` is the process that does it."""

    def __init__(self, workers: Workers, visitor: str) -> None:
        self.pid, self._begun = 0, asyncio.Event()
        self.task = asyncio.create_task(workers.run(visitor, wait_forever, self._hear))

    def _hear(self, share: float, what: str) -> None:
        assert share == 0.5
        self.pid = int(what)
        self._begun.set()

    async def begin(self) -> "Waiting":
        await asyncio.wait_for(self._begun.wait(), 60)
        return self


def test_jobs_one_after_the_other_share_a_process(workers):
    first, second = (asyncio.run(workers.run("ann", name_process, unheard)) for _ in range(2))
    assert first == second != os.getpid()


def test_an_error_of_the_work_is_raised(workers):
    with pytest.raises(ValueError, match="no picture"):
        asyncio.run(workers.run("ann", partial(fail, "no picture"), unheard))
    assert asyncio.run(workers.run("ann", name_process, unheard)) > 0


def test_jobs_at_the_same_time_have_a_process_each(workers):
    async def work() -> None:
        ann, bob = [await Waiting(workers, visitor).begin() for visitor in ("ann", "bob")]
        assert ann.pid != bob.pid
        for waiting in (ann, bob):
            waiting.task.cancel()
        await asyncio.gather(ann.task, bob.task, return_exceptions=True)

    asyncio.run(work())


def test_a_cancelled_job_ends_its_process(workers):
    async def work() -> None:
        waiting = await Waiting(workers, "ann").begin()
        waiting.task.cancel()
        with suppress(asyncio.CancelledError):
            await waiting.task
        assert not is_alive(waiting.pid)
        assert await workers.run("ann", name_process, unheard) != waiting.pid

    asyncio.run(work())


def test_stopping_a_visitor_ends_their_work_alone(workers):
    async def work() -> None:
        ann, bob = [await Waiting(workers, visitor).begin() for visitor in ("ann", "bob")]
        workers.stop("ann")
        with pytest.raises(ProcessDiedError):
            await ann.task
        assert (is_alive(ann.pid), is_alive(bob.pid), bob.task.done()) == (False, True, False)
        bob.task.cancel()
        await asyncio.gather(bob.task, return_exceptions=True)

    asyncio.run(work())


def test_no_process_and_no_file_is_left_at_the_end(tmp_path):
    with Workers(tmp_path) as workers:
        pid = asyncio.run(workers.run("ann", name_process, unheard))
        assert is_alive(pid)
    assert not is_alive(pid)
    assert list(tmp_path.iterdir()) == []
