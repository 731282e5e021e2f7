"""Temporary folders of the service's processes, and removal of folders that killed processes left behind."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

from filelock import FileLock

_PREFIX, _LOCK = "stereoweave-service-", ".lock"


@contextmanager
def make_own_folder() -> Iterator[Path]:
    """Make a temporary folder that only this user can read, and remove it at the end of the block.

    A locked file beside the folder marks the folder as in use. The operating system releases the lock when
    the process exits, even if it is killed.
    """
    _remove_abandoned()
    folder = Path(tempfile.gettempdir(), f"{_PREFIX}{uuid4().hex}")
    lock = FileLock(f"{folder}{_LOCK}")
    with lock:
        folder.mkdir(mode=0o700)
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)
            # A cleaner of /tmp may have removed the lock file. Windows keeps the file while it is open.
            with suppress(OSError):
                Path(lock.lock_file).unlink()


def _remove_abandoned() -> None:
    for path in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*{_LOCK}"):
        # OSError: the folder is in use, or belongs to another user.
        with suppress(OSError), FileLock(path, blocking=False):
            shutil.rmtree(path.with_suffix(""), ignore_errors=True)
            path.unlink()
