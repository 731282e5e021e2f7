"""Make the kernels that ship with the package: python -m release.kernels.

Numba translates each kernel to LLVM's language, as far as that does not depend on the processor. On the
user's machine, `stereoweave.system.shipped_kernels` does the rest. Run this after each change of a kernel;
until then the changed kernel is compiled by Numba at its first use.
"""

import json
import lzma
import os
import re
import sys
import tempfile
import warnings
from collections.abc import Iterable, Iterator
from typing import Any

from llvmlite import binding as llvm

from stereoweave.system.shipped_kernels import ENTRY, FOLDER, INDEX, bitcode_platform, sources_digest

# Functions of Numba's runtime, which is not loaded for shipped kernels: they make and free a kernel's own
# arrays. Numba's code expects the number of references at the beginning, and the address of the data in the
# fourth field.
_RUNTIME = """
declare ptr @malloc(i64)
declare void @free(ptr)

define ptr @NRT_MemInfo_alloc_aligned(i64 %size, i32 %align) {
  %wide = zext i32 %align to i64
  %room = add i64 %wide, 40
  %all = add i64 %size, %room
  %info = call ptr @malloc(i64 %all)
  %failed = icmp eq ptr %info, null
  br i1 %failed, label %done, label %fill
fill:
  store i64 1, ptr %info
  %start = ptrtoint ptr %info to i64
  %end = add i64 %start, %room
  %mask = sub i64 0, %wide
  %aligned = and i64 %end, %mask
  %data = inttoptr i64 %aligned to ptr
  %at = getelementptr { i64, ptr, ptr, ptr, i64 }, ptr %info, i32 0, i32 3
  store ptr %data, ptr %at
  br label %done
done:
  ret ptr %info
}

define void @NRT_MemInfo_call_dtor(ptr %info) {
  call void @free(ptr %info)
  ret void
}
"""
# Of the C library, which every process has loaded.
_OUTSIDE = {"ceilf", "free", "malloc"}
_KINDS = {"int64": "int", "float64": "float"}


def describe(types: Iterable[Any]) -> list[str]:
    """Return Numba's types of arguments in the words of `shipped_kernels.flatten`."""
    from numba import types as numba_types

    known: Any = numba_types
    kinds = []
    for kind in types:
        if isinstance(kind, known.BaseTuple):
            kinds += describe(kind.types)
        elif isinstance(kind, known.Array):
            odd = "" if kind.mutable and kind.aligned else "?"
            kinds.append(f"{kind.dtype}[{kind.ndim}{kind.layout}{odd}]")
        else:
            kinds.append(_KINDS.get(str(kind), str(kind)))
    return kinds


def make_bitcode(assembly: str) -> bytes:
    """Return a kernel's bitcode for any processor of this platform, given what Numba has made of the kernel.

    Raises:
        ValueError: The code refers to objects of this process, or to functions that users' processes lack.
    """
    module = llvm.parse_assembly(_annotate_arguments(assembly))
    for function in module.functions:
        # Visible from outside are only the kernel, and its entry point for Python, which stays unused.
        is_visible = function.linkage == llvm.Linkage.external and not function.is_declaration
        if is_visible and not function.name.startswith("_ZN7cpython"):
            function.name = ENTRY
    module.link_in(llvm.parse_assembly(_RUNTIME))
    for function in module.functions:
        if not function.is_declaration and function.name != ENTRY:
            function.linkage = llvm.Linkage.internal
    _simplify(module)
    names = {function.name for function in module.functions if function.is_declaration}
    outside = {name for name in names if not name.startswith("llvm.")} - _OUTSIDE
    outside |= {value.name for value in module.global_variables if value.name.startswith("numba.dynamic")}
    if outside:
        raise ValueError(f"expected code that stands alone, found references to {', '.join(outside)}")
    return module.as_bitcode()


