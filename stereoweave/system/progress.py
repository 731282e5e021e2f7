"""Progress shown in a terminal: the number of finished items, or the step of a command."""

import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from stereoweave.system.steps import Step, listening

# A bar that appears and vanishes at once is only restless.
_BAR_AFTER_S = 1.0
# In a log, a step has a line once it has lasted for a while, and there is at most one line in a second.
_LINE_AFTER_S, _LINE_EVERY_S = 0.1, 1.0
# The start and the opening of the input have no line, so that an error in the input stays the only line.
_EARLY_STEPS = 2


def progress(console: Console) -> Progress:
    """Return a progress bar that stays; its tasks must have the fields `loss` and `rate`.

    It continues the line of `show_steps`: the description at once, and the rest a second after the command's
    start.
    """
    start_s = time.monotonic()
    if display := _display.get():
        start_s = display.start_s
        display.close()  # a terminal has room for one of them
    fields = TextColumn("{task.fields[loss]} {task.fields[rate]}")
    late = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), fields)
    return Progress(_name_column(), *(_Late(column, start_s) for column in late), console=console)


@contextmanager
def show_steps() -> Iterator[None]:
    """Show on stderr the steps (`steps.step`) of the block.

    In a terminal: a line at once, and a bar after a second; both vanish after the last step. Elsewhere, such
    as in a log: a plain line for each step that takes long. Nothing in a distributed run, but in its first
    process.
    """
    if os.environ.get("RANK", "0") != "0":
        yield
        return
    console = Console(stderr=True)
    display = _Line(console) if console.is_terminal and not console.is_dumb_terminal else _Lines(console)
    token = _display.set(display)
    try:
        display(Step("starting"))
        with listening(display):
            yield
    finally:
        display.close()
        _display.reset(token)


def format_duration(seconds: float) -> str:
    """Format a duration, rounded as befits an estimate."""
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{seconds / 3600:.1f} h"


class _Line:
    """A line in a terminal that shows the current step; a listener."""

    def __init__(self, console: Console) -> None:
        self._console, self.start_s = console, time.monotonic()
        self._bar: Progress | None = None

    def __call__(self, step: Step | None) -> None:
        """Show a step; None removes the line."""
        if step is None:
            self.close()
            return
        if self._bar is None:
            self._bar = self._open()
            self._bar.add_task(step.name, total=step.total)
            self._bar.start()
        (task,) = self._bar.task_ids
        self._bar.update(task, description=step.name, total=step.total, completed=step.done)

    def close(self) -> None:
        """Remove the line."""
        if self._bar is not None:
            self._bar.stop()
        self._bar = None

    def _open(self) -> Progress:
        return Progress(
            _name_column(),
            _Late(BarColumn(), self.start_s),
            console=self._console,
            transient=True,
            # The command's answer on stdout may go to a file: leave it alone, unless both are the terminal.
            redirect_stdout=sys.stdout.isatty(),
        )


def _name_column() -> ProgressColumn:
    return TextColumn("{task.description} …")


class _Late(ProgressColumn):
    """A column that is empty until a second after the start, or until the end."""

    def __init__(self, column: ProgressColumn, start_s: float) -> None:
        super().__init__()
        self._column, self._start_s = column, start_s

    def render(self, task: Task) -> RenderableType:
        """Return the column, or nothing."""
        if time.monotonic() - self._start_s < _BAR_AFTER_S and not task.finished:
            return Text()
        return self._column.render(task)


class _Lines:
    """Plain lines, for logs; a listener."""

    def __init__(self, console: Console) -> None:
        self._console, self.start_s = console, time.monotonic()
        self._name = ""
        self._known = set[str]()
        self._printed_s = -_LINE_EVERY_S
        self._waiting: threading.Timer | None = None

    def __call__(self, step: Step | None) -> None:
        """Print a new step soon, unless it ends before."""
        name = step.name if step else ""
        if name == self._name:
            return
        self.close()
        self._name = name
        wanted = name not in self._known and len(self._known) >= _EARLY_STEPS
        self._known.add(name)
        if name and wanted:
            wait_s = max(self._printed_s + _LINE_EVERY_S - time.monotonic(), _LINE_AFTER_S)
            waiting = threading.Timer(wait_s, self._print, [name])
            waiting.daemon = True
            waiting.start()
            self._waiting = waiting

    def close(self) -> None:
        """Print no further line."""
        if self._waiting:
            self._waiting.cancel()
            self._waiting.join()

    def _print(self, name: str) -> None:
        self._console.print(f"{name} …", markup=False, highlight=False, soft_wrap=True)
        self._printed_s = time.monotonic()


_display: ContextVar[_Line | _Lines | None] = ContextVar("what shows the steps", default=None)
