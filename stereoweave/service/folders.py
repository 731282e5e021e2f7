"""Temporary folders of the service's processes, and the removal of those that killed processes left."""

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
    """Make a temporary folder for the block, readable by this user only.

    A lock file beside it marks it as in use. The system releases the lock when the process ends in any way.
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
            # A cleaner of /tmp may have removed it, and Windows keeps it while it is open.
            with suppress(OSError):
                Path(lock.lock_file).unlink()


def _remove_abandoned() -> None:
    for path in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*{_LOCK}"):
        # OSError: it is in use, or belongs to another user.
        with suppress(OSError), FileLock(path, blocking=False):
            shutil.rmtree(path.with_suffix(""), ignore_errors=True)
            path.unlink()
