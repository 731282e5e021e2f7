"""Nothing is sent to other computers: strace records the connections of estimate, page, service and batch."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from ipaddress import IPv6Address, ip_address
from pathlib import Path

import grpc
import httpx
import psutil
import pytest
from other_processes import UNMEASURED, halted, list_listeners
from visitor import Visitor

from stereoweave.io.images import read_image, write_image

TEXTURED = Path(__file__).resolve().parent / "textured_pair"
PAIR = {side: TEXTURED / f"{side}.png" for side in ("left", "right")}
# ONNX Runtime looks up the address for its reports after about ten seconds.
ALIVE_S = 20
STRACE = ["strace", "-D", "-f", "-qq", "--seccomp-bpf", "-e", "trace=connect,sendto,sendmsg,sendmmsg"]
STEREOWEAVE = [sys.executable, "-m", "stereoweave"]
ESTIMATING = """
import time
import stereoweave as sw
from stereoweave.io.images import read_image
left, right = (read_image(f"{folder}/{side}.png")[:96, 200:328] for side in ("left", "right"))
sw.estimate(left, right)
print("ready", flush=True)
while True:
    sw.estimate(left, right)
    time.sleep(0.5)
""".replace("{folder}", str(TEXTURED))
LOOKING_UP = "import socket; socket.getaddrinfo('stereoweave.invalid', 443)"
CALLING_ITSELF = """
import socket
with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()):
    socket.getaddrinfo("localhost", 443)
"""
# Addresses as strace writes them; within the data of a call, it escapes quotation marks.
ADDRESS = re.compile(r'port=htons\((\d+)\).*?(?:inet_addr\(|inet_pton\(AF_INET6, )"([^"]+)"')
RESOLVER = re.compile(r'sun_path="[^"]*systemd/resolve')
DNS_PORT = 53

pytestmark = [pytest.mark.system, pytest.mark.needs_strace]


def is_outside(line: str) -> bool:
    """Return whether a line of strace is a DNS query, or connects to an address other than loopback."""
    called = ADDRESS.findall(line)
    elsewhere = [address for port, address in called if int(port) == DNS_PORT or not is_loopback(address)]
    return bool(elsewhere or RESOLVER.search(line))


def is_loopback(address: str) -> bool:
    found = ip_address(address)
    mapped = found.ipv4_mapped if isinstance(found, IPv6Address) else None
    return (mapped or found).is_loopback


def calls_outside(trace: Path) -> list[str]:
    lines = trace.read_text().splitlines()
    assert lines  # strace worked
    return [line for line in lines if is_outside(line)]


class Watched:
    """A program under strace, started without any environment variables of the tests."""

    def __init__(self, command: Sequence[str], trace: Path) -> None:
        self.trace = trace
        set_by_tests = ("ORT_", "GRADIO_", "HF_", "RAY_")
        kept = {name: value for name, value in os.environ.items() if not name.startswith(set_by_tests)}
        self.process = subprocess.Popen(
            [*STRACE, "-o", str(trace), *command],
            stdout=subprocess.PIPE,
            text=True,
            # The paths of Ray's sockets must be short.
            env={**kept, **UNMEASURED, "RAY_TMPDIR": "/tmp", "PYTHONUNBUFFERED": "1"},
        )

    def wait_for(self, pattern: str) -> str:
        """Return the first match in the lines that the program prints."""
        assert self.process.stdout
        found = (re.search(pattern, line) for line in self.process.stdout)
        return next(match[0] for match in found if match)

    def part(self, name: str) -> psutil.Process:
        """Return the process of this name among all that the program started."""
        for process in psutil.Process(self.process.pid).children(recursive=True):
            with suppress(psutil.NoSuchProcess):
                if name in " ".join(process.cmdline()):
                    return process
        raise LookupError(name)


@contextmanager
def watched(command: Sequence[str], trace: Path) -> Iterator[Watched]:
    """Run a program, which must not end before the block does; then end all its processes."""
    program = Watched(command, trace)
    try:
        yield program
        assert program.process.poll() is None
    finally:
        started = psutil.Process(program.process.pid).children(recursive=True)
        program.process.send_signal(signal.SIGTERM)
        program.process.communicate(timeout=60)
        for process in started:
            with suppress(psutil.NoSuchProcess):
                process.kill()


def write_small_pair(folder: Path) -> dict[str, Path]:
    """Write a crop of the example, for repeated requests. Returns its files."""
    folder.mkdir()
    small = {side: folder / path.name for side, path in PAIR.items()}
    for side, path in small.items():
        write_image(path, read_image(PAIR[side])[:96, 200:328])
    return small


def write_many_pairs(folder: Path) -> Path:
    """Write more pairs than a worker can process during the test."""
    for side, path in PAIR.items():
        (folder / side).mkdir(parents=True)
        for index in range(500):
            (folder / side / f"{index:03d}.png").symlink_to(path)
    return folder


@dataclass(frozen=True)
class Seen:
    """Connections to other computers by program, the page's printed address, listeners, and their answers."""

    outside: dict[str, list[str]]
    page: str
    listeners: dict[str, dict[tuple[str, int], str]]
    answers: dict[int, grpc.StatusCode]


