"""Kernels that ship with the package as LLVM bitcode, so that a first run need not wait for Numba.

Numba takes seconds to translate a kernel to LLVM's language, and LLVM a fraction of a second to translate
that to machine code. `python -m release.kernels` has done the first part for every kernel. This module does
the second part for the processor at hand, and keeps the machine code in the folder of compiled kernels.
"""

import ctypes
import functools
import hashlib
import json
import lzma
import platform
import re
import sys
import threading
import zlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from stereoweave.system.kernel_cache import compile_once, kernels_folder
from stereoweave.system.threads import beyond_ctrl_c

Words = list[int | float]
"""Arguments as a kernel's machine code takes them: each array as seven numbers or more, tuples flattened."""

ENTRY = "stereoweave_kernel"
"""Name of the function in the bitcode."""
FOLDER = Path(__file__).with_name("kernels")
INDEX = "index.json"
_PACKAGE = Path(__file__).parents[1]
_IMPORT = re.compile(r"^from (stereoweave\.[\w.]+_kernels) import", re.MULTILINE)


def bitcode_platform() -> str:
    """Return the platform whose bitcode this process can run."""
    return f"{sys.platform} {platform.machine()}"


def flatten(arguments: Sequence[Any]) -> tuple[str, Words]:
    """Return the types of a kernel's arguments, and the numbers that its machine code takes.

    An array is passed as its owner and parent (which are for Numba, and null), size, item size, address,
    shape and strides.
    """
    kinds, words = list[str](), Words()
    _flatten(arguments, kinds, words)
    return " ".join(kinds), words


def _flatten(values: Sequence[Any], kinds: list[str], words: Words) -> None:
    for value in values:
        if isinstance(value, tuple):
            _flatten(value, kinds, words)
        elif isinstance(value, np.ndarray):
            flags = value.flags
            layout = "C" if flags.c_contiguous else "F" if flags.f_contiguous else "A"
            odd = "" if flags.behaved and value.dtype.isnative else "?"
            kinds.append(f"{value.dtype.name}[{value.ndim}{layout}{odd}]")
            words += [0, 0, value.size, value.itemsize, value.ctypes.data, *value.shape, *value.strides]
        else:
            kind = "int" if isinstance(value, np.int64) else "float" if isinstance(value, float) else None
            kinds.append(kind or type(value).__name__)
            words.append(value.item() if isinstance(value, np.generic) else value)


@functools.cache
def sources_digest(module: str) -> str:
    """Return the first 12 hexadecimal digits of a hash of the sources of a module of kernels.

    They include the modules of kernels that it imports, and the compiler's settings.
    """
    digest = hashlib.sha256(Path(__file__).with_name("jit.py").read_bytes())
    known = [module]
    for name in known:
        source = _PACKAGE.joinpath(*name.split(".")[1:]).with_suffix(".py").read_text("utf-8")
        digest.update(source.encode())
        known += [other for other in sorted(set(_IMPORT.findall(source))) if other not in known]
    return digest.hexdigest()[:12]


def kernels_ship() -> bool:
    """Return whether there are shipped kernels for this machine."""
    return bool(_index())


def find_shipped(name: str) -> "ShippedKernel | None":
    """Return the shipped kernel of that full name; None if there is none for this machine and its sources."""
    entry = _index().get(name)
    module = name.rpartition(".")[0]
    if entry is None or entry["sources"] != sources_digest(module):
        return None
    return ShippedKernel(name=name, kinds=entry["kinds"], file=FOLDER / f"{name}.bc.xz")


@functools.cache
def _index() -> dict[str, dict[str, str]]:
    """Return the shipped kernels by name; none if this machine cannot run them."""
    try:
        index = json.loads((FOLDER / INDEX).read_bytes())
    except OSError:
        return {}
    from llvmlite.binding import llvm_version_info

    fits = index["platform"] == bitcode_platform() and tuple(index["llvm"]) <= llvm_version_info
    return index["kernels"] if fits else {}


