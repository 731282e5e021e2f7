"""The memory that a function needs, measured in a process of its own."""

import multiprocessing
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TypeVar

Argument = TypeVar("Argument")


def peak_memory_mb(make: Callable[[], Callable[[Argument], object]], argument: Argument) -> float:
    """How far resident memory rises, in 10^6 bytes, while a function is made and called once.

    Counted is what a fresh process holds in RAM at its peak: what making the function loads, such as a
    network, and what the first call takes, its result included. Not counted is what was there before: Python,
    NumPy, OpenCV, ONNX Runtime and the argument. NaN where the system does not tell (Windows).

    Args:
        make: Makes the function; it is pickled, so a function of a module, or a partial of one.
        argument: What that function is called with.
    """
    import cv2

    # Started afresh: a forked child would hold what its parent holds.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context, cv2.setNumThreads, (cv2.getNumThreads(),)) as pool:
        return pool.submit(_measure_rise_mb, make, argument).result()


def _measure_rise_mb(make: Callable[[], Callable[[Argument], object]], argument: Argument) -> float:
    import onnxruntime  # type: ignore[import-untyped]  # noqa: F401 - its code is no matcher's

    before_mb = _read_peak_mb()
    make()(argument)
    return _read_peak_mb() - before_mb


def _read_peak_mb() -> float:
    """The most that this process has had in RAM so far."""
    status = Path("/proc/self/status")
    if status.exists():
        # Not getrusage, which on Linux starts a child at its parent's peak.
        (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmHWM:"))
        return int(line.split()[1]) * 1024 / 1e6
    if sys.platform == "win32":
        return float("nan")
    import resource

    # Bytes on macOS, KiB on the other systems that have no /proc.
    unit_bytes = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit_bytes / 1e6
