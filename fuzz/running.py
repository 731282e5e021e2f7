"""Fuzzing of one target in worker processes, each of which is replaced if it dies."""

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
        seconds: Time spent, excluding the start of processes.
        findings: Findings by key.
    """

    target: str
    cases: int = 0
    seconds: float = 0.0
    findings: dict[str, Finding] = field(default_factory=dict)

    def add(self, finding: Finding) -> None:
        """Add a finding unless one with the same key is known."""
        self.findings.setdefault(finding.key, finding)


def fuzz(target: str, seed: int, seconds: float, corpus: Path, case_s: float = 10.0) -> Outcome:
    """Read damaged files of a target for a number of seconds and return the outcome.

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
    """Run one worker until it finishes or dies, and add its cases and findings to the outcome."""
    context = multiprocessing.get_context("spawn")  # a fork would inherit locks held by threads
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
    """Add the messages of a worker to the outcome. Return whether the worker finished its task."""
    start_s = monotonic()
    try:
        while (message := messages.recv()) != DONE:
            match message:
                case Finding():
                    outcome.add(message)
                case int():
                    outcome.cases += 1
                case _:  # READY: loading time does not count
                    start_s = monotonic()
    except EOFError:
        return False
    finally:
        outcome.seconds += monotonic() - start_s
    return True


def _make_finding_of_death(code: int, log: str, folder: Path) -> Finding:
    """Return the finding for a worker that was killed by a signal or by its own time limit for a case."""
    what = signal.Signals(-code).name if code < 0 else "hang"
    (case,) = folder.iterdir()
    return Finding.from_death(what, log, case.name, case.read_bytes())
