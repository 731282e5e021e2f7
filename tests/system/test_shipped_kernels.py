import json
import lzma
import re
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from llvmlite import binding

from stereoweave.matching.refine_kernels import census
from stereoweave.system import kernel_cache, shipped_kernels, threads
from stereoweave.system.jit import Kernel
from stereoweave.system.kernel_cache import kernels_folder
from stereoweave.system.shipped_kernels import ENTRY, FOLDER, INDEX, bitcode_platform, flatten, sources_digest

PACKAGE = Path(shipped_kernels.__file__).parents[1]
INDEXED = json.loads((FOLDER / INDEX).read_bytes())
# Only tests call it.
NOT_SHIPPED = {"stereoweave.rendering.canvas_kernels.splat"}

shipped_here = pytest.mark.skipif(
    bitcode_platform() != INDEXED["platform"], reason="kernels ship for Linux on x86-64 only"
)


def kernels():
    """Return all kernels of the package by name, but those of training, which are compiled at first use."""
    found = {}
    for path in sorted(set(PACKAGE.rglob("*_kernels.py")) - set((PACKAGE / "learn").rglob("*"))):
        name = ".".join(["stereoweave", *path.relative_to(PACKAGE).with_suffix("").parts])
        values = vars(import_module(name)).values()
        found |= {value.name: value for value in values if isinstance(value, Kernel)}
    return found


def test_each_kernel_ships_as_its_present_sources_say():
    found = {name: sources_digest(name.rpartition(".")[0]) for name in kernels() if name not in NOT_SHIPPED}
    shipped = {name: entry["sources"] for name, entry in INDEXED["kernels"].items()}
    assert shipped == found, "run: python -m release.kernels"
    assert {file.name for file in FOLDER.iterdir()} == {f"{name}.bc.xz" for name in shipped} | {INDEX}


def test_arrays_are_flattened_to_what_numba_s_code_takes():
    array = np.zeros((3, 5), np.uint16)
    kinds, words = flatten((7, (0.5, array.T)))
    assert kinds == "int float uint16[2F]"
    assert words == [7, 0.5, 0, 0, 15, 2, array.ctypes.data, 5, 3, 2, 10]


def test_arrays_for_which_no_code_ships_are_told_apart():
    array = np.zeros((4, 4), np.float32)
    fixed = array.copy()
    fixed.flags.writeable = False
    kinds, _ = flatten((array[:, ::2], fixed, array[:2].astype(">f4"), True, np.float32(1)))
    assert kinds == "float32[2A] float32[2C?] float32[2C?] bool float32"


ROUGH = """
import sys
import numpy as np
from pathlib import Path
from stereoweave.system import shipped_kernels
{}
from stereoweave.matching.refine_kernels import census
codes = np.zeros((1, 2), np.uint32)
census(np.array([[3, 5]], np.uint8), codes)
print(codes.tolist(), "numba" in sys.modules)
"""
# The darker pixel has no darker neighbour; of the brighter one's 24, clamped, those in the columns before it.
CODES = [[0, 0b11000_11000_1100_11000_11000]]


@pytest.fixture
def no_kernels(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))


def run(change):
    done = subprocess.run(
        [sys.executable, "-c", ROUGH.format(change)], capture_output=True, text=True, check=True
    )
    assert done.stderr == ""
    return done.stdout


@shipped_here
def test_a_shipped_kernel_runs_without_numba(no_kernels):
    assert run("") == f"{CODES} False\n"


@pytest.mark.parametrize(
    "change",
    [
        "shipped_kernels.FOLDER = Path('missing')",
        "shipped_kernels.bitcode_platform = lambda: 'plan9 mips'",
        "shipped_kernels.sources_digest = lambda module: 'changed'",
    ],
    ids=["none", "for another platform", "from other sources"],
)
def test_numba_compiles_a_kernel_that_does_not_ship(no_kernels, change):
    assert run(change) == f"{CODES} True\n"


