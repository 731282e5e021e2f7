import subprocess
import sys
from pathlib import Path

import pytest

from stereoweave.service.folders import make_own_folder

PROGRAM = """
from stereoweave.service.folders import make_own_folder
with make_own_folder() as folder:
    (folder / "upload").write_bytes(b"x")
    print(folder, flush=True)
    input()
"""


@pytest.fixture(autouse=True)
def temporary(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    return tmp_path


def test_the_next_start_removes_uploads_of_killed_processes_but_not_of_running_ones():
    command = [sys.executable, "-c", PROGRAM]
    pipe = subprocess.PIPE
    with (
        subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as killed,
        subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as running,
    ):
        left_behind, in_use = (Path(each.stdout.readline().rstrip()) for each in (killed, running))
        killed.kill()
        killed.wait()
        assert (left_behind / "upload").exists()
        with make_own_folder():
            assert not left_behind.exists()
            assert (in_use / "upload").exists()
        running.communicate("\n")


def test_a_folder_is_removed_after_its_block(temporary):
    with make_own_folder() as folder:
        (folder / "upload").write_bytes(b"x")
        assert folder.stat().st_mode & 0o777 == 0o700
    assert not list(temporary.iterdir())


def test_a_link_named_like_an_abandoned_folder_is_not_followed(temporary):
    other = temporary / "other"
    other.mkdir()
    (other / "file").write_bytes(b"x")
    (temporary / "stereoweave-service-0").symlink_to(other)
    (temporary / "stereoweave-service-0.lock").touch()
    with make_own_folder():
        assert (other / "file").exists()


def test_a_removed_lock_file_is_no_error(temporary):
    with make_own_folder() as folder:
        folder.with_name(f"{folder.name}.lock").unlink()
    assert not list(temporary.iterdir())
