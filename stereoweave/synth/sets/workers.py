"""Work shared among processes, one core each, that end with the one that started them; or among machines."""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing.sharedctypes import Synchronized
from typing import TypeVar

from rich.console import Console

from stereoweave.errors import StereoweaveError
from stereoweave.system.processes import begin_work
from stereoweave.system.progress import progress
from stereoweave.system.ray_engine import Engine, connect, stream

Task = TypeVar("Task")
Result = TypeVar("Result")

# Of a worker of this machine: how many steps all of them have done.
_done: "Synchronized[int] | None" = None


def run_in_workers(  # noqa: PLR0913 - what, on what, by how many, and how it is told
    work: Callable[[Task], Result],
    tasks: Sequence[Task],
    jobs: int,
    console: Console,
    description: str,
    steps: int,
) -> Iterator[Result]:
    """The results of `work`, as they come, which is in no order.

    Args:
        work: A function of a module, or what else can be pickled; it calls `step_done` for each step.
        tasks: What it is called with.
        jobs: Processes at a time.
        console: Where the progress is shown.
        description: What the bar says.
        steps: How many there are in all.

    Raises:
        StereoweaveError: A worker was killed.
    """
    # Started afresh, because a forked child inherits OpenGL's and OpenCV's threads in an unknown state.
    context = multiprocessing.get_context("spawn")
    done = context.Value("L", 0)
    others = multiprocessing.active_children()
    with ProcessPoolExecutor(max(1, min(jobs, len(tasks))), context, _begin, (done,)) as pool:
        try:
            with progress(console) as bar:
                shown = bar.add_task(description, total=steps, loss="", rate="")
                pending = {pool.submit(work, task) for task in tasks}
                while pending:
                    finished, pending = wait(pending, timeout=0.5, return_when=FIRST_COMPLETED)
                    # Without its lock, which a killed worker may hold for ever.
                    bar.update(shown, completed=done.get_obj().value)
                    yield from (future.result() for future in finished)
        except BaseException as error:
            pool.shutdown(wait=False, cancel_futures=True)
            for child in multiprocessing.active_children():
                if child not in others:
                    child.terminate()
            if isinstance(error, BrokenProcessPool):
                raise StereoweaveError(
                    f"{description}: expected every worker to live, found one killed; is the memory full?"
                ) from error
            raise


def run_in_engine(  # noqa: PLR0913 - as `in_workers`
    make_work: Callable[[], Callable[[Task], int]],
    tasks: Sequence[Task],
    engine: Engine,
    console: Console,
    description: str,
    steps: int,
) -> None:
    """Does what `in_workers` does by an engine's workers, whose tasks are done again where one is killed.

    Args:
        make_work: Makes, once in each worker, what gives the number of steps that a task was.
        tasks: As for `in_workers`, and so are the last three.
        engine: Where.
        console: See there.
        description: See there.
        steps: See there.

    Raises:
        StereoweaveError: As in `engine.stream`.
    """
    with connect(engine), progress(console) as bar:
        shown = bar.add_task(description, total=steps, loss="", rate="")
        for done in stream(partial(_begin_in_engine, make_work), tasks, engine):
            bar.update(shown, advance=done)


def count_step() -> None:
    """Called by `work` after each step, for the bar."""
    if _done is not None:
        with _done.get_lock():
            _done.value += 1


def _begin(done: "Synchronized[int]") -> None:
    global _done  # noqa: PLW0603 - a worker has one counter, and functions that are pickled cannot carry it
    _done = done
    _draw_with_one_thread()
    begin_work(threads=1)


def _begin_in_engine(make_work: Callable[[], Callable[[Task], int]]) -> Callable[[Task], int]:
    _draw_with_one_thread()
    return make_work()


def _draw_with_one_thread() -> None:
    # Mesa reads it when the first context is made; more threads than cores slow all of them down.
    os.environ["LP_NUM_THREADS"] = "1"
