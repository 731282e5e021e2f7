"""An orderly end of a command that is stopped by Ctrl-C, SIGTERM or SIGHUP."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

import typer

_INTERRUPTED = 128 + signal.SIGINT


@contextmanager
def stopping_orderly() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block as Ctrl-C does, so that it removes its temporary files.

    The block may catch KeyboardInterrupt, say that it was stopped, and exit with status 130; if it does not,
    "stopped" is said here. The exit status is 128 plus the signal's number.
    """
    received: list[int] = []

    def stop(number: int, _: FrameType | None) -> None:
        if not received:  # a second signal must not interrupt the removal of files
            received.append(number)
            raise KeyboardInterrupt

    handled = [number for number in _find_signals() if signal.getsignal(number) is signal.SIG_DFL]
    for number in handled:
        signal.signal(number, stop)
    try:
        yield
    except KeyboardInterrupt:
        typer.echo("stereoweave: stopped", err=True)
        raise typer.Exit(128 + received[0] if received else _INTERRUPTED) from None
    except typer.Exit as end:
        if received and end.exit_code == _INTERRUPTED:
            raise typer.Exit(128 + received[0]) from None
        raise
    finally:
        for number in handled:
            if signal.getsignal(number) is stop:  # the block may have installed its own
                signal.signal(number, signal.SIG_DFL)


def _find_signals() -> list[signal.Signals]:
    """Return the signals to handle: none outside the main thread, and none in a distributed training.

    There, a process may wait for the others in a library that runs no handlers.
    """
    if threading.current_thread() is not threading.main_thread() or "RANK" in os.environ:
        return []
    names = ("SIGTERM", "SIGHUP")  # Windows has no SIGHUP
    return [getattr(signal, name) for name in names if hasattr(signal, name)]
