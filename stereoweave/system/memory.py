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

    The rise is measured in a fresh process. It includes everything loaded while the function is made, such as
    a network, and everything allocated by the first call, such as the result. It excludes everything loaded
    beforehand: Python, NumPy, OpenCV, ONNX Runtime and the argument. The result is NaN on Windows, where peak
    memory is not measured.

    Args:
        make: Function that makes the function to measure. It must be picklable, such as a module-level
            function or a `functools.partial` of a module-level function.
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
    """Return this process's peak resident memory so far, in 10^6 bytes."""
    status = Path("/proc/self/status")
    if status.exists():
        # getrusage is not suitable: on Linux, the peak of a child process starts at its parent's peak.
        (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmHWM:"))
        return int(line.split()[1]) * 1024 / 1e6
    if sys.platform == "win32":
        return float("nan")
    import resource

    # Bytes on macOS, KiB on other systems without /proc.
    unit_bytes = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit_bytes / 1e6
