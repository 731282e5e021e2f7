import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path

import psutil
import pytest

from stereoweave.system.child_process import ChildProcess, NotStartedError, ProcessDiedError

pytestmark = pytest.mark.system


def child_of(function, folder: Path) -> ChildProcess:
    return ChildProcess(partial(partial, function), folder)


def _sleep_then_make(seconds: float):
    time.sleep(seconds)
    return abs


def wait_for_end(pid: int) -> None:
    deadline_s = time.monotonic() + 10
    with suppress(psutil.NoSuchProcess):
        while psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
            assert time.monotonic() < deadline_s
            time.sleep(0.01)


@pytest.fixture
def waiting(tmp_path):
    child = child_of(time.sleep, tmp_path / "files")
    yield child
    child.close()


def test_a_function_in_another_process_returns_its_result_or_raises_its_error(tmp_path):
    child = child_of(os.path.getsize, tmp_path / "files")
    (tmp_path / "seven").write_bytes(bytes(7))
    assert child(tmp_path / "seven", timeout_s=10) == 7
    with pytest.raises(FileNotFoundError):
        child(tmp_path / "none", timeout_s=10)
    assert child.pid != os.getpid()
    child.close()


def test_a_call_that_takes_too_long_ends_its_process_and_the_next_call_succeeds(waiting):
    assert waiting(0, timeout_s=10) is None
    first, start_s = waiting.pid, time.monotonic()
    with pytest.raises(TimeoutError):
        waiting(60, timeout_s=0.2)
    assert time.monotonic() - start_s < 5
    assert not Path(f"/proc/{first}").exists()
    assert waiting(0, timeout_s=10) is None


def test_a_crash_is_reported_in_one_line_and_the_next_call_succeeds(tmp_path):
    child = child_of(signal.raise_signal, tmp_path / "files")
    with pytest.raises(ProcessDiedError, match=r"exited early \(SIGSEGV\); ") as crash:
        child(signal.SIGSEGV, timeout_s=10)
    assert "\n" not in str(crash.value)
    assert child(0, timeout_s=10) is None  # signal 0 has no effect
    child.close()


def test_a_process_that_is_still_starting_is_not_replaced(tmp_path):
    child = ChildProcess(partial(_sleep_then_make, 0.5), tmp_path / "files")
    pid = child.pid
    for _ in range(2):
        with pytest.raises(NotStartedError):
            child(0, timeout_s=0.01)
    assert child(7, timeout_s=10) == 7
    assert child.pid == pid
    child.close()


def test_a_call_is_begun_only_if_half_of_its_time_is_left(tmp_path):
    child = ChildProcess(partial(_sleep_then_make, 60), tmp_path / "files")
    start_s = time.monotonic()
    with pytest.raises(NotStartedError, match="is still starting; try again later"):
        child(0, timeout_s=10)
    assert 5 <= time.monotonic() - start_s < 10
    child.close()


def test_a_call_with_no_time_left_is_not_started(waiting):
    assert waiting(0, timeout_s=10) is None
    pid = waiting.pid
    with pytest.raises(TimeoutError, match="expected a result within 0 s"):
        waiting(60, timeout_s=0)
    assert waiting.pid == pid


def test_temporary_files_of_a_killed_process_are_removed(tmp_path):
    child = child_of(partial(subprocess.run, shell=True), tmp_path / "files")
    child("true", timeout_s=10)
    with pytest.raises(TimeoutError, match="expected a result within"):
        child("touch $TMPDIR/left; sleep 60", timeout_s=0.7)
    assert not list((tmp_path / "files").iterdir())
    child.close()
    assert not (tmp_path / "files").exists()


def test_an_error_in_making_the_function_is_raised_at_each_call(tmp_path):
    child = ChildProcess(partial(open, tmp_path / "none"), tmp_path / "files")
    for _ in range(2):
        with pytest.raises(FileNotFoundError):
            child(0, timeout_s=10)
    child.close()


