"""Lock that lets only one command at a time write to an output.

The operating system releases the lock when the process exits, even if it is killed.
"""

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from stereoweave.errors import OutputInUseError, StereoweaveError
from stereoweave.io.files import make_folder

# Errors of network file systems without locks, which depend on the operating system. On Linux, the last two
# are equal.
_NO_LOCKS = {errno.ENOSYS, errno.ENOLCK, errno.EINVAL, errno.EOPNOTSUPP, errno.ENOTSUP}


@contextmanager
def lock_output(output: Path, before_waiting: Callable[[], None] | None = None) -> Iterator[None]:
    """Lock an output against other processes, even those that reach it by another path.

    The lock file, `.lock` in a folder or `.NAME.lock` beside a file, is removed at the end. A killed process
    leaves the file behind, unlocked; the next process reuses and removes it. There is no protection on a disk
    that does not support locks.

    Args:
        output: An existing folder, or a file. If the file's folder is missing, it is created.
        before_waiting: Function to call before waiting for another process to release the lock; if it is
            None, a locked output is an error.

    Raises:
        OutputInUseError: Another process has the lock, and `before_waiting` is None.
        StereoweaveError: The lock file cannot be written.
    """
    file = _lock_file(Path(os.path.realpath(output)))
    # No soft lock: its file would stay locked after a kill.
    lock = FileLock(file, blocking=False, fallback_to_soft=False)
    try:
        _acquire(lock, before_waiting)
    except Timeout as error:
        raise OutputInUseError(
            f"{output}: expected an output to which no other command is writing, found one that is in use; "
            "wait for the other command to finish, or choose another output"
        ) from error
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            remedy = "; remove it" if isinstance(error, IsADirectoryError | PermissionError) else ""
            raise StereoweaveError(
                f"{file}: expected a writable file, found {str(error.strerror).lower()}{remedy}"
            ) from error
    try:
        yield
    finally:
        # Remove before the release, so that no other process's lock file is removed: filelock does not lock a
        # removed file. Windows cannot remove an open file; on Windows, filelock removes it.
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
