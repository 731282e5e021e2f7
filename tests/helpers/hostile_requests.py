"""Malicious raw HTTP requests that attack parsing and time limits."""

import socket
import struct
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import chain, repeat

import httpx

Sender = Callable[[httpx.Client], tuple[int, str]]
# Large enough to expose a server that keeps a whole request in memory.
_ENDLESS = 64_000_000
_POST = b"POST /disparity HTTP/1.1\r\nHost: localhost\r\n"
_FORM = b"Content-Type: multipart/form-data; boundary=b\r\n"
_CHUNKED = _POST + _FORM + b"Transfer-Encoding: chunked\r\n\r\n"
_PART = b'--b\r\nContent-Disposition: form-data; name="left"; filename="l"\r\n\r\n'


def make_hostile_requests() -> dict[str, Sender]:
    """Return requests keyed by what each does; status 0 means a connection closed without a response."""
    once = _make_heads() | _make_methods() | _make_hosts() | _make_lengths() | _make_bodies()
    once |= _make_other_protocols()
    return {
        **{name: partial(_send_parts, [request]) for name, request in once.items()},
        **{name: partial(_send_parts, parts) for name, parts in _make_endless().items()},
        **_make_slow(),
        **_make_cut_off(),
    }


def _make_heads() -> dict[str, bytes]:
    get = b"GET /health HTTP/1.1\r\nHost: localhost\r\n"
    return {
        "a header without a colon": get + b"X\r\n\r\n",
        "a space before the colon": get + b"Content-Length : 5\r\n\r\n",
        "a folded header": get + b"X: a\r\n b\r\n\r\n",
        "a zero in a header": get + b"X: a\0b\r\n\r\n",
        "bytes beyond ASCII": get + b"X: \xff\xfe\r\n\r\n",
        "lone line feeds": get.replace(b"\r\n", b"\n") + b"\n",
        "lone carriage returns": get.replace(b"\r\n", b"\r") + b"\r",
        "ten thousand headers": get + b"X: a\r\n" * 10_000 + b"\r\n",
        "a path of 100 kB": b"GET /" + b"a" * 100_000 + b" HTTP/1.1\r\nHost: localhost\r\n\r\n",
        "a path with a zero": b"GET /%00 HTTP/1.1\r\nHost: localhost\r\n\r\n",
        "a path beyond ASCII": b"GET /\xff HTTP/1.1\r\nHost: localhost\r\n\r\n",
        "no version": b"GET /health\r\n\r\n",
        "version 9.9": b"GET /health HTTP/9.9\r\nHost: localhost\r\n\r\n",
        "a token of 15 kB": get + b"Authorization: Bearer " + b"a" * 15_000 + b"\r\n\r\n",
    }


def _make_methods() -> dict[str, bytes]:
    methods = (b"BREW", b"post", b"CONNECT", b"TRACE", b"OPTIONS", b"DELETE", b"A" * 9000, b"\x01", b"P OST")
    return {
        f"method {method[:8]!r}": method + b" /view HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
        for method in methods
    }


def _make_hosts() -> dict[str, bytes]:
    hosts = (
        b"evil.example",
        b"127.0.0.1.evil.example",
        b"[::1",
        b"",
        b"localhost@evil",
        b"localhost:x",
        b"a" * 9000,
    )
    lines = {f"host {host[:24]!r}": b"Host: " + host for host in hosts}
    lines |= {"no host": b"X: a", "two hosts": b"Host: localhost\r\nHost: evil.example"}
    return {
        name: b"GET /openapi.json HTTP/1.1\r\n" + line + b"\r\nConnection: close\r\n\r\n"
        for name, line in lines.items()
    }


def _make_lengths() -> dict[str, bytes]:
    lengths = (b"+5", b"0x10", b"1e3", b"5, 6", b"9" * 30, b" ", b"\xd9\xa3")
    heads = {f"length {length[:8]!r}": b"Content-Length: " + length for length in lengths}
    heads |= {
        "a length and chunks": b"Content-Length: 5\r\nTransfer-Encoding: chunked",
        "chunks of an unknown kind": b"Transfer-Encoding: xchunked",
        "chunks twice": b"Transfer-Encoding: chunked, chunked",
    }
    return {name: _POST + _FORM + head + b"\r\n\r\nhello" for name, head in heads.items()}


def _make_bodies() -> dict[str, bytes]:
    chunks = {
        "a chunk without an end": b"FFFFFFFFFFFFFFFF\r\n" + _PART,
        "a chunk of a negative length": b"-1\r\n" + _PART,
        "a chunk of no length": b"x\r\n" + _PART,
        "a chunk that is longer than it says": b"1\r\nabc\r\n0\r\n\r\n",
    }
    text = b'--b\r\nContent-Disposition: form-data; name="range"\r\n\r\n'
    bodies = {
        "a field of 2 MB": text + b"1" * 2_000_000 + b"\r\n--b--\r\n",
        "a name of 1 MB": _PART.replace(b"left", b"l" * 1_000_000),
        "a head of a part of 1 MB": b"--b\r\n" + b"X: a\r\n" * 200_000,
        "boundaries alone": b"--b\r\n" * 200_000,
        "line ends alone": b"\r\n" * 500_000,
        "a form in the form": _PART + _PART * 1000 + b"--b--\r\n",
        "a compressed body": b"\x1f\x8b\x08" + bytes(1000),
    }
    framed = {name: _make_form(body) for name, body in bodies.items()}
    many = {"a hundred forms in one piece": _make_form(_PART + b"x\r\n--b--\r\n") * 100}
    return {name: _CHUNKED + body for name, body in chunks.items()} | framed | many


