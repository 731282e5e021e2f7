"""One writer at a time: a command that fills a folder or a file for long keeps others out until it ends.

The operating system holds the lock, so that it ends with the process, in whatever way that ends.
"""

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from stereoweave.errors import OutputInUseError, StereoweaveError
from stereoweave.io.files import make_folder

# Some network file systems have no locks. Systems differ in how they say so; the last two are one on Linux.
_NO_LOCKS = {errno.ENOSYS, errno.ENOLCK, errno.EINVAL, errno.EOPNOTSUPP, errno.ENOTSUP}


@contextmanager
def lock_output(output: Path, before_waiting: Callable[[], None] | None = None) -> Iterator[None]:
    """Keep other processes from writing to an output, under whatever name they know it.

    The lock file is `.lock` in a folder, `.NAME.lock` beside a file, and is removed at the end. A killed
    process leaves the file, which the next one uses and removes. On a disk without locks nobody is kept out.

    Args:
        output: A folder that exists, or a file, whose folder is made where it is missing.
        before_waiting: Called if somebody else has the lock, which is then waited for.

    Raises:
        OutputInUseError: Somebody else has the lock, and it is not to be waited for.
        StereoweaveError: The lock file cannot be written.
    """
    file = _lock_file(Path(os.path.realpath(output)))
    # Without `fallback_to_soft`, which would be a file that a killed process leaves locked.
    lock = FileLock(file, blocking=False, fallback_to_soft=False)
    try:
        _acquire(lock, before_waiting)
    except Timeout as error:
        raise OutputInUseError(
            f"{output}: expected an output that nobody writes to, found one that is in use; "
            "wait for the other command to end, or choose another output"
        ) from error
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            remedy = "; remove it" if isinstance(error, IsADirectoryError | PermissionError) else ""
            raise StereoweaveError(
                f"{file}: expected a file that can be written, found {str(error.strerror).lower()}{remedy}"
            ) from error
    try:
        yield
    finally:
        # Still locked, so that nobody else's is removed: filelock takes no lock on a removed file. Windows
        # removes no open file; there filelock does it.
        with suppress(OSError):
            file.unlink()
        lock.release()


def _acquire(lock: FileLock, before_waiting: Callable[[], None] | None) -> None:
    try:
        lock.acquire()
    except Timeout:
        if before_waiting is None:
            raise
        before_waiting()
        lock.acquire(blocking=True)


def _lock_file(output: Path) -> Path:
    return output / ".lock" if output.is_dir() else make_folder(output.parent) / f".{output.name}.lock"
