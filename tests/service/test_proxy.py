"""The shipped nginx configuration, in front of an application that records the requests that reach it."""

import os
import shutil
import socket
import ssl
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import httpx
import pytest
from other_processes import find_free_ports

from stereoweave.service.server import ClientTimeouts, run_http_server

pytestmark = [pytest.mark.system, pytest.mark.needs_nginx]

CONFIGURATION = Path(__file__).parents[2] / "deploy" / "nginx.conf"
NAME = "depth.example.org"
REACHED: list[tuple[str, str, int]] = []


async def app(scope, receive, send) -> None:
    """Answer every request, and record its path, its host and the length of its body."""
    if scope["type"] != "http":
        return
    length, more = 0, True
    while more:
        message = await receive()
        length, more = length + len(message["body"]), message["more_body"]
    REACHED.append((scope["path"], dict(scope["headers"])[b"host"].decode(), length))
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"4")]})
    await send({"type": "http.response.body", "body": b"done"})


@pytest.fixture(scope="module")
def certificate(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("certificate")
    command = [
        "openssl",
        "req",
        "-x509",
        "-newkey",
        "ec",
        "-pkeyopt",
        "ec_paramgen_curve:prime256v1",
        "-nodes",
    ]
    command += ["-subj", f"/CN={NAME}", "-addext", f"subjectAltName=DNS:{NAME}"]
    command += ["-keyout", f"{folder}/{NAME}.key", "-out", f"{folder}/{NAME}.crt"]
    subprocess.run(command, check=True, capture_output=True)
    return folder / f"{NAME}.crt"


@pytest.fixture(scope="module")
def port(tmp_path_factory, certificate) -> Iterator[int]:
    """Yield the port of an nginx that waits for a minute, longer than a busy machine takes."""
    with run_nginx(tmp_path_factory.mktemp("nginx"), certificate, timeout_s=60) as port:
        yield port


@pytest.fixture(scope="module")
def impatient_port(tmp_path_factory, certificate) -> Iterator[int]:
    """Yield the port of an nginx that waits for a second, so that a test need not wait longer."""
    with run_nginx(tmp_path_factory.mktemp("impatient"), certificate, timeout_s=1) as port:
        yield port


@contextmanager
def run_nginx(folder: Path, certificate: Path, timeout_s: int) -> Iterator[int]:
    """Run nginx with the shipped configuration, except for paths, ports and timeouts. Yields its port."""
    with socket.create_server(("127.0.0.1", 0)) as listener, run_http_server(app, listener, ClientTimeouts()):
        (port,) = find_free_ports(1)
        places = {
            "listen 443": f"listen 127.0.0.1:{port}",
            "127.0.0.1:8000": f"127.0.0.1:{listener.getsockname()[1]}",
            "/etc/nginx": str(certificate.parent),
            "timeout 10s": f"timeout {timeout_s}s",
        }
        (folder / "nginx.conf").write_text(configuration(folder, places))
        nginx = shutil.which("nginx", path=f"{os.environ['PATH']}:/usr/sbin")
        command = [nginx, "-p", str(folder), "-c", "nginx.conf", "-e", str(folder / "errors")]
        process = subprocess.Popen(command)
        try:
            wait_for(port)
            yield port
        finally:
            process.terminate()
            assert process.wait(10) == 0


def configuration(folder: Path, places: dict[str, str]) -> str:
    """Return a complete configuration: the shipped one with replacements, in a separate folder."""
    shipped = CONFIGURATION.read_text()
    for there, here in places.items():
        assert there in shipped
        shipped = shipped.replace(there, here)
    user = "user root;" if os.geteuid() == 0 else ""  # otherwise the workers cannot write to the folder
    kinds = ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    paths = "".join(f"{kind}_temp_path {folder}/{kind};\n" for kind in kinds)
    return f"daemon off; {user} pid {folder}/pid; events {{}}\nhttp {{ access_log off;\n{paths}{shipped}}}\n"


def wait_for(port: int) -> None:
    deadline_s = time.monotonic() + 10
    while True:
        try:
            return socket.create_connection(("127.0.0.1", port)).close()
        except ConnectionRefusedError:
            assert time.monotonic() < deadline_s
            time.sleep(0.05)


@pytest.fixture
def client(port, certificate) -> Iterator[httpx.Client]:
    trusted = ssl.create_default_context(cafile=str(certificate))
    with httpx.Client(base_url=f"https://127.0.0.1:{port}", verify=trusted, timeout=20) as client:
        yield client


def ask(client: httpx.Client, method: str, path: str, **options) -> httpx.Response:
    """Send a request with the certificate's host name, and return the response."""
    return client.request(method, path, headers={"Host": NAME}, extensions={"sni_hostname": NAME}, **options)


def connect(port: int, certificate: Path, name: str = NAME) -> ssl.SSLSocket:
    trusted = ssl.create_default_context(cafile=str(certificate))
    connection = socket.create_connection(("127.0.0.1", port), timeout=20)
    return trusted.wrap_socket(connection, server_hostname=name)


def test_a_whole_form_reaches_the_service_with_the_services_own_host_name(client):
    assert ask(client, "POST", "/disparity", content=bytes(3_000_000)).text == "done"
    path, host, length = REACHED[-1]
    assert (path, length) == ("/disparity", 3_000_000)
    assert host.startswith("127.0.0.1:")


def test_a_body_that_is_too_large_does_not_reach_the_service(client):
    reached = len(REACHED)
    assert ask(client, "POST", "/view", content=bytes(64 * 2**20 + 1)).status_code == 413
    assert len(REACHED) == reached


def test_metrics_are_not_public(client):
    assert ask(client, "GET", "/metrics").status_code == 404
    assert ask(client, "GET", "/health").status_code == 200


def test_endless_headers_are_refused_and_do_not_reach_the_service(port, certificate):
    reached = len(REACHED)
    with connect(port, certificate) as connection:
        connection.sendall(f"GET /health HTTP/1.1\r\nHost: {NAME}\r\nX: ".encode())
        for _ in range(1000):
            connection.sendall(b"a" * 64_000)
        assert b" 400 " in connection.recv(1000).splitlines()[0]
    assert len(REACHED) == reached


@pytest.mark.parametrize(
    "begun",
    ["GET /health HTTP/1.1\r\nX: ", f"POST /view HTTP/1.1\r\nHost: {NAME}\r\nContent-Length: 99\r\n\r\nx"],
)
def test_an_incomplete_request_is_closed_and_does_not_reach_the_service(impatient_port, certificate, begun):
    reached = len(REACHED)
    with connect(impatient_port, certificate) as connection:
        connection.sendall(begun.encode())
        try:
            answer = connection.recv(1000)
        except OSError:
            answer = b""
    assert not answer or b" 408 " in answer.splitlines()[0]
    assert len(REACHED) == reached


def test_a_request_for_another_host_name_gets_no_answer(port, certificate):
    with pytest.raises(ssl.SSLError):
        connect(port, certificate, "evil.example")


def test_one_address_may_not_take_all_connections(port, certificate):
    connections = [connect(port, certificate) for _ in range(12)]
    try:
        for connection in connections:
            connection.sendall(f"POST /depth HTTP/1.1\r\nHost: {NAME}\r\nContent-Length: 9\r\n\r\nx".encode())
        answers = receive_answers(connections, 2)
        assert len(answers) >= 2
        assert all(b" 503 " in answer.splitlines()[0] for answer in answers)
    finally:
        for connection in connections:
            connection.close()


def receive_answers(connections: list[ssl.SSLSocket], count: int) -> list[bytes]:
    """Return the first answers on any connections, `count` or more if they arrive within 20 s."""
    answers: dict[ssl.SSLSocket, bytes] = {}
    deadline_s = time.monotonic() + 20
    while len(answers) < count and time.monotonic() < deadline_s:
        for connection in set(connections) - set(answers):
            connection.settimeout(0.01)
            with suppress(TimeoutError):
                answers[connection] = connection.recv(100)
    return list(answers.values())
