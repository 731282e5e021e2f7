"""Steps of a long job, announced to whoever shows them, such as a command or the page.

Functions announce their steps by `step` and do not know who shows them. By default, nobody does.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass


@dataclass
class Step:
    """A step under way.

    Attributes:
        name: What is being done, such as "matching".
        done: Number of finished parts.
        total: Number of all parts; None if unknown.
    """

    name: str
    done: int = 0
    total: int | None = None


Listener = Callable[[Step | None], None]
"""Function that is called with the innermost step whenever it changes, and with None after the last one."""


class _Announcer:
    """The steps under way, innermost last, and the function that is told about them.

    Several threads may announce steps. The listener is called by one of them at a time.
    """

    def __init__(self, listener: Listener) -> None:
        self._listener, self._steps = listener, list[Step]()
        self._lock = threading.RLock()

    def begin(self, step: Step) -> None:
        with self._lock:
            self._steps.append(step)
            self._tell()

    def advance(self, step: Step, parts: int) -> None:
        with self._lock:
            step.done += parts
            self._tell()

    def end(self, step: Step) -> None:
        with self._lock:
            # Not always the last one, because of other threads.
            self._steps = [other for other in self._steps if other is not step]
            self._tell()

    def _tell(self) -> None:
        self._listener(self._steps[-1] if self._steps else None)


_announcer: ContextVar[_Announcer | None] = ContextVar("who is told about steps", default=None)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Tell `listener` about the steps within the block. An error that it raises ends the job."""
    token = _announcer.set(_Announcer(listener))
    try:
        yield
    finally:
        _announcer.reset(token)


@contextmanager
def step(name: str, total: int | None = None) -> Iterator[Callable[[int], None]]:
    """Announce a step for the duration of the block, or of the function that it decorates.

    Yields a function to call with the number of parts that were finished since the last call.
    """
    announcer = _announcer.get()
    if announcer is None:
        yield lambda parts: None
        return
    begun = Step(name, total=total)
    announcer.begin(begun)
    try:
        yield lambda parts: announcer.advance(begun, parts)
    finally:
        announcer.end(begun)
