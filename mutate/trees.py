"""Copies of the repository in which mutants are tested."""

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
    """Copy of the repository on disk, which is needed because some tests start processes.

    Attributes:
        folder: Folder of the copy, the same in each run, so that Numba finds its compiled kernels.
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
        """Run pytest on the copy. Return its exit code, or None if it did not finish in time."""
        environment = os.environ | {
            "PYTHONPATH": str(self.folder),
            "STEREOWEAVE_TESTDATA": self._testdata,
            "NUMBA_CACHE_DIR": str(self.folder.with_name("kernels")),
            **variables,
        }
        pytest = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "mutate.limits"]
        # The prefix is short, because socket names have at most 107 bytes.
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
        """Kill the running tests and their processes."""
        if self._running:
            with suppress(ProcessLookupError):
                os.killpg(self._running.pid, signal.SIGKILL)
            self._running.wait()

    @contextmanager
    def replace_source(self, path: str, source: str, turn: int) -> Iterator[None]:
        """Replace a source file within the block, with a unique modification time.

        Python and Numba reuse compiled code as long as the size of a source file and its modification time in
        whole seconds stay the same.
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
    """Return the files of the repository, committed or not, except ignored ones."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True).stdout
    return sorted(name for name in listed.split("\0") if name and (root / name).is_file())