def _look_then_make(file: Path):
    file.stat()
    return abs


def test_a_function_that_could_not_be_made_is_made_in_a_renewed_process(tmp_path):
    child = ChildProcess(partial(_look_then_make, tmp_path / "late"), tmp_path / "files")
    with pytest.raises(FileNotFoundError):
        child(-7, timeout_s=10)
    assert child.has_ended
    (tmp_path / "late").touch()
    child.renew()
    assert child(-7, timeout_s=10) == 7
    child.close()


def test_the_output_of_a_function_is_not_part_of_its_result(tmp_path):
    child = child_of(partial(os.write, 1), tmp_path / "files")
    assert child(b"printed\n", timeout_s=10) == 8
    child.close()


def test_a_busy_process_ends_with_its_parent(tmp_path):
    program = (
        "import sys, time, threading; from functools import partial; from pathlib import Path; "
        "from stereoweave.system.child_process import ChildProcess; "
        "child = ChildProcess(partial(partial, time.sleep), Path(sys.argv[1])); child(0, 10); "
        "print(child.pid, flush=True); child(60, 60)"
    )
    command = [sys.executable, "-c", program, str(tmp_path / "files")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        pid = int(parent.stdout.readline())
        parent.kill()
    wait_for_end(pid)


def test_a_file_in_the_current_folder_does_not_shadow_a_module(tmp_path, monkeypatch):
    (tmp_path / "textwrap.py").write_text(
        f"from pathlib import Path\nPath({str(tmp_path)!r}, 'run').touch()\n"
    )
    monkeypatch.chdir(tmp_path)
    child = child_of(abs, tmp_path / "files")
    with suppress(ProcessDiedError):  # if that file is imported, it lacks the names of the real module
        child(-7, timeout_s=10)
    child.close()
    assert not (tmp_path / "run").exists()


def test_a_removed_temporary_folder_is_made_again(tmp_path):
    child = child_of(partial(subprocess.run, shell=True, check=True), tmp_path / "own" / "files")
    child("touch $TMPDIR/first", timeout_s=10)
    shutil.rmtree(tmp_path / "own")
    child("touch $TMPDIR/second", timeout_s=10)
    folder = tmp_path / "own" / "files"
    assert [file.name for file in folder.iterdir()] == ["second"]
    assert folder.stat().st_mode & 0o777 == 0o700
    child.close()


def test_a_process_that_could_not_be_restarted_is_started_by_a_later_call(tmp_path):
    child, folder = (
        child_of(partial(subprocess.run, shell=True, check=True), tmp_path / "files"),
        tmp_path / "files",
    )
    with pytest.raises(FileExistsError):
        child("rmdir $TMPDIR; touch $TMPDIR; kill -9 $PPID", timeout_s=10)
    folder.unlink()
    with pytest.raises(ProcessDiedError):
        child("true", timeout_s=10)
    assert child("true", timeout_s=10).returncode == 0
    child.close()


def test_a_killed_process_ends_its_call_at_once_and_is_replaced(waiting):
    assert waiting(0, timeout_s=10) is None
    first = waiting.pid
    with ThreadPoolExecutor(1) as pool:
        call = pool.submit(waiting, 60, timeout_s=None)
        while not call.running():
            time.sleep(0.01)
        waiting.kill()
        with pytest.raises(ProcessDiedError, match="SIGKILL"):
            call.result(timeout=10)
    assert not Path(f"/proc/{first}").exists()
    assert not waiting.has_ended
    assert waiting(0, timeout_s=10) is None


def test_a_process_that_is_killed_between_calls_has_ended_and_can_be_renewed(waiting):
    assert waiting(0, timeout_s=10) is None
    first = waiting.pid
    waiting.renew()
    assert waiting.pid == first
    waiting.kill()
    assert waiting.has_ended
    waiting.renew()
    assert waiting(0, timeout_s=10) is None
