import multiprocessing
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest
from PIL import Image

from stereoweave.system import compiling_ahead as ahead
from stereoweave.system import shipped_kernels
from stereoweave.system.compiling_ahead import compile_ahead, compiling_ahead
from stereoweave.system.kernel_cache import kernels_folder

# Its tests would need a function that waits forever and that another process can import.
pytestmark = pytest.mark.skipif(not hasattr(signal, "pause"), reason="Windows cannot wait for a signal")


@pytest.fixture(autouse=True)
def two_cores_and_no_kernels(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    monkeypatch.setattr(ahead, "usable_cores", lambda: 2)


@pytest.fixture
def no_shipped_kernels(monkeypatch):
    monkeypatch.setattr(ahead, "kernels_ship", lambda: False)


# The other process imports the program too, and so has no shipped kernels either.
REHEARSED = """
import multiprocessing
import threading
from pathlib import Path
from stereoweave.system import compiling_ahead as ahead, shipped_kernels
shipped_kernels.FOLDER = Path({folder!r})
from stereoweave.matching import refine_kernels as kernels
from stereoweave.matching.refine import rehearse_refining
ahead.usable_cores = lambda: 2
if __name__ == "__main__":
    with ahead.compiling_ahead():
        ahead.compile_ahead(rehearse_refining)
        [process.join() for process in multiprocessing.active_children()]
    rehearse_refining()
    print(kernels.census.loads, kernels.match.loads, kernels.along_rows.loads, kernels.extend.loads)
    with ahead.compiling_ahead():
        ahead.compile_ahead(rehearse_refining)
        print(multiprocessing.active_children(), threading.active_count())
"""


def rehearse(tmp_path, folder):
    program = tmp_path / "program.py"
    program.write_text(REHEARSED.format(folder=str(folder)))
    done = subprocess.run([sys.executable, program], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return done.stdout


def test_kernels_are_loaded_that_another_process_compiled_and_compiled_ahead_once(tmp_path):
    assert rehearse(tmp_path, tmp_path / "missing") == "1 1 1 1\n[] 1\n"


@pytest.mark.skipif(not shipped_kernels.kernels_ship(), reason="none ships for this machine")
def test_a_thread_compiles_shipped_kernels_ahead_once(tmp_path):
    # The first program has what its thread compiled; the second one loads it.
    assert rehearse(tmp_path, shipped_kernels.FOLDER) == "0 0 0 0\n[] 1\n"
    assert rehearse(tmp_path, shipped_kernels.FOLDER) == "1 1 1 1\n[] 1\n"


@pytest.fixture
def pair(rng, tmp_path, monkeypatch):
    """Write a pair of 95x64 with a disparity of 8 px to the folder pairs/one of the current one."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "pairs" / "one"
    folder.mkdir(parents=True)
    photograph = Image.fromarray(rng.integers(0, 256, (8, 13, 3), dtype=np.uint8)).resize((104, 64))
    photograph.crop((0, 0, 95, 64)).save(folder / "left.png")
    photograph.crop((8, 0, 103, 64)).save(folder / "right.png")


def compiled_by(line):
    """Run a command, and return the modules of the kernels that it has compiled."""
    subprocess.run([sys.executable, "-m", "stereoweave", *line.split()], check=True, capture_output=True)
    return {file.name.split(".")[-4] for file in kernels_folder().glob("*.o")}


FINISHING = {"subpixel_kernels", "occlusion_fill_kernels", "streak_kernels"}
MATCHING = {"refine_kernels", "vote_kernels", *FINISHING}
RENDERING = {"background_kernels", "draw_kernels", "hole_filling_kernels"}


@pytest.mark.skipif(not shipped_kernels.kernels_ship(), reason="none ships for this machine")
@pytest.mark.parametrize(
    ("line", "modules"),
    [
        ("depth pairs --raw -o many", set()),
        ("depth pairs -o many", MATCHING),
        ("depth pairs/one/left.png pairs/one/right.png --raw -o out", RENDERING),
        (
            "view pairs/one/left.png pairs/one/right.png --layout rgbd -o view.png",
            MATCHING,
        ),
    ],
    ids=["no report, raw", "no report", "raw", "no view"],
)
def test_a_command_compiles_only_what_it_needs(pair, line, modules):
    assert compiled_by(line) == modules


def test_a_library_starts_no_process(no_shipped_kernels):
    compile_ahead(signal.pause)
    assert multiprocessing.active_children() == []


def test_a_single_core_compiles_nothing_ahead(monkeypatch, no_shipped_kernels):
    monkeypatch.setattr(ahead, "usable_cores", lambda: 1)
    with compiling_ahead():
        compile_ahead(signal.pause)
        assert multiprocessing.active_children() == []


def test_a_command_leaves_no_process_behind(no_shipped_kernels):
    with compiling_ahead():
        compile_ahead(signal.pause)
        compile_ahead(signal.pause)
        assert len(multiprocessing.active_children()) == 1
    assert multiprocessing.active_children() == []


def test_a_command_leaves_no_thread_behind():
    before = threading.active_count()
    at_work = threading.Event()

    def rehearse():
        at_work.wait(60)

    with compiling_ahead():
        compile_ahead(rehearse)
        assert threading.active_count() == before + 1
        at_work.set()
    assert threading.active_count() == before


def test_without_a_writable_folder_nothing_is_compiled_ahead(tmp_path, monkeypatch, no_shipped_kernels):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    with compiling_ahead():
        compile_ahead(signal.pause)
        assert multiprocessing.active_children() == []
