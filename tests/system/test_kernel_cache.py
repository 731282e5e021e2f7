import os
import signal
import subprocess
import sys
import threading
from contextvars import copy_context

import pytest

from stereoweave.system.kernel_cache import compile_once, kernels_folder
from stereoweave.system.steps import listening


@pytest.fixture(autouse=True)
def no_kernels(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))


def test_a_kernel_waits_while_it_is_compiled_elsewhere():
    waits, order = threading.Event(), []

    def load():
        with listening(lambda step: waits.set()), compile_once("slow", "slow.o"):
            order.append("loaded")

    with compile_once("slow", "slow.o"):
        thread = threading.Thread(target=copy_context().run, args=[load])
        thread.start()
        assert waits.wait(60)
        order.append("compiled")
    thread.join()
    assert order == ["compiled", "loaded"]


def test_only_the_first_compilation_is_announced():
    told = []
    with listening(told.append):
        with compile_once("one", "one.*.o"):
            assert [step.name for step in told] == ["compiling, once on this machine"]
            (kernels_folder() / "one.0123.o").write_bytes(b"")
        told.clear()
        with compile_once("one", "one.*.o"):
            pass
    assert told == []


KILLED = """
import os, signal
from stereoweave.system.kernel_cache import compile_once
with compile_once("one", "one.o"):
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="Windows has no such signal")
def test_the_lock_of_a_killed_process_is_no_proof_of_a_compiled_kernel():
    done = subprocess.run([sys.executable, "-c", KILLED])
    assert done.returncode == -signal.SIGKILL
    assert (kernels_folder() / "one.lock").exists()
    told = []
    with listening(told.append), compile_once("one", "one.o"):
        assert [step.name for step in told] == ["compiling, once on this machine"]


def test_without_a_writable_folder_kernels_are_compiled_all_the_same(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    with pytest.raises(ZeroDivisionError), compile_once("one", "one.o"):
        raise ZeroDivisionError


def test_the_folder_is_the_user_s_unless_numba_s_variable_names_another(tmp_path, monkeypatch):
    assert kernels_folder().parent == tmp_path / "kernels"
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    if os.name == "posix" and sys.platform != "darwin":
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        assert kernels_folder().parent == tmp_path / "stereoweave" / "kernels"


def test_waiting_for_a_process_that_loads_a_kernel_is_not_announced():
    told, order = [], []
    with compile_once("one", "one.o"):
        (kernels_folder() / "one.o").write_bytes(b"")

        def load():
            with listening(told.append), compile_once("one", "one.o"):
                order.append("loaded")

        thread = threading.Thread(target=load)
        thread.start()
        thread.join(0.1)
        order.append("known")
    thread.join()
    assert (told, order) == ([], ["known", "loaded"])
