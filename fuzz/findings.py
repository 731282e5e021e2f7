"""Findings of the fuzzer: identification by place in the code, reduction to small files, and storage."""

import hashlib
import re
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

# Excludes system/processes, whose thread ends a worker together with its parent.
_OWN_FRAME = re.compile(r'/(stereoweave/(?!system/processes)[\w/]+\.py)", line \d+,? in (\w+)')


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Case that caused anything other than one of the package's own errors.

    Attributes:
        what: Class of the exception, or what ended the process: the name of a signal, or "hang".
        place: Innermost function of the package on the call stack.
        detail: First line of the exception's message.
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
        """Identifier of the fault, the same for all cases of one fault."""
        return f"{self.what} in {self.place}"

    @classmethod
    def from_error(cls, error: BaseException, name: str, content: bytes) -> "Finding":
        """Return the finding for an exception."""
        frames = "".join(reversed(traceback.format_tb(error.__traceback__)))
        line = (str(error).strip().splitlines() or [""])[0][:200]
        detail = line.encode("ascii", "backslashreplace").decode()  # the message may quote arbitrary bytes
        return cls(what=type(error).__name__, place=_place(frames), detail=detail, name=name, content=content)

    @classmethod
    def from_death(cls, what: str, log: str, name: str, content: bytes) -> "Finding":
        """Return the finding for the death of a process, from the output of `faulthandler`."""
        return cls(what=what, place=_place(log), detail="", name=name, content=content)


def _place(frames: str) -> str:
    """Return the first function of the package in a printed stack, which lists the innermost frame first."""
    found = _OWN_FRAME.search(frames)
    return f"{found[1]}:{found[2]}" if found else "its target"


def shrink(content: bytes, fails_alike: Callable[[bytes], bool], seconds: float) -> bytes:
    """Remove parts of the content, large ones first, as long as the failure stays the same."""
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
    """Write a finding to a file named HASH-NAME and return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{hashlib.sha256(finding.content).hexdigest()[:8]}-{finding.name}"
    path.write_bytes(finding.content)
    return path


def list_findings(folder: Path) -> dict[Path, str]:
    """Return the files of the findings in a folder, each with its original file name."""
    return {path: path.name.partition("-")[2] for path in sorted(folder.glob("*-*"))}
