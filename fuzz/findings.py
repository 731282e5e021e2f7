"""Findings of the fuzzer: identified by their place, reduced to small files, and stored."""

import hashlib
import re
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

# Excludes the thread that ends a worker together with its parent.
_OWN_FRAME = re.compile(r'/(stereoweave/(?!system/processes)[\w/]+\.py)", line \d+,? in (\w+)')


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A case that caused anything but one of the package's own errors.

    Attributes:
        what: Class of the exception, or the signal or other reason that ended the process.
        place: Innermost function of the package on the stack.
        detail: The exception's message, in one line.
        name: Name of the file.
        content: Bytes of the file.
    """

    what: str
    place: str
    detail: str
    name: str
    content: bytes

    @property
    def key(self) -> str:
        """Identity of the fault, the same for all its cases."""
        return f"{self.what} in {self.place}"

    @classmethod
    def from_error(cls, error: BaseException, name: str, content: bytes) -> "Finding":
        """Make a finding of an exception."""
        frames = "".join(reversed(traceback.format_tb(error.__traceback__)))
        line = (str(error).strip().splitlines() or [""])[0][:200]
        detail = line.encode("ascii", "backslashreplace").decode()  # the message may quote any bytes
        return cls(what=type(error).__name__, place=_place(frames), detail=detail, name=name, content=content)

    @classmethod
    def from_death(cls, what: str, log: str, name: str, content: bytes) -> "Finding":
        """Make a finding of the end of a process, from the output of `faulthandler`."""
        return cls(what=what, place=_place(log), detail="", name=name, content=content)


def _place(frames: str) -> str:
    """Find the first function of the package in printed frames, innermost first."""
    found = _OWN_FRAME.search(frames)
    return f"{found[1]}:{found[2]}" if found else "its target"


def shrink(content: bytes, fails_alike: Callable[[bytes], bool], seconds: float) -> bytes:
    """Remove parts of the content, large ones first, as long as the rest fails alike."""
    end_s, step = monotonic() + seconds, len(content) // 2
    while step:
        start = 0
        while start < len(content) and monotonic() < end_s:
            without = content[:start] + content[start + step :]
            if fails_alike(without):
                content = without
            else:
                start += step
        step //= 2
    return content


def keep(finding: Finding, folder: Path) -> Path:
    """Write a finding to the file HASH-NAME."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{hashlib.sha256(finding.content).hexdigest()[:8]}-{finding.name}"
    path.write_bytes(finding.content)
    return path


def list_findings(folder: Path) -> dict[Path, str]:
    """Map the files of a folder's findings to the names that they had in their cases."""
    return {path: path.name.partition("-")[2] for path in sorted(folder.glob("*-*"))}
