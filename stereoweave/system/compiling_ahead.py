"""Compilation of kernels ahead of their use, beside other work of a command.

Kernels that ship (`shipped_kernels`) are compiled by a thread, because LLVM needs Python's global lock for
moments only. Numba needs it all the time, and seconds for a kernel, so it runs in other processes.
"""

import gc
import multiprocessing
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from multiprocessing.context import SpawnProcess
from pathlib import Path

from stereoweave.system.kernel_cache import kernels_folder
from stereoweave.system.processes import begin_work
from stereoweave.system.shipped_kernels import kernels_ship
from stereoweave.system.threads import usable_cores

Rehearsal = Callable[[], None]
"""Function that calls kernels with small arguments, and so compiles them."""


@contextmanager
def compiling_ahead() -> Iterator[None]:
    """Let `compile_ahead` start threads and processes within the block.

    At its end, it stops the processes, and waits for a thread that is at work.
    """
    started: _Started = {}
    token = _started.set(started)
    try:
        yield
    finally:
        _started.reset(token)
        for work in started.values():
            if isinstance(work, SpawnProcess):
                work.terminate()
            work.join()


def compile_ahead(*rehearsals: Rehearsal) -> None:
    """Hold each rehearsal that has not been finished on this machine, in a thread or process of its own.

    Nothing happens outside `compiling_ahead`, because a library must not start processes unasked, and nothing
    on a single core, which is faster without.
    """
    started = _started.get()
    if started is None or usable_cores() == 1:
        return
    for rehearse in rehearsals:
        with suppress(OSError, RuntimeError):  # without a folder, the kernels cannot be handed over
            kernels_folder().mkdir(parents=True, exist_ok=True)
            if rehearse not in started and not _finished(rehearse).exists():
                started[rehearse] = _start(rehearse)


_Started = dict[Rehearsal, SpawnProcess | threading.Thread]
_started: ContextVar[_Started | None] = ContextVar("threads and processes that compile", default=None)


def _start(rehearse: Rehearsal) -> SpawnProcess | threading.Thread:
    work: SpawnProcess | threading.Thread
    if kernels_ship():
        work = threading.Thread(target=_hold, args=[rehearse])
    else:
        work = multiprocessing.get_context("spawn").Process(target=_hold_alone, args=[rehearse], daemon=True)
    work.start()
    return work


def _hold_alone(rehearse: Rehearsal) -> None:
    """Hold a rehearsal in a process of its own."""
    begin_work(threads=1)
    gc.disable()  # it would take a tenth of the time
    _hold(rehearse)


def _hold(rehearse: Rehearsal) -> None:
    """Hold a rehearsal, and note its end in the cache."""
    with suppress(Exception):  # the command itself meets the error, and explains it
        rehearse()
        _finished(rehearse).touch()


def _finished(rehearse: Rehearsal) -> Path:
    """Return the file that notes the end of a rehearsal."""
    return kernels_folder() / f"{rehearse.__module__}.{rehearse.__qualname__}.finished"
