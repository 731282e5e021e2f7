import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from contextvars import copy_context

import pytest

from stereoweave.system import kernel_cache
from stereoweave.system.kernel_cache import compile_ahead, compile_once, compiling_ahead, kernels_folder
from stereoweave.system.steps import listening

# Its tests would need a function that waits forever and that another process can import.
pytestmark = pytest.mark.skipif(not hasattr(signal, "pause"), reason="Windows cannot wait for a signal")


@pytest.fixture(autouse=True)
def two_cores_and_no_kernels(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    monkeypatch.setattr(kernel_cache, "usable_cores", lambda: 2)


REHEARSED = """
import multiprocessing
from stereoweave.matching import refine_kernels as kernels
from stereoweave.matching.refine import rehearse_refining
from stereoweave.system import kernel_cache
kernel_cache.usable_cores = lambda: 2
with kernel_cache.compiling_ahead():
    kernel_cache.compile_ahead(rehearse_refining)
    [process.join() for process in multiprocessing.active_children()]
rehearse_refining()
print(kernels.census.loads, kernels.match.loads, kernels.along_rows.loads, kernels.extend.loads)
with kernel_cache.compiling_ahead():
    kernel_cache.compile_ahead(rehearse_refining)
    print(multiprocessing.active_children())
"""


def test_kernels_are_loaded_that_another_process_compiled_and_compiled_ahead_once():
    done = subprocess.run([sys.executable, "-c", REHEARSED], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("1 1 1 1\n[]\n", "")


def test_a_library_starts_no_process():
    compile_ahead(signal.pause)
    assert multiprocessing.active_children() == []


def test_a_single_core_compiles_nothing_ahead(monkeypatch):
    monkeypatch.setattr(kernel_cache, "usable_cores", lambda: 1)
    with compiling_ahead():
        compile_ahead(signal.pause)
        assert multiprocessing.active_children() == []


def test_a_command_leaves_no_process_behind():
    with compiling_ahead():
        compile_ahead(signal.pause)
        compile_ahead(signal.pause)
        assert len(multiprocessing.active_children()) == 1
    assert multiprocessing.active_children() == []


def test_a_kernel_waits_while_it_is_compiled_elsewhere():
    waits, order = threading.Event(), []

    def load():
        with listening(lambda step: waits.set()), compile_once("slow"):
            order.append("loaded")

    with compile_once("slow"):
        thread = threading.Thread(target=copy_context().run, args=[load])
        thread.start()
        assert waits.wait(60)
        order.append("compiled")
    thread.join()
    assert order == ["compiled", "loaded"]


def test_only_the_first_compilation_is_announced():
    told = []
    with listening(told.append):
        with compile_once("one"):
            assert [step.name for step in told] == ["compiling, once on this machine"]
        told.clear()
        with compile_once("one"):
            pass
    assert told == []


def test_without_a_writable_folder_kernels_are_compiled_all_the_same(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    with compiling_ahead():
        compile_ahead(signal.pause)
        assert multiprocessing.active_children() == []
    with pytest.raises(ZeroDivisionError), compile_once("one"):
        raise ZeroDivisionError


def test_the_folder_is_the_user_s_unless_numba_s_variable_names_another(tmp_path, monkeypatch):
    assert kernels_folder().parent == tmp_path / "kernels"
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    if os.name == "posix" and sys.platform != "darwin":
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        assert kernels_folder().parent == tmp_path / "stereoweave" / "kernels"
