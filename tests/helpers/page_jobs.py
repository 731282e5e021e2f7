"""Work for the page's processes."""

import os
import time

from stereoweave.app.workers import Report


def name_process(report: Report) -> int:
    """Return the process that does the work."""
    return os.getpid()


def fail(text: str, report: Report) -> None:
    """Raise an error."""
    raise ValueError(text)


def wait_forever(report: Report) -> None:
    """Report half of the work as done, and the process that does it; then wait."""
    report(0.5, str(os.getpid()))
    time.sleep(3600)
