"""The HTTP server, with an application that answers /5 with 5 bytes at once, and /later when allowed."""

import asyncio
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from http.client import HTTPResponse

import pytest

from stereoweave.service import server
from stereoweave.service.server import ClientTimeouts, run_http_server

TIMEOUTS = ClientTimeouts(head_s=0.5, reader_s=0.5, end_s=10)
HEAD = b"GET /5 HTTP/1.1\r\nHost: x\r\n"
ARRIVED, ALLOWED = threading.Event(), threading.Event()


async def app(scope, receive, send) -> None:
    if scope["type"] != "http":
        return
    if scope["path"] == "/later":
        ARRIVED.set()
        await asyncio.to_thread(ALLOWED.wait, 10)
    body = bytes(int(scope["path"][1:])) if scope["path"][1:].isdecimal() else b"later"
    headers = [(b"content-length", str(len(body)).encode())]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    await send({"type": "http.response.body", "body": body})


@pytest.fixture(scope="module")
def address() -> Iterator[tuple[str, int]]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        address = listener.getsockname()
        with run_http_server(app, listener, TIMEOUTS):
            yield address


@pytest.fixture
def connection(address) -> Iterator[socket.socket]:
    with socket.create_connection(address, timeout=10) as connection:
        yield connection


def read_to_end(connection: socket.socket) -> bytes:
    """Return everything that the server sends until it closes or resets the connection."""
    received = b""
    try:
        while part := connection.recv(1 << 16):
            received += part
    except ConnectionResetError:
        pass
    return received


def test_endless_headers_are_refused_before_they_fill_memory(address, connection):
    sent = 0
    connection.sendall(HEAD + b"X: ")
    with pytest.raises(OSError):  # noqa: PT011 - the connection is closed or reset
        while sent < 50_000_000:
            sent += connection.send(b"a" * 65536)
    assert sent < 10_000_000  # the system's buffers accept some of it
    with socket.create_connection(address, timeout=10) as other:
        other.sendall(HEAD + b"Connection: close\r\n\r\n")
        assert read_to_end(other).startswith(b"HTTP/1.1 200")


@pytest.mark.parametrize("begun", [b"", HEAD + b"X: "])
def test_headers_that_do_not_arrive_in_time_close_the_connection(connection, begun):
    start_s = time.monotonic()
    connection.sendall(begun)
    assert read_to_end(connection) == b""
    assert time.monotonic() - start_s < 5


def test_the_headers_of_a_second_request_have_the_same_time_limit(connection):
    connection.sendall(HEAD + b"\r\n" + HEAD)
    assert read_to_end(connection).count(b"HTTP/1.1 200") == 1


def test_a_request_in_pieces_and_two_requests_in_one_piece_are_answered(connection):
    request = HEAD + b"\r\n"
    for place in range(len(request)):
        connection.sendall(request[place : place + 1])
    connection.sendall(request + HEAD + b"Connection: close\r\n\r\n")
    assert read_to_end(connection).count(b"HTTP/1.1 200") == 3


def test_invalid_http_after_a_response_closes_the_connection_without_an_error(connection, caplog):
    connection.sendall(b"POST /5 HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n")
    answered = b""
    while not answered.endswith(b"\r\n\r\n" + bytes(5)):  # the response comes before the request's body
        answered += connection.recv(1 << 16)
    connection.sendall(b"no chunk\r\n")
    assert read_to_end(connection) == b""
    assert caplog.messages == []


def test_a_head_request_that_continues_with_invalid_http_is_closed_without_an_error(connection, caplog):
    ALLOWED.clear()
    connection.sendall(b"HEAD /later HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\nno chunk\r\n")
    assert read_to_end(connection) == b""  # a response to HEAD has no body
    ALLOWED.set()
    assert caplog.messages == []


def test_a_response_may_take_longer_than_the_time_limit_of_headers(connection):
    ALLOWED.clear()
    connection.sendall(b"GET /later HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
    threading.Timer(2 * TIMEOUTS.head_s, ALLOWED.set).start()
    assert read_to_end(connection).endswith(b"later")


def test_a_response_that_is_not_read_in_time_is_aborted(connection):
    connection.sendall(b"GET /50000000 HTTP/1.1\r\nHost: x\r\n\r\n")
    connection.recv(1)
    time.sleep(4 * TIMEOUTS.reader_s)
    assert len(read_to_end(connection)) < 49_000_000


def test_an_unread_response_is_aborted_even_if_another_request_waits_behind_it(connection):
    connection.sendall(b"GET /50000000 HTTP/1.1\r\nHost: x\r\n\r\n" * 2)
    connection.recv(1)
    time.sleep(4 * TIMEOUTS.reader_s)
    assert len(read_to_end(connection)) < 49_000_000


def test_accepted_requests_are_answered_before_the_server_ends():
    ARRIVED.clear()
    ALLOWED.clear()
    with socket.create_server(("127.0.0.1", 0)) as listener:
        with run_http_server(app, listener, TIMEOUTS):
            connection = socket.create_connection(listener.getsockname(), timeout=10)
            connection.sendall(b"GET /later HTTP/1.1\r\nHost: x\r\n\r\n")
            assert ARRIVED.wait(10)
            threading.Timer(0.5, ALLOWED.set).start()
        with connection:
            assert read_to_end(connection).endswith(b"later")


def test_a_body_of_tiny_chunks_does_not_delay_other_requests(address, connection):
    connection.sendall(b"POST /5 HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n")
    threading.Thread(target=connection.sendall, args=(b"1\r\na\r\n" * 150_000,), daemon=True).start()
    waited_s, start_s = [], time.monotonic()
    while (asked_s := time.monotonic()) < start_s + 2:
        with socket.create_connection(address, timeout=10) as other:
            other.sendall(HEAD + b"Connection: close\r\n\r\n")
            assert read_to_end(other).startswith(b"HTTP/1.1 200")
        waited_s.append(time.monotonic() - asked_s)
    assert max(waited_s) < 0.7


def test_above_the_limit_only_the_connection_that_has_waited_longest_is_closed(monkeypatch):
    monkeypatch.setattr(server, "_MOST_CONNECTIONS", 20)
    with ExitStack() as opened:
        listener = opened.enter_context(socket.create_server(("127.0.0.1", 0)))
        opened.enter_context(run_http_server(app, listener, ClientTimeouts(head_s=60)))
        several = []
        for _ in range(20):
            connection = socket.create_connection(listener.getsockname(), timeout=10)
            several.append(opened.enter_context(connection))
        assert is_answered(several[-1])  # the last one accepted, so that the others are accepted too
        assert is_answered(several[0])
        several.append(opened.enter_context(socket.create_connection(listener.getsockname(), timeout=10)))
        assert read_to_end(several[1]) == b""
        assert all(map(is_answered, [several[0], several[2], several[-1]]))


def is_answered(connection: socket.socket) -> bool:
    connection.sendall(HEAD + b"\r\n")
    response = HTTPResponse(connection)
    response.begin()
    return response.status == 200 and response.read() == bytes(5)
