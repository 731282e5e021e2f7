"""Parallel work in local processes, one core each, or on a cluster."""

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

# In a local worker: the number of steps that all workers together have done.
_done: "Synchronized[int] | None" = None


def run_in_workers(  # noqa: PLR0913 - work, workers, and progress
    work: Callable[[Task], Result],
    tasks: Sequence[Task],
    jobs: int,
    console: Console,
    description: str,
    steps: int,
) -> Iterator[Result]:
    """Yield the results of `work` in order of completion.

    Args:
        work: Picklable function that does a task and calls `count_step` after each step.
        tasks: Arguments of `work`, one for each call.
        jobs: Number of processes.
        console: Console that shows the progress.
        description: Label of the progress bar.
        steps: Total number of steps.

    Raises:
        StereoweaveError: A worker was killed.
    """
    # Spawned, because a forked child would inherit OpenGL's and OpenCV's locks without the threads that hold
    # them.
    context = multiprocessing.get_context("spawn")
    done = context.Value("L", 0)
    others = multiprocessing.active_children()
    with ProcessPoolExecutor(max(1, min(jobs, len(tasks))), context, _begin, (done,)) as pool:
        try:
            with progress(console) as bar:
                shown = bar.add_task(description, total=steps, loss="", rate="")
                futures = [pool.submit(work, task) for task in tasks]
                while futures:
                    wait(futures, timeout=0.5, return_when=FIRST_COMPLETED)
                    # Read without the lock, because a killed worker may hold it forever.
                    bar.update(shown, completed=done.get_obj().value)
                    # In the order of the tasks, so that a worker's first error is the one raised.
                    finished = [future for future in futures if future.done()]
                    futures = [future for future in futures if future not in finished]
                    yield from (future.result() for future in finished)
        except BaseException as error:
            pool.shutdown(wait=False, cancel_futures=True)
            for child in multiprocessing.active_children():
                if child not in others:
                    child.terminate()
            if isinstance(error, BrokenProcessPool):
                raise StereoweaveError(
                    f"{description}: expected all workers to finish, found one killed; memory may be full"
                ) from error
            raise


def run_in_engine(  # noqa: PLR0913 - see `run_in_workers`
    make_work: Callable[[], Callable[[Task], int]],
    tasks: Sequence[Task],
    engine: Engine,
    console: Console,
    description: str,
    steps: int,
) -> None:
    """Do all tasks on a cluster and repeat the tasks of killed workers.

    Args:
        make_work: Function called once in each worker; the function that it returns does a task and returns
            the task's number of steps.
        tasks: Arguments of the returned function, one for each call.
        engine: Cluster that runs the workers.
        console: Console that shows the progress.
        description: Label of the progress bar.
        steps: Total number of steps.

    Raises:
        StereoweaveError: See `ray_engine.stream`.
    """
    with connect(engine), progress(console) as bar:
        shown = bar.add_task(description, total=steps, loss="", rate="")
        for done in stream(partial(_begin_in_engine, make_work), tasks, engine):
            bar.update(shown, advance=done)


def count_step() -> None:
    """Advance the progress bar; called by `work` after each step."""
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
    # Mesa reads this variable when it creates its first context. More threads than cores would slow down
    # all of them.
    os.environ["LP_NUM_THREADS"] = "1"