def _annotate_arguments(assembly: str) -> str:
    """Return the code of a kernel with what Numba does not know of the arrays that it is given.

    They have no owner that counts references to them (`shipped_kernels.flatten`), and those that are written
    overlap no others (`jit.Kernel`).
    """

    def annotate(kernel: re.Match[str]) -> str:
        head, body = kernel.groups()
        for owner in re.findall(r"ptr (%arg\.[\w.]+\.0)[,)]", head):
            body = re.sub(re.escape(owner) + r"(?![\w.])", "null", body)
        return re.sub(r"ptr (?=%arg\.[\w.]+\.4[,)])", "ptr noalias ", head) + body

    return re.sub(r"^(define i32 @.*\n)((?:.*\n)*?}\n)", annotate, assembly, count=1, flags=re.MULTILINE)


def _simplify(module: Any) -> None:
    """Inline functions, and remove what is not used, references to arrays above all."""
    target = llvm.Target.from_triple(llvm.get_process_triple())
    machine = target.create_target_machine(
        cpu="x86-64", opt=3, reloc="static", codemodel="jitdefault", jit=True
    )
    for level in (0, 1):
        options = llvm.create_pipeline_tuning_options(speed_level=level)
        options.loop_vectorization = options.slp_vectorization = False
        options.loop_unrolling = options.loop_interleaving = False
        builder = llvm.create_pass_builder(machine, options)
        passes = builder.getModulePassManager()
        # The passes by which Numba prepares for the removal of references.
        passes.add_loop_rotate_pass()
        passes.add_instruction_combine_pass()
        passes.add_jump_threading_pass()
        passes.add_refprune_pass()
        passes.run(module, builder)


def _compile() -> Iterator[Any]:
    """Compile all kernels by Numba, and yield them."""
    from stereoweave.bench.classical.matchers import rehearse_classical_matchers
    from stereoweave.bench.mc_cnn.steps import rehearse_mc_cnn
    from stereoweave.matching.edge_vote.vote import rehearse_voting
    from stereoweave.matching.matcher import rehearse_finishing
    from stereoweave.matching.refine import rehearse_refining
    from stereoweave.matching.upsample import rehearse_upsampling
    from stereoweave.rendering.rehearsals import rehearse_drawing, rehearse_filling, rehearse_moving
    from stereoweave.system.jit import Kernel
    from stereoweave.video.carried_frames import rehearse_carrying

    matching = rehearse_refining, rehearse_finishing, rehearse_voting, rehearse_upsampling, rehearse_carrying
    rendering = rehearse_drawing, rehearse_filling, rehearse_moving
    for rehearse in (*matching, *rendering, rehearse_classical_matchers, rehearse_mc_cnn):
        rehearse()
    for name, module in sorted(sys.modules.items()):
        if name.startswith("stereoweave.") and name.endswith("_kernels"):
            found = [value for value in vars(module).values() if isinstance(value, Kernel)]
            yield from (kernel for kernel in found if kernel.dispatcher.signatures)


def main() -> None:
    """Write the folder of shipped kernels."""
    FOLDER.mkdir(exist_ok=True)
    for file in FOLDER.iterdir():
        file.unlink()
    # Numba says that it cannot keep code with references, which are only removed here.
    warnings.simplefilter("ignore")
    kernels = {}
    for kernel in _compile():
        (signature,) = kernel.dispatcher.signatures
        bitcode = make_bitcode(kernel.dispatcher.inspect_llvm(signature))
        (FOLDER / f"{kernel.name}.bc.xz").write_bytes(lzma.compress(bitcode))
        digest = sources_digest(kernel.name.rpartition(".")[0])
        kernels[kernel.name] = {"kinds": " ".join(describe(signature)), "sources": digest}
    index = {"platform": bitcode_platform(), "llvm": llvm.llvm_version_info, "kernels": kernels}
    (FOLDER / INDEX).write_text(json.dumps(index, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        # Numba reads this when it is imported: it only translates, because LLVM optimises for the processor.
        os.environ |= {"NUMBA_OPT": "0", "NUMBA_CACHE_DIR": folder}
        main()
