"""Only one process at a time writes to an output: a second one is refused, and a killed one holds no lock."""

import errno
import fcntl
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from stereoweave.errors import OutputInUseError, StereoweaveError
from stereoweave.io.output_lock import lock_output

PROGRAM = """
import sys
from pathlib import Path
from stereoweave.io.output_lock import lock_output
with lock_output(Path(sys.argv[1])):
    print("locked", flush=True)
    sys.stdin.read()
"""


@contextmanager
def held(output: Path) -> Iterator["subprocess.Popen[str]"]:
    """Run another process that holds the lock of an output until the end of the block."""
    command = [sys.executable, "-c", PROGRAM, output]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "locked\n"
        yield process
        process.stdin.close()


def assert_in_use(output: Path) -> None:
    with pytest.raises(OutputInUseError) as caught, lock_output(output):
        pass
    assert str(caught.value) == (
        f"{output}: expected an output to which no other command is writing, found one that is in use; "
        "wait for the other command to finish, or choose another output"
    )


@pytest.fixture
def folder(tmp_path):
    """Return a folder and a link to it."""
    (tmp_path / "sets").mkdir()
    (tmp_path / "link").symlink_to("sets")
    return tmp_path / "sets"


def test_a_second_writer_is_refused_for_every_path_of_the_folder(folder, monkeypatch):
    with held(folder):
        monkeypatch.chdir(folder)
        for spelling in (folder, folder.parent / "link", folder / "no" / "..", Path(), Path("../sets/.")):
            assert_in_use(spelling)
        with lock_output(folder.parent):
            pass
    with lock_output(folder):
        pass
    assert not list(folder.iterdir())


def test_a_second_writer_is_refused_for_every_path_of_the_file(folder, monkeypatch):
    film = folder / "film.mp4"
    with held(film):
        monkeypatch.chdir(folder)
        (folder / "other.mp4").symlink_to("film.mp4")
        for spelling in (film, folder.parent / "link" / "film.mp4", Path("film.mp4"), Path("other.mp4")):
            assert_in_use(spelling)
        for other in (folder / "film.mkv", folder, folder / "film"):
            with lock_output(other):
                pass
    with lock_output(film):
        pass
    assert [path.name for path in folder.iterdir()] == ["other.mp4"]


def test_a_killed_writer_leaves_no_lock_and_the_next_writer_no_lock_file(folder):
    with held(folder) as process:
        process.kill()
        process.wait()
    with lock_output(folder):
        assert_in_use(folder)
    assert not list(folder.iterdir())


def test_a_lock_ends_with_an_error_and_the_folder_of_a_new_file_is_made(tmp_path):
    film = tmp_path / "new" / "film.mp4"
    with pytest.raises(ZeroDivisionError), lock_output(film):
        raise ZeroDivisionError
    assert not list(film.parent.iterdir())


def test_a_lock_that_cannot_be_written_is_a_one_line_error(tmp_path):
    (tmp_path / ".lock").mkdir()
    expected = r"\.lock: expected a writable file, found .*; remove it$"
    with pytest.raises(StereoweaveError, match=expected), lock_output(tmp_path):
        pass
    (tmp_path / "file").touch()
    with (
        pytest.raises(StereoweaveError, match=r"file: expected a writable folder, found a file"),
        lock_output(tmp_path / "file" / "film.mp4"),
    ):
        pass


def refuse_locks(monkeypatch: pytest.MonkeyPatch, reason: int) -> None:
    """Make the operating system refuse every lock."""

    def refuse(*_: object) -> None:
        raise OSError(reason, os.strerror(reason))

    monkeypatch.setattr(fcntl, "flock", refuse)


def test_removing_a_lock_is_advised_only_where_it_helps(tmp_path, monkeypatch):
    refuse_locks(monkeypatch, errno.EIO)
    with pytest.raises(StereoweaveError, match="found input/output error$"), lock_output(tmp_path):
        pass


@pytest.mark.parametrize(
    "reason", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EINVAL]
)
def test_a_disk_without_locks_is_written_to_without_a_lock(tmp_path, monkeypatch, reason):
    refuse_locks(monkeypatch, reason)
    with lock_output(tmp_path):
        (tmp_path / "result").touch()
    assert [path.name for path in tmp_path.iterdir()] == ["result"]
