"""A process that reads damaged files of one target, until its time is over or it dies."""

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

from fuzz.findings import Finding, kept, shrunk
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
    """What a worker does.

    Attributes:
        target: As `targets.load` takes it.
        seed: Of all draws.
        seconds: How long, from its first case on.
        case_s: How long a case may take.
        corpus: The folder of the target's earlier findings.
        folder: Its own: the file at hand, and what is written as it dies.
    """

    target: str
    seed: int
    seconds: float
    case_s: float
    corpus: Path
    folder: Path


def work(task: Task, first: int, known: Sequence[str], messages: Connection) -> None:
    """Reads cases from number `first` on.

    Sends READY, the number of each case before it is read, each Finding whose key is not known, and DONE.
    """
    begin_work(threads=1)
    with (task.folder / LOG).open("ab") as log, Path(os.devnull).open("wb") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(log.fileno(), 2)
        faulthandler.enable(log)
        faulthandler.dump_traceback_later(_STARTING_S, exit=True, file=log)
        cases = Cases(task)
        cases.read_valid()  # loads and compiles what is used later
        _limit_memory()
        messages.send(READY)
        end_s, found = monotonic() + task.seconds, set(known)
        for number in count(first):
            os.ftruncate(log.fileno(), 0)
            faulthandler.dump_traceback_later(task.case_s, exit=True, file=log)
            messages.send(number)
            finding = cases.fault(*cases.make(number))
            if finding and finding.key not in found:
                found.add(finding.key)
                faulthandler.dump_traceback_later(task.case_s + _SHRINKING_S, exit=True, file=log)
                messages.send(cases.smallest(finding))
            if monotonic() > end_s:
                break
        faulthandler.cancel_dump_traceback_later()
        messages.send(DONE)


class Cases:
    """The cases of a task by number: the start files as they are, earlier findings, and then damaged ones."""

    def __init__(self, task: Task) -> None:
        self._task, self._target = task, load(task.target)
        self._valid = list(self._target.starts().items())
        self._starts = self._valid + [(name, path.read_bytes()) for path, name in kept(task.corpus).items()]

    def read_valid(self) -> None:
        """Reads each file that was made by rule."""
        for name, content in self._valid:
            self.fault(name, content)

    def make(self, number: int) -> tuple[str, bytes]:
        """The name and the bytes of a case; they depend on its number, the seed and the corpus alone."""
        if number < len(self._starts):
            return self._starts[number]
        rng = Random(f"{self._task.seed} {self._task.target} {number}")
        name, content = rng.choice(self._starts)
        content = mutate(content, [other for _, other in self._starts], self._target.tokens, rng)
        return name, self._target.repair(content) if rng.random() < 0.5 else content

    def fault(self, name: str, content: bytes) -> Finding | None:
        """What is wrong with how a file is read; None where nothing is."""
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
        except BaseException as error:  # whatever it is
            return Finding.of_error(error, name, content)
        return None

    def smallest(self, finding: Finding) -> Finding:
        """The finding with as little content as could be found in two seconds."""

        def fails_alike(content: bytes) -> bool:
            fault = self.fault(finding.name, content)
            return fault is not None and fault.key == finding.key

        return replace(finding, content=shrunk(finding.content, fails_alike, _SHRINKING_S))


def _limit_memory() -> None:
    """From now on what takes 2 GB more than this process has fails; and a crash writes no core."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + _MORE_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
