"""Copies of the repository, in which sources are changed and tests are run."""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path


class Tree:
    """A copy of the repository, on disk, because some tests start processes of their own.

    Attributes:
        folder: Where it is; the same from run to run, so that Numba finds what it has compiled for it.
    """

    def __init__(self, root: Path, folder: Path) -> None:
        self.folder = folder
        self._testdata = os.environ.get("STEREOWEAVE_TESTDATA") or str(root.parent / "shared")
        self._running: subprocess.Popen[bytes] | None = None
        shutil.rmtree(folder, ignore_errors=True)
        for name in repository_files(root):
            copy = folder / name
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(root / name, copy)

    def pytest(self, words: Sequence[str], log: Path, limit_s: float, **variables: str) -> int | None:
        """The exit code of pytest on the copy; None if it did not end in time."""
        environment = os.environ | {
            "PYTHONPATH": str(self.folder),
            "STEREOWEAVE_TESTDATA": self._testdata,
            "NUMBA_CACHE_DIR": str(self.folder.with_name("kernels")),
            **variables,
        }
        pytest = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "mutate.limits"]
        # A short name, because the names of sockets have at most 107 bytes.
        with (
            tempfile.TemporaryDirectory(prefix="swm-", ignore_cleanup_errors=True) as temporary,
            log.open("wb") as out,
        ):
            self._running = subprocess.Popen(
                [*pytest, f"--basetemp={temporary}/t", *words],
                cwd=self.folder,
                env=environment,
                stdout=out,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            try:
                return self._running.wait(limit_s)
            except subprocess.TimeoutExpired:
                return None
            finally:
                self.stop()

    def stop(self) -> None:
        """End the tests that run, and what they have started."""
        if self._running:
            with suppress(ProcessLookupError):
                os.killpg(self._running.pid, signal.SIGKILL)
            self._running.wait()

    @contextmanager
    def changed(self, path: str, source: str, turn: int) -> Iterator[None]:
        """Within the block a source is another one, with a time of change of its own.

        Python and Numba take what they compiled before as long as a source has the same size and time, in
        whole seconds.
        """
        file = self.folder / path
        original, status = file.read_bytes(), file.stat()
        seconds = int(status.st_mtime) + 2 * (turn + 1)
        file.write_text(source, encoding="utf-8")
        os.utime(file, (seconds, seconds))
        try:
            yield
        finally:
            file.write_bytes(original)
            os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns))


def repository_files(root: Path) -> list[str]:
    """The files of the repository as they are, committed or not."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True).stdout
    return sorted(name for name in listed.split("\0") if name and (root / name).is_file())
