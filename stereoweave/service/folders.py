"""The temporary folder of a process of the service; what a killed process left behind is removed."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

from filelock import FileLock

_PREFIX, _LOCK = "stereoweave-service-", ".lock"


@contextmanager
def own_folder() -> Iterator[Path]:
    """A temporary folder for as long as the block lasts, and of this user alone.

    A lock beside it, which the system releases when its process ends in whatever way, says that it is in use.
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
            # What cleans /tmp may have removed it, and Windows keeps it while it is open.
            with suppress(OSError):
                Path(lock.lock_file).unlink()


def _remove_abandoned() -> None:
    for path in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*{_LOCK}"):
        # In use, or another user's.
        with suppress(OSError), FileLock(path, blocking=False):
            shutil.rmtree(path.with_suffix(""), ignore_errors=True)
            path.unlink()