@pytest.fixture(scope="module")
def seen(tmp_path_factory) -> Seen:
    """Run four programs at the same time and return their network activity."""
    folder = tmp_path_factory.mktemp("network")
    pairs, out = write_many_pairs(folder / "pairs"), folder / "out"
    commands = {
        "estimate": [sys.executable, "-c", ESTIMATING],
        "page": [*STEREOWEAVE, "app", "--host", "127.1", "--port", "0"],
        "service": [*STEREOWEAVE, "serve", "--port", "0", "--threads", "1"],
        "batch": [*STEREOWEAVE, "batch", str(pairs), str(out), "--workers", "1"],
    }
    with ExitStack() as stack:
        programs = {
            name: stack.enter_context(watched(command, folder / name)) for name, command in commands.items()
        }
        programs["estimate"].wait_for("ready")
        page, service = (programs[name].wait_for(r"http://[\d.:]+") for name in ("page", "service"))
        while not list(out.glob("*/disparity.pfm")):
            assert programs["batch"].process.poll() is None
            time.sleep(0.1)
        small = write_small_pair(folder / "small")
        with httpx.Client(base_url=page, timeout=60) as client:
            with halted(programs["batch"].part("MapWorker")):  # it would keep a core busy
                ask_for(0.8 * ALIVE_S, Visitor(client), service, small)
            ask_for(0.2 * ALIVE_S, Visitor(client), service, small)
        listeners = {name: list_listeners(programs[name].process.pid) for name in ("page", "service")}
        opened = [port for address, port in listeners["service"] if not is_loopback(address)]
        answers = {port: ask_without_token(port) for port in opened}
    outside = {name: calls_outside(program.trace) for name, program in programs.items()}
    return Seen(outside, page, listeners, answers)


def ask_for(seconds: float, visitor: Visitor, service: str, pair: dict[str, Path]) -> None:
    """Send requests to the page and the service for some seconds."""
    files = {side: path.read_bytes() for side, path in pair.items()}
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        assert "far:" in visitor.press("find", **pair)
        httpx.post(f"{service}/disparity", files=files, timeout=60).raise_for_status()
        httpx.get(f"{service}/metrics").raise_for_status()
        time.sleep(2)


def ask_without_token(port: int) -> grpc.StatusCode:
    """Return the status with which a replica of Ray Serve answers a call without the cluster's token."""
    with grpc.insecure_channel(f"127.0.0.1:{port}") as channel, pytest.raises(grpc.RpcError) as refused:
        channel.unary_unary("/ray.serve.ASGIService/HandleRequest")(b"", timeout=10)
    return refused.value.code()


@pytest.mark.parametrize("program", ["estimate", "page", "service", "batch"])
def test_a_program_makes_no_dns_query_and_connects_only_to_this_computer(seen, program):
    assert seen.outside[program] == []


def test_the_page_listens_on_the_address_that_its_command_prints(seen):
    name, port = seen.page.removeprefix("http://").split(":")
    assert name == "127.1"  # as given by --host
    assert list(seen.listeners["page"]) == [("127.0.0.1", int(port))]


def test_a_dns_query_is_detected_and_a_connection_to_this_computer_is_not(tmp_path):
    outside = {}
    for name, program in {"look-up": LOOKING_UP, "itself": CALLING_ITSELF}.items():
        command = [*STRACE, "-o", str(tmp_path / name), sys.executable, "-c", program]
        subprocess.run(command, stderr=subprocess.DEVNULL, check=False)
        outside[name] = calls_outside(tmp_path / name)
    assert outside["look-up"]
    assert outside["itself"] == []


def test_the_service_listens_on_loopback_but_for_one_port_that_wants_the_token(seen):
    listeners = seen.listeners["service"]
    assert len(listeners) > 10
    (opened,) = [name for (address, _), name in listeners.items() if not is_loopback(address)]
    assert opened.startswith("ray::ServeReplica")
    assert list(seen.answers.values()) == [grpc.StatusCode.UNAUTHENTICATED]