@shipped_here
def test_numba_compiles_a_kernel_for_other_arguments():
    codes = np.zeros((2, 1), np.uint32, order="F")[::-1].T  # neither rows nor columns are contiguous
    census(np.array([[3, 5]], np.uint8), codes)
    assert codes.tolist() == CODES


@shipped_here
def test_damaged_machine_code_is_made_again(no_kernels):
    run("")
    (file,) = kernels_folder().glob("*.o")
    made = file.read_bytes()
    file.write_bytes(made[:100] + bytes(100) + made[200:])
    assert run("") == f"{CODES} False\n"
    assert file.read_bytes() == made


@shipped_here
def test_threads_share_the_machine_code_without_a_writable_folder(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    made = []
    link = shipped_kernels._link
    monkeypatch.setattr(shipped_kernels, "_link", lambda *given: made.append(link(*given)) or made[-1])
    kernel = shipped_kernels.find_shipped("stereoweave.matching.refine_kernels.census")

    def run(_):
        codes = np.zeros((1, 2), np.uint32)
        kernel(flatten((np.array([[3, 5]], np.uint8), codes))[1])
        return codes.tolist()

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(run, range(4))) == [CODES] * 4
    assert len(made) == 1  # a second one would free the code that other threads run


@shipped_here
def test_shipped_code_knows_no_processor():
    code = b"".join(lzma.decompress(file.read_bytes()) for file in FOLDER.glob("*.xz"))
    assert b"llvm.x86" not in code
    assert b"target-cpu" not in code


def shipped_code():
    """Return the first line and the body of each shipped kernel's code, by its file's name."""
    found = {}
    for file in FOLDER.glob("*.xz"):
        code = str(binding.parse_bitcode(lzma.decompress(file.read_bytes())))
        (kernel,) = re.findall(rf"^define .*@{ENTRY}\((?:.*\n)*?}}$", code, re.MULTILINE)
        found[file.name] = kernel.split("\n", 1)
    return found


@shipped_here
def test_shipped_kernels_do_not_use_the_owners_of_arrays():
    for name, (head, body) in shipped_code().items():
        owners = re.findall(r"ptr [^%]*(%arg\.[\w.]+\.0)[,)]", head)
        assert owners, name
        assert not [owner for owner in owners if re.search(re.escape(owner) + r"(?![\w.])", body)], name


@shipped_here
def test_shipped_kernels_are_told_that_arrays_do_not_overlap():
    for name, (head, _) in shipped_code().items():
        addresses = re.findall(r"ptr ([^%]*)%arg\.[\w.]+\.4[,)]", head)
        assert addresses, name
        assert all("noalias" in address for address in addresses), name


def interrupt_at_line(number, files):
    """Return a trace function that raises KeyboardInterrupt, once, at that line run of source files."""
    left = iter(range(number, -1, -1))

    def trace(frame, event, _):
        if frame.f_code.co_filename not in files:
            return None
        if event == "line" and next(left, None) == 0:
            raise KeyboardInterrupt
        return trace

    return trace


@shipped_here
def test_a_loading_that_ctrl_c_interrupts_anywhere_keeps_no_other_thread_waiting(no_kernels):
    """At the end of a command, other threads may still compile while the error is on its way."""
    image, codes = np.array([[3, 5]], np.uint8), np.zeros((1, 2), np.uint32)
    Kernel(census.__wrapped__)(image, codes)
    files = {module.__file__ for module in (kernel_cache, shipped_kernels, threads)}
    tracer = sys.gettrace()
    interrupted = 0
    for number in range(60):
        run_kernel = Kernel(census.__wrapped__)
        try:
            sys.settrace(interrupt_at_line(number, files))
            run_kernel(image, codes)
        except KeyboardInterrupt:
            sys.settrace(tracer)
            interrupted += 1
            other = threading.Thread(target=Kernel(census.__wrapped__), args=[image, codes])
            other.start()
            other.join(20)
            assert not other.is_alive(), number
        finally:
            sys.settrace(tracer)
    assert 10 < interrupted < 60