def _make_form(body: bytes) -> bytes:
    return _POST + _FORM + b"Content-Length: %d\r\n\r\n" % len(body) + body


def _make_other_protocols() -> dict[str, bytes]:
    get = b"GET /health HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: "
    key = b"\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    return {
        "HTTP/2": b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes(9),
        "an upgrade to HTTP/2": get + b"h2c\r\nHTTP2-Settings: AAMAAABk\r\n\r\n",
        "an upgrade to a WebSocket": get + b"websocket" + key,
        "TLS": b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(500),
        "an object of Ray": b"\x80\x05\x95" + bytes(range(256)) * 16,
        "zeros": bytes(100_000),
    }


def _make_endless() -> dict[str, Iterable[bytes]]:
    get = b"GET /health HTTP/1.1\r\nHost: localhost\r\n"
    begun = {
        "an endless header": (get + b"X: ", b"a"),
        "endless headers": (get, b"X: a\r\n"),
        "an endless name of a header": (get, b"X"),
        "an endless path": (b"GET /", b"a"),
        "an endless method": (b"", b"A"),
        "endless line ends": (b"", b"\r\n"),
        "an endless length of a chunk": (_CHUNKED, b"0"),
        "an endless extension of a chunk": (_CHUNKED + b"5;", b"a"),
        "an endless trailer": (_CHUNKED + b"0\r\nX: ", b"a"),
        "endless empty chunks": (_CHUNKED, b"1\r\na\r\n"),
        "an endless field": (_CHUNKED + b"FFFFFFF\r\n" + _PART, b"a"),
        "an endless head of a part": (_CHUNKED + b"FFFFFFF\r\n--b\r\nX: ", b"a"),
    }
    return {name: list(_repeat(start, unit)) for name, (start, unit) in begun.items()}


def _repeat(start: bytes, unit: bytes) -> Iterator[bytes]:
    block = unit * (64_000 // len(unit))
    return chain([start], repeat(block, _ENDLESS // len(block)))


def _make_slow() -> dict[str, Sender]:
    head = b"GET /health HTTP/1.1\r\nHost: localhost\r\nX: "
    body = _POST + _FORM + b"Content-Length: 1000000\r\n\r\n" + _PART
    starts = {"head": head, "body": body, "chunk": _CHUNKED + b"FFFF\r\n"}
    drops = {f"a slow {what}": partial(_drip, start) for what, start in starts.items()}
    return drops | {"a reader that never reads": _never_read}


def _drip(start: bytes, client: httpx.Client) -> tuple[int, str]:
    return _send_parts(chain([start], _make_drops()), client)


def _make_drops() -> Iterator[bytes]:
    while True:
        time.sleep(0.5)
        yield b"a"


def _never_read(client: httpx.Client) -> tuple[int, str]:
    with _connect(client) as connection:
        connection.sendall(b"GET /openapi.json HTTP/1.1\r\nHost: localhost\r\n\r\n" * 100)
        time.sleep(3)
    return 0, ""


def _make_cut_off() -> dict[str, Sender]:
    body = _POST + _FORM + b"Content-Length: 1000\r\n\r\n" + _PART
    starts = {"the head": _POST[:40], "the body": body, "a chunk": _CHUNKED + b"FF\r\nabc"}
    return {
        f"{what} is cut off by {how}": partial(_leave, start, reset)
        for what, start in starts.items()
        for how, reset in {"its end": False, "a reset": True}.items()
    }


def _leave(start: bytes, reset: bool, client: httpx.Client) -> tuple[int, str]:
    with _connect(client) as connection:
        connection.sendall(start)
        if not reset:
            connection.shutdown(socket.SHUT_WR)
            return _read_status(connection)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    return 0, ""


def _send_parts(parts: Iterable[bytes], client: httpx.Client) -> tuple[int, str]:
    """Send as many bytes as the server accepts; return the status of the response."""
    with _connect(client) as connection:
        try:
            for part in parts:
                connection.sendall(part)
        except OSError:
            pass  # the connection was closed while sending
        return _read_status(connection)


def _connect(client: httpx.Client) -> socket.socket:
    return socket.create_connection((client.base_url.host, client.base_url.port), timeout=60)


def _read_status(connection: socket.socket) -> tuple[int, str]:
    try:
        words = connection.makefile("rb").readline().split()
    except OSError:
        return 0, ""
    return (int(words[1]) if words else 0), ""
