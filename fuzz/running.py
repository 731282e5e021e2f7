"""Fuzzing of one target: workers are watched, and replaced where they die."""

import multiprocessing
import signal
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic

from fuzz.findings import Finding
from fuzz.worker import CASE, DONE, LOG, Task, work


@dataclass(kw_only=True)
class Outcome:
    """What came of fuzzing a target.

    Attributes:
        target: Its name.
        cases: How many files were read.
        seconds: For how long, without what its processes took to start.
        findings: By their keys.
    """

    target: str
    cases: int = 0
    seconds: float = 0.0
    findings: dict[str, Finding] = field(default_factory=dict)

    def add(self, finding: Finding) -> None:
        """Keeps the first finding of each fault."""
        self.findings.setdefault(finding.key, finding)


def fuzz(target: str, seed: int, seconds: float, corpus: Path, case_s: float = 10.0) -> Outcome:
    """Reads damaged files of a target for some seconds.

    Raises:
        RuntimeError: The fuzzer itself failed: what it said.
    """
    outcome = Outcome(target=target)
    with TemporaryDirectory(prefix="fuzz-") as folder:
        task = Task(
            target=target, seed=seed, seconds=seconds, case_s=case_s, corpus=corpus, folder=Path(folder)
        )
        while outcome.seconds < seconds:
            _run(replace(task, seconds=seconds - outcome.seconds), outcome)
    return outcome


def _run(task: Task, outcome: Outcome) -> None:
    """Lets one worker go on with the cases, until it is done or dies, and adds what came of it."""
    context = multiprocessing.get_context("spawn")  # a fork would share this process's threads
    messages, sender = context.Pipe(duplex=False)
    worker = context.Process(
        target=work, args=(task, outcome.cases, list(outcome.findings), sender), daemon=True
    )
    worker.start()
    sender.close()
    before = outcome.cases
    is_done = _listen(messages, outcome)
    worker.join()
    if is_done:
        return
    log, code = (task.folder / LOG).read_text(errors="replace"), worker.exitcode or 0
    if outcome.cases == before or (code >= 0 and "Timeout (" not in log):
        raise RuntimeError(f"{task.target}: the fuzzer itself failed:\n{log}")
    outcome.add(_finding_of_death(code, log, task.folder / CASE))


def _listen(messages: Connection, outcome: Outcome) -> bool:
    """Adds what a worker sends; whether it was done before its end."""
    start_s = monotonic()
    try:
        while (message := messages.recv()) != DONE:
            match message:
                case Finding():
                    outcome.add(message)
                case int():
                    outcome.cases += 1
                case _:  # READY: what is loaded before the first case does not count
                    start_s = monotonic()
    except EOFError:
        return False
    finally:
        outcome.seconds += monotonic() - start_s
    return True


def _finding_of_death(code: int, log: str, folder: Path) -> Finding:
    """The finding that the end of a worker is: by a signal, or by its own watch over a case's time."""
    what = signal.Signals(-code).name if code < 0 else "hang"
    (case,) = folder.iterdir()
    return Finding.of_death(what, log, case.name, case.read_bytes())
