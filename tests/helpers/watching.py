"""A process beside the tests: it asks a service for its health, and measures its memory, until it is to end.

python watching.py URL PID writes in JSON how long each answer took, and the megabytes of all processes of the
service. It is a process of its own, because the tests themselves keep a Python interpreter busy.
"""

import json
import re
import sys
import threading
import time
from pathlib import Path

import httpx


def children(pid: int) -> list[int]:
    """The processes that a process has started, and those that these have."""
    tasks = Path(f"/proc/{pid}/task").glob("*/children")
    direct = [int(child) for task in tasks for child in task.read_text().split()]
    return direct + [child for each in direct for child in children(each)]


def proportional_megabytes(pid: int) -> float:
    """The memory of a process, in which what it shares with others counts in part; 0 where it has ended."""
    try:
        smaps = Path(f"/proc/{pid}/smaps_rollup").read_text()
    except OSError:
        return 0
    return int(re.search(r"^Pss: +(\d+) kB", smaps, re.MULTILINE)[1]) / 1000


def watch(url: str, pid: int) -> dict[str, list[float]]:
    ended = threading.Event()
    health_s, megabytes = [], []

    def measure() -> None:
        while not ended.wait(1):
            megabytes.append(sum(map(proportional_megabytes, [pid, *children(pid)])))

    def ask() -> None:
        alone = httpx.Limits(max_keepalive_connections=0)
        with httpx.Client(base_url=url, timeout=60, limits=alone) as client:
            while not ended.wait(0.05):
                start_s = time.monotonic()
                client.get("/health").raise_for_status()
                health_s.append(time.monotonic() - start_s)

    threads = [threading.Thread(target=work) for work in (measure, ask)]
    for thread in threads:
        thread.start()
    sys.stdin.read()
    ended.set()
    for thread in threads:
        thread.join()
    return {"health_s": health_s, "megabytes": megabytes}


if __name__ == "__main__":
    sys.stdout.write(json.dumps(watch(sys.argv[1], int(sys.argv[2]))))
