"""Fuzzing of one target by worker processes, which are replaced when they die."""

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
    """Result of fuzzing a target.

    Attributes:
        target: Name of the target.
        cases: Number of files read.
        seconds: Time spent, without the start of processes.
        findings: Findings by their keys.
    """

    target: str
    cases: int = 0
    seconds: float = 0.0
    findings: dict[str, Finding] = field(default_factory=dict)

    def add(self, finding: Finding) -> None:
        """Add a finding unless its fault is known."""
        self.findings.setdefault(finding.key, finding)


def fuzz(target: str, seed: int, seconds: float, corpus: Path, case_s: float = 10.0) -> Outcome:
    """Read damaged files of a target for a number of seconds.

    Raises:
        RuntimeError: The fuzzer itself failed; the message contains its log.
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
    """Run one worker until it is done or dies, and add its cases and findings to the outcome."""
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
    outcome.add(_make_finding_of_death(code, log, task.folder / CASE))


def _listen(messages: Connection, outcome: Outcome) -> bool:
    """Add a worker's messages to the outcome. Return whether it finished before it ended."""
    start_s = monotonic()
    try:
        while (message := messages.recv()) != DONE:
            match message:
                case Finding():
                    outcome.add(message)
                case int():
                    outcome.cases += 1
                case _:  # READY: the time to load does not count
                    start_s = monotonic()
    except EOFError:
        return False
    finally:
        outcome.seconds += monotonic() - start_s
    return True


def _make_finding_of_death(code: int, log: str, folder: Path) -> Finding:
    """Make a finding of a worker's end, by a signal or by its own time limit for a case."""
    what = signal.Signals(-code).name if code < 0 else "hang"
    (case,) = folder.iterdir()
    return Finding.from_death(what, log, case.name, case.read_bytes())
