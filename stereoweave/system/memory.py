"""Peak memory of a function, measured in a separate process."""

import multiprocessing
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TypeVar

Argument = TypeVar("Argument")


def peak_memory_mb(make: Callable[[], Callable[[Argument], object]], argument: Argument) -> float:
    """Return the rise in peak resident memory, in 10^6 bytes, while a function is made and called once.

    The rise is measured in a fresh process. It includes what making the function loads, such as a network,
    and what the first call allocates, such as its result. It excludes what is loaded beforehand: Python,
    NumPy, OpenCV, ONNX Runtime and the argument. It is NaN on Windows, which does not report peak memory.

    Args:
        make: Makes the function. Must be picklable, such as a module-level function or a partial of one.
        argument: The function's argument.
    """
    import cv2

    # Spawned, because a forked child would inherit its parent's memory.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context, cv2.setNumThreads, (cv2.getNumThreads(),)) as pool:
        return pool.submit(_measure_rise_mb, make, argument).result()


def _measure_rise_mb(make: Callable[[], Callable[[Argument], object]], argument: Argument) -> float:
    import onnxruntime  # type: ignore[import-untyped]  # noqa: F401 - not counted

    before_mb = _read_peak_mb()
    make()(argument)
    return _read_peak_mb() - before_mb


def _read_peak_mb() -> float:
    """Return this process's peak resident memory so far."""
    status = Path("/proc/self/status")
    if status.exists():
        # Not getrusage, whose peak for a child process starts at the parent's on Linux.
        (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmHWM:"))
        return int(line.split()[1]) * 1024 / 1e6
    if sys.platform == "win32":
        return float("nan")
    import resource

    # Bytes on macOS, KiB on other systems without /proc.
    unit_bytes = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit_bytes / 1e6
