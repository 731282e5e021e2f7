"""Monitor a service's response time and memory in a separate process until stopped.

`python watching.py URL PID` writes the time of each health check, and the memory in MB of all processes of
the service, as JSON. The process is separate, because the tests keep their own interpreter busy.
"""

import json
import re
import sys
import threading
import time
from pathlib import Path

import httpx
from other_processes import list_processes


def measure_megabytes(pid: int) -> float:
    """Return the memory of a process, with its proportional share of shared memory; 0 if it has ended."""
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
            megabytes.append(sum(map(measure_megabytes, list_processes(pid))))

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
