"""What was found: told apart by where it happened, made small, and kept as files."""

import hashlib
import re
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

# Not the thread by which a worker ends with its parent.
_OWN_FRAME = re.compile(r'/(stereoweave/(?!system/processes)[\w/]+\.py)", line \d+,? in (\w+)')


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A case that was answered by anything but an error of the package's own.

    Attributes:
        what: The class of the exception, the signal, or how else the process ended.
        place: The innermost function of the package that was at work.
        detail: What was said, in one line.
        name: The file's name.
        content: Its bytes.
    """

    what: str
    place: str
    detail: str
    name: str
    content: bytes

    @property
    def key(self) -> str:
        """The same for all cases of one fault."""
        return f"{self.what} in {self.place}"

    @classmethod
    def of_error(cls, error: BaseException, name: str, content: bytes) -> "Finding":
        """The finding that an exception is."""
        frames = "".join(reversed(traceback.format_tb(error.__traceback__)))
        line = (str(error).strip().splitlines() or [""])[0][:200]
        detail = line.encode("ascii", "backslashreplace").decode()  # it may quote anything
        return cls(what=type(error).__name__, place=_place(frames), detail=detail, name=name, content=content)

    @classmethod
    def of_death(cls, what: str, log: str, name: str, content: bytes) -> "Finding":
        """The finding that the end of a process is, by what `faulthandler` wrote of it."""
        return cls(what=what, place=_place(log), detail="", name=name, content=content)


def _place(frames: str) -> str:
    """The first function of the package in printed frames, the innermost one first."""
    found = _OWN_FRAME.search(frames)
    return f"{found[1]}:{found[2]}" if found else "its target"


def shrunk(content: bytes, fails_alike: Callable[[bytes], bool], seconds: float) -> bytes:
    """Less of the content, which still fails alike: parts are left out, large ones first."""
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
    """Writes a finding as the file HASH-NAME."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{hashlib.sha256(finding.content).hexdigest()[:8]}-{finding.name}"
    path.write_bytes(finding.content)
    return path


def kept(folder: Path) -> dict[Path, str]:
    """The findings in a folder, each with the name that its file had."""
    return {path: path.name.partition("-")[2] for path in sorted(folder.glob("*-*"))}