@dataclass
class ShippedKernel:
    """A kernel that is loaded, or compiled by LLVM, at its first call.

    Attributes:
        name: Full name of the kernel.
        kinds: Types of its arguments, as `flatten` describes them.
        file: Its bitcode.
        loads: How often machine code was loaded rather than compiled.
    """

    name: str
    kinds: str
    file: Path
    loads: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _run: Any = None
    _engine: Any = None

    def __call__(self, words: Words) -> None:
        """Run the kernel.

        Raises:
            MemoryError: There is too little memory for the kernel's own arrays.
        """
        run = self._run or beyond_ctrl_c(self._prepare)
        if run(ctypes.byref(ctypes.c_void_p()), ctypes.byref(ctypes.c_void_p()), *words):
            raise MemoryError(self.name)

    def _prepare(self) -> Any:
        bitcode = lzma.decompress(self.file.read_bytes())
        digest = hashlib.sha256(repr((bitcode, *_processor())).encode()).hexdigest()[:12]
        file = f"{self.name}.{digest}.o"
        # The second lock is for a folder without locks: no thread may replace the code that another one runs.
        with compile_once(self.name, file), self._lock:
            if self._run is None:
                code = self._load(file) or self._compile(bitcode, file)
                self._engine, self._run = _link(code, self.kinds)
        return self._run

    def _load(self, file: str) -> bytes | None:
        with suppress(OSError, RuntimeError, zlib.error):
            code = zlib.decompress((kernels_folder() / file).read_bytes())
            self.loads += 1
            return code
        return None

    def _compile(self, bitcode: bytes, file: str) -> bytes:
        code = _compile_bitcode(bitcode)
        with suppress(OSError, RuntimeError):  # without a folder, every process compiles for itself
            temporary = kernels_folder() / f".{uuid4().hex[:8]}.{file}"
            try:
                temporary.write_bytes(zlib.compress(code, 1))  # its checksum reveals damage
                temporary.replace(kernels_folder() / file)
            finally:
                temporary.unlink(missing_ok=True)
        return code


def _compile_bitcode(bitcode: bytes) -> bytes:
    """Return machine code for this processor, as an object file."""
    from llvmlite import binding as llvm

    machine = _target_machine()
    module = llvm.parse_bitcode(bitcode)
    options = llvm.create_pipeline_tuning_options(speed_level=3)
    options.loop_vectorization, options.slp_vectorization = True, False
    passes = llvm.create_pass_builder(machine, options)
    passes.getModulePassManager().run(module, passes)
    return machine.emit_object(module)


def _link(code: bytes, kinds: str) -> tuple[Any, Any]:
    """Return the engine that holds machine code, and the function in it."""
    from llvmlite import binding as llvm

    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _target_machine())
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    types: list[Any] = [ctypes.c_void_p, ctypes.c_void_p]
    for kind in kinds.split():
        dimensions = re.search(r"\[(\d+)", kind)
        count = 5 + 2 * int(dimensions[1]) if dimensions else 1
        types += count * [ctypes.c_double if kind == "float" else ctypes.c_ssize_t]
    return engine, ctypes.CFUNCTYPE(ctypes.c_int32, *types)(engine.get_function_address(ENTRY))


@functools.cache
def _processor() -> tuple[str, str, str]:
    """Return name and features of the processor, in LLVM's words, and the version of llvmlite."""
    import llvmlite
    from llvmlite import binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten(), llvmlite.__version__


def _target_machine() -> Any:
    """Return a description of this machine for LLVM, with Numba's settings; an engine takes it over."""
    from llvmlite import binding as llvm

    name, features, _ = _processor()
    target = llvm.Target.from_triple(llvm.get_process_triple())
    return target.create_target_machine(
        cpu=name, features=features, opt=3, reloc="static", codemodel="jitdefault", jit=True
    )
