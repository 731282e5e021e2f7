"""Times of a command's first run on a machine, and of the next one."""

import os
import pty
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from stereoweave.errors import StereoweaveError

_ERASE_LINE = b"\x1b[2K"
COMMANDS = {"depth": ["--out", "depth"], "view": ["--out", "view.png"]}


@dataclass(frozen=True, kw_only=True)
class FirstRunRow:
    """Times of one command, in seconds; each is the least of several runs.

    Attributes:
        command: Name of the command.
        run: "first", without compiled kernels, or "next".
        first_word_s: Time until the terminal shows something.
        wall_s: Time until the command ends.
        processor_s: Processor time of the command and of the processes that it starts. Unlike the others, it
            hardly depends on other work on the machine.
        turns: Number of runs.
    """

    command: str
    run: str
    first_word_s: float
    wall_s: float
    processor_s: float
    turns: int


def measure_first_runs(left: Path, right: Path, turns: int) -> list[FirstRunRow]:
    """Run each command on a pair, twice in each turn: with an empty folder of kernels, and once more."""
    pictures = [str(picture.absolute()) for picture in (left, right)]
    return [
        row
        for command, options in COMMANDS.items()
        for row in _measure(command, [*pictures, *options], turns)
    ]


def _measure(command: str, arguments: Sequence[str], turns: int) -> list[FirstRunRow]:
    runs: dict[str, list[tuple[float, float, float]]] = {"first": [], "next": []}
    for _ in range(turns):
        with tempfile.TemporaryDirectory() as folder:
            for run in runs:
                runs[run].append(_time([command, *arguments], Path(folder)))
    return [
        FirstRunRow(
            command=command,
            run=run,
            first_word_s=min(first_word_s for first_word_s, _, _ in times),
            wall_s=min(wall_s for _, wall_s, _ in times),
            processor_s=min(processor_s for _, _, processor_s in times),
            turns=turns,
        )
        for run, times in runs.items()
    ]


def _time(arguments: Sequence[str], folder: Path) -> tuple[float, float, float]:
    """Run a command in a terminal; return the times to its first word and to its end, and processor time."""
    ours, its = pty.openpty()
    paths = {
        "NUMBA_CACHE_DIR": str(folder / "kernels"),
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
    }
    before_s, start_s = _processor_s(), time.perf_counter()
    with subprocess.Popen(
        [sys.executable, "-m", "stereoweave", *arguments],
        cwd=folder,
        env=os.environ | paths | {"TERM": "xterm"},
        stdout=subprocess.DEVNULL,
        stderr=its,
    ) as running:
        os.close(its)
        said = _read(ours)
        first_word_s = time.perf_counter() - start_s
        while more := _read(ours):
            said += more
    os.close(ours)
    if running.returncode:
        _, _, message = said.rpartition(_ERASE_LINE)  # the step comes before
        raise StereoweaveError(
            f"expected exit code 0, found {running.returncode}: {message.decode().strip()}"
        )
    return first_word_s, time.perf_counter() - start_s, _processor_s() - before_s


def _read(terminal: int) -> bytes:
    """Return what a terminal got since the last call; nothing once all its processes have ended."""
    try:
        return os.read(terminal, 4096)
    except OSError:  # on Linux
        return b""


def _processor_s() -> float:
    """Return the processor time of all processes that this one has started and that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
