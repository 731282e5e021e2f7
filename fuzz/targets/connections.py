"""Raw connections to the service's HTTP server, which runs a small application."""

import asyncio
import logging
import re
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from starlette.types import ASGIApp, Receive, Scope, Send

from fuzz.requests import ServerError, request_bytes
from fuzz.targets import Target
from stereoweave.errors import StereoweaveError
from stereoweave.service.server import ClientTimeouts, run_http_server

ANSWERED_S = 3.0
# The client stops sending after this time without data, so that later requests on the connection are answered
# too. The time is short, because a case may get no answer. On a busy machine, a valid request needs longer.
QUIET_S = 0.004
_WORK_S = 0.001
# Sent after each case. Its response comes after the application has finished its remaining work.
_PLAIN = b"GET /later HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n"
_STATUS = re.compile(rb"HTTP/1\.1 (\d{3}) ")
# Loggers that receive the exceptions that uvicorn and asyncio catch.
_LOGGERS = [logging.getLogger(name) for name in ("uvicorn.error", "asyncio")]


def talk(app: ASGIApp, content: bytes) -> list[int]:
    """Send bytes over a connection and return the status of every response.

    Raises:
        ServerError: A status is 500, or the server does not answer a plain request afterwards.
        BaseException: An error that the server or the application logged.
    """
    address = _address(app)
    with _collect_errors() as errors:
        statuses = _statuses(address, content, QUIET_S)
        after = _statuses(address, _PLAIN, ANSWERED_S)
    if errors:
        raise errors[0]
    if 500 in statuses or after != [200]:
        raise ServerError(f"statuses {statuses}, then {after} for a plain request")
    return statuses


def _statuses(address: tuple[str, int], content: bytes, quiet_s: float) -> list[int]:
    """Return the statuses of all responses; close the sending side after `quiet_s` without data."""
    received = bytearray()
    try:
        with socket.create_connection(address, timeout=ANSWERED_S) as connection:
            connection.sendall(content)
            connection.settimeout(quiet_s)
            with suppress(TimeoutError):
                _receive(connection, received)
            connection.shutdown(socket.SHUT_WR)
            connection.settimeout(ANSWERED_S)
            _receive(connection, received)
    except TimeoutError:
        raise
    except OSError:
        pass  # the server may close the connection at any time
    return [int(status) for status in _STATUS.findall(received)]


def _receive(connection: socket.socket, received: bytearray) -> None:
    while part := connection.recv(1 << 16):
        received += part


@contextmanager
def _collect_errors() -> Iterator[list[BaseException]]:
    """Collect the errors that are logged within the block instead of printing them."""
    errors: list[BaseException] = []

    def collect(record: logging.LogRecord) -> bool:
        error = record.exc_info[1] if record.exc_info else None
        if record.levelno >= logging.ERROR:
            errors.append(error or ServerError(record.getMessage()))
        return False

    levels = [logger.level for logger in _LOGGERS]
    for logger in _LOGGERS:
        logger.setLevel(logging.ERROR)
        logger.addFilter(collect)
    try:
        yield errors
    finally:
        for logger, level in zip(_LOGGERS, levels, strict=True):
            logger.removeFilter(collect)
            logger.setLevel(level)


@cache
def _address(app: ASGIApp) -> tuple[str, int]:
    """Start a server that ends with this process, and return its address."""
    listener = socket.create_server(("127.0.0.1", 0))
    # The thread of the server inherits `daemon`, so it does not keep the process alive.
    threading.Thread(target=_serve, args=(app, listener), daemon=True).start()
    host, port = listener.getsockname()
    # Once this response arrives, uvicorn has set the levels of its loggers.
    _statuses((host, port), _PLAIN, ANSWERED_S)
    return host, port


def _serve(app: ASGIApp, listener: socket.socket) -> None:
    with run_http_server(app, listener, ClientTimeouts(head_s=1, reader_s=1, end_s=1)):
        threading.Event().wait()


async def answer_length(scope: Scope, receive: Receive, send: Send) -> None:
    """Respond with the length of the body; the path selects an early, late or divided response."""
    if scope["type"] != "http":
        return
    path = scope["path"]
    length = 0 if path == "/early" else await _length(receive)
    if path == "/later":
        await asyncio.sleep(_WORK_S)
    await send({"type": "http.response.start", "status": 200, "headers": []})
    if path == "/parts":
        await asyncio.sleep(_WORK_S)
    await send({"type": "http.response.body", "body": b"%d" % length})


async def _length(receive: Receive) -> int:
    length, is_more = 0, True
    while is_more:
        message = await receive()
        length += len(message.get("body", b""))
        is_more = message.get("more_body", False)
    return length


def _starts() -> dict[str, bytes]:
    get = request_bytes("GET", "/?x=1")
    paths = ("/", "/early", "/later", "/parts")
    posts = {path.strip("/") or "read": request_bytes("POST", path, content=b"a" * 5000) for path in paths}
    chunks = b"3;name=value\r\nabc\r\n1000\r\n" + b"a" * 4096 + b"\r\n0\r\nX-Trailer: 1\r\n\r\n"
    chunked = b"POST %s HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n" + chunks
    closing = request_bytes("GET", "/", headers={"Connection": "close"})
    upgrade = {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
    }
    return {
        "get.http": get,
        **{f"{name}.http": post + get for name, post in posts.items()},
        "many.http": b"".join([get, *posts.values(), get]),
        "chunked.http": chunked % b"/" + get,
        "chunked-early.http": chunked % b"/early" + get,
        "expect.http": request_bytes("POST", "/", content=b"abc", headers={"Expect": "100-continue"}),
        "close.http": closing + get,
        "old.http": b"GET /parts HTTP/1.0\r\nConnection: keep-alive\r\n\r\n",
        "head.http": request_bytes("HEAD", "/") + get,
        "upgrade.http": request_bytes("GET", "/later", headers=upgrade) + get,
    }


def _read(path: Path) -> None:
    statuses = talk(answer_length, path.read_bytes())
    if 200 not in statuses:
        raise StereoweaveError(f"refused: {statuses}")


TARGET = Target(
    starts=_starts,
    read=_read,
    tokens=(
        *b"/early /later /parts ? % \0 \xff : ; , 0 1 ffffffffffffffff -1 +1 0x1 HTTP/1.0 HTTP/2.0".split(),
        *(b"\n", b"\r", b"\r\n", b"\r\n\r\n", b"0\r\n\r\n", b"1\r\na\r\n", b" ", b"\t", b"a" * 5000),
        *(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n", b"POST ", b"HEAD ", b"CONNECT ", b"PRI * HTTP/2.0\r\n\r\n"),
        *(b"Connection: close\r\n", b"Connection: keep-alive\r\n", b"Connection: Upgrade\r\n"),
        *(b"Upgrade: websocket\r\n", b"Expect: 100-continue\r\n", b"Host: y\r\n", b"X: a\r\n b\r\n"),
        *(b"Transfer-Encoding: chunked\r\n", b"Content-Length: 5\r\n", b"Content-Length: 5, 5\r\n"),
    ),
)
