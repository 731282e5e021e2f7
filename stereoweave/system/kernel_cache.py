"""The folder of compiled kernels, in which each kernel is compiled by one process at a time."""

import functools
import hashlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from importlib.metadata import version
from pathlib import Path

from filelock import FileLock, Timeout

from stereoweave.system.steps import step


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
def compile_once(kernel: str, code: str) -> Iterator[None]:
    """Load or compile a kernel in the block, while no other process or thread compiles it.

    Compiling, and waiting for who compiles, is announced as a step, as it takes seconds.

    Args:
        kernel: Name of the kernel.
        code: Pattern of the name of its compiled code, in the folder of kernels.
    """
    try:
        file = kernels_folder() / f"{kernel}.lock"
        file.parent.mkdir(parents=True, exist_ok=True)
        # Not whether the lock's file exists, because a killed process leaves it behind.
        is_first = not any(file.parent.glob(code))
        lock = FileLock(file, fallback_to_soft=False)
        with suppress(Timeout):
            lock.acquire(blocking=False)
    except (OSError, RuntimeError):
        # There is no writable folder, or one without locks: compile beside the other processes.
        with step(_COMPILING):
            yield
        return
    try:
        with step(_COMPILING) if is_first else nullcontext():
            if not lock.is_locked:
                lock.acquire()
            yield
    finally:
        lock.release()


_COMPILING = "compiling, once on this machine"


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
