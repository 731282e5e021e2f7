"""Worker process that reads damaged files of one target until its time is up or the process dies."""

import faulthandler
import os
import resource
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count
from multiprocessing.connection import Connection
from pathlib import Path
from random import Random
from time import monotonic

from fuzz.findings import Finding, list_findings, shrink
from fuzz.mutations import mutate
from fuzz.targets import load
from stereoweave.errors import StereoweaveError
from stereoweave.system.processes import begin_work

READY, DONE = "ready", "done"
CASE, LOG = "case", "log"
_STARTING_S = 120
_SHRINKING_S = 2
_MORE_BYTES = 2 * 10**9


@dataclass(frozen=True, kw_only=True)
class Task:
    """Task of a worker.

    Attributes:
        target: Name of the target, as for `targets.load`.
        seed: Random seed.
        seconds: Working time, measured from the first case.
        case_s: Time limit for a case, in seconds.
        corpus: Folder of earlier findings for the target.
        folder: The worker's own folder, for the current file and the log of a crash.
    """

    target: str
    seed: int
    seconds: float
    case_s: float
    corpus: Path
    folder: Path


def work(task: Task, first: int, known: Sequence[str], messages: Connection) -> None:
    """Read cases from number `first` on and report to `messages`.

    The messages are READY, the number of each case before it is read, each Finding with a new key, and DONE.
    """
    begin_work(threads=1)
    with (task.folder / LOG).open("ab") as log, Path(os.devnull).open("wb") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(log.fileno(), 2)
        faulthandler.enable(log)
        faulthandler.dump_traceback_later(_STARTING_S, exit=True, file=log)
        cases = Cases(task)
        cases.read_valid()  # loads libraries and compiles kernels
        _limit_memory()
        messages.send(READY)
        end_s, found = monotonic() + task.seconds, set(known)
        for number in count(first):
            os.ftruncate(log.fileno(), 0)
            faulthandler.dump_traceback_later(task.case_s, exit=True, file=log)
            messages.send(number)
            finding = cases.find_fault(*cases.make(number))
            if finding and finding.key not in found:
                found.add(finding.key)
                faulthandler.dump_traceback_later(task.case_s + _SHRINKING_S, exit=True, file=log)
                messages.send(cases.shrink(finding))
            if monotonic() > end_s:
                break
        faulthandler.cancel_dump_traceback_later()
        messages.send(DONE)


class Cases:
    """Numbered cases of a task: the valid files, the earlier findings, then damaged files."""

    def __init__(self, task: Task) -> None:
        self._task, self._target = task, load(task.target)
        self._valid = list(self._target.starts().items())
        self._starts = self._valid + [
            (name, path.read_bytes()) for path, name in list_findings(task.corpus).items()
        ]

    def read_valid(self) -> None:
        """Read each valid file once."""
        for name, content in self._valid:
            self.find_fault(name, content)

    def make(self, number: int) -> tuple[str, bytes]:
        """Return the name and bytes of a case, which depend only on its number, the seed and the corpus."""
        if number < len(self._starts):
            return self._starts[number]
        rng = Random(f"{self._task.seed} {self._task.target} {number}")
        name, content = rng.choice(self._starts)
        content = mutate(content, [other for _, other in self._starts], self._target.tokens, rng)
        return name, self._target.repair(content) if rng.random() < 0.5 else content

    def find_fault(self, name: str, content: bytes) -> Finding | None:
        """Read a file. Return the finding, or None if the file is read or properly refused."""
        path = self._task.folder / CASE / name
        path.parent.mkdir(exist_ok=True)
        for other in path.parent.iterdir():
            other.unlink()
        path.write_bytes(content)
        try:
            with warnings.catch_warnings(action="error"):
                self._target.read(path)
        except StereoweaveError:
            return None
        except BaseException as error:  # any error at all
            return Finding.from_error(error, name, content)
        return None

    def shrink(self, finding: Finding) -> Finding:
        """Return the finding with its content reduced as far as possible within two seconds."""

        def fails_alike(content: bytes) -> bool:
            fault = self.find_fault(finding.name, content)
            return fault is not None and fault.key == finding.key

        return replace(finding, content=shrink(finding.content, fails_alike, _SHRINKING_S))


def _limit_memory() -> None:
    """Limit the memory of this process to 2 GB more than it uses now, and disable core dumps."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + _MORE_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
