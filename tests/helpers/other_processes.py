"""Helpers for other processes and for ports."""

import signal
import socket
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil

# Environment of processes whose coverage is not measured: of killed ones, which do not write it, and of
# those that run what other tests measure. For what it costs, see `tracing`.
UNMEASURED = {"COVERAGE_PROCESS_CONFIG": ""}
# Python's options to run the command `stereoweave` in a process that is measured, but not its children: it
# has started the tracer before it empties the variable.
MEASURED_ALONE = [
    "-c",
    f"import os, sys; os.environ.update({UNMEASURED}); "
    "from stereoweave.cli.root import main; sys.exit(main(sys.argv[1:]))",
]


@contextmanager
def halted(process: subprocess.Popen[Any] | psutil.Process) -> Iterator[None]:
    """Halt a process during the block; it keeps its resources."""
    process.send_signal(signal.SIGSTOP)
    try:
        yield
    finally:
        process.send_signal(signal.SIGCONT)


def list_processes(process: int) -> list[int]:
    """Return the process and all its descendants."""
    parents = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            parents[int(stat.parent.name)] = int(stat.read_text().rpartition(")")[2].split()[1])
    found = [process]
    for parent in found:
        found += [child for child, its_parent in parents.items() if its_parent == parent]
    return found


def list_listeners(process: int) -> dict[tuple[str, int], str]:
    """Return the addresses on which the process and its descendants listen, with the processes' names."""
    found = {}
    for pid in list_processes(process):
        with suppress(psutil.NoSuchProcess):
            each = psutil.Process(pid)
            for connection in each.net_connections("tcp"):
                if connection.status == psutil.CONN_LISTEN:
                    found[tuple(connection.laddr)] = each.name()
    return found


def find_free_ports(count: int) -> list[int]:
    """Return unused ports of this machine."""
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for taken in sockets:
            taken.bind(("127.0.0.1", 0))
        return [taken.getsockname()[1] for taken in sockets]
