"""The folder of compiled kernels, and processes that fill it ahead of their use.

Compiling takes seconds, once on each machine, and occupies one core. A command starts other processes that
compile what it needs, while it reads its input. This module imports no Numba, so that they start soon.
"""

import functools
import gc
import hashlib
import multiprocessing
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from importlib.metadata import version
from multiprocessing.context import SpawnProcess
from pathlib import Path

from filelock import FileLock, Timeout

from stereoweave.system.processes import begin_work
from stereoweave.system.steps import step
from stereoweave.system.threads import usable_cores

Rehearsal = Callable[[], None]
"""Function that calls kernels with small arguments, and so compiles them."""


def cache_folder() -> Path:
    """Return the default folder for compiled kernels, in the user's cache folder.

    The environment variable NUMBA_CACHE_DIR overrides this default.
    """
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or "~/AppData/Local"
    elif sys.platform == "darwin":
        base = "~/Library/Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(base).expanduser() / "stereoweave" / "kernels"


def kernels_folder() -> Path:
    """Return the folder of the kernels that are compiled from the present sources.

    Raises:
        RuntimeError: There is no home folder.
    """
    return Path(os.environ.get("NUMBA_CACHE_DIR") or cache_folder()) / _sources_digest()


@contextmanager
def compile_once(kernel: str) -> Iterator[None]:
    """Load or compile a kernel in the block, while no other process compiles it.

    Compiling is announced as a step, as it takes seconds.
    """
    try:
        file = kernels_folder() / f"{kernel}.lock"
        file.parent.mkdir(parents=True, exist_ok=True)
        is_first = not file.exists()
        lock = FileLock(file, fallback_to_soft=False)
        with suppress(Timeout):
            lock.acquire(blocking=False)
    except (OSError, RuntimeError):
        # There is no writable folder, or one without locks: compile beside the other processes.
        with step(_COMPILING):
            yield
        return
    try:
        if is_first or not lock.is_locked:
            with step(_COMPILING):
                lock.acquire()
                yield
        else:
            yield
    finally:
        lock.release()


@contextmanager
def compiling_ahead() -> Iterator[None]:
    """Let `compile_ahead` start processes within the block; those still at work at its end are stopped."""
    started: _Started = {}
    token = _started.set(started)
    try:
        yield
    finally:
        _started.reset(token)
        for process in started.values():
            process.terminate()
            process.join()


def compile_ahead(*rehearsals: Rehearsal) -> None:
    """Start a process for each rehearsal that no process has finished on this machine.

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
                context = multiprocessing.get_context("spawn")
                started[rehearse] = process = context.Process(target=_hold, args=[rehearse], daemon=True)
                process.start()


_COMPILING = "compiling, once on this machine"
_Started = dict[Rehearsal, SpawnProcess]
_started: ContextVar[_Started | None] = ContextVar("processes that compile", default=None)


def _hold(rehearse: Rehearsal) -> None:
    """Hold a rehearsal in a process of its own, and note its end in the cache."""
    begin_work(threads=1)
    gc.disable()  # it would take a tenth of the time
    with suppress(Exception):  # the command itself meets the error, and explains it
        rehearse()
        _finished(rehearse).touch()


def _finished(rehearse: Rehearsal) -> Path:
    """Return the file that notes the end of a rehearsal."""
    return kernels_folder() / f"{rehearse.__module__}.{rehearse.__qualname__}.finished"


@functools.cache
def _sources_digest() -> str:
    """Return the first 12 hexadecimal digits of a hash of all kernel sources.

    Numba checks only a kernel's own file for changes, and would keep stale code for functions in other files.
    """
    digest = hashlib.sha256(f"{sys.version} {version('numba')}".encode())
    for source in (
        Path(__file__).with_name("jit.py"),
        *sorted(Path(__file__).parents[1].rglob("*_kernels.py")),
    ):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:12]
