"""Fuzzing target that fails in the way that its input files request, for the tests of the fuzzer."""

import os
import signal
import warnings
from pathlib import Path

from fuzz.targets import Target
from stereoweave.errors import FormatError


def _read(path: Path) -> None:
    content = path.read_bytes()
    if b"refuse" in content:
        raise FormatError("refused")
    if b"raise" in content:
        raise IndexError("out of range")
    if b"warn" in content:
        warnings.warn("odd", stacklevel=1)
    if b"exhaust" in content:
        bytearray(3 * 10**9)
    if b"crash" in content:
        os.kill(os.getpid(), signal.SIGSEGV)
    while b"hang" in content:
        pass


TARGET = Target(starts=lambda: {"file.txt": b"fine"}, read=_read, tokens=(b"raise", b"refuse"))
